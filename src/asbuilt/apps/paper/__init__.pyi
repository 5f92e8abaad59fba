from .demo import run_demo as run_demo
from .reproduction import reproduce_paper as reproduce_paper
