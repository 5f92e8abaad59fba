"""BAM identifies one servo on a pendulum of known inertia; a log of an arm is no input of it."""

PACKAGE = "better-actuator-models"
REQUIRES = ["better-actuator-models"]
PYTHON = "3.12"
TITLE = "BAM"
ADDRESS = "https://github.com/Rhoban/bam"
CANNOT = {
    "*": "fits friction models of one actuator on a pendulum bench of known mass and length, from"
    " commands, gains and supply voltage of its servo; it has no input for a log of an arm"
    " (better-actuator-models 1.0.2 for Python 3.12, installed and read on 28 November 2026)"
}
