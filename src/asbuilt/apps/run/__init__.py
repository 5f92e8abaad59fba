"""Move a robot in rounds until its model is proven: design, record, predict, identify."""

from asbuilt.apps.run.drivers import DRIVERS, Driver, DriverRequest, open_driver
from asbuilt.apps.run.loop import Loop, Outcome
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.prediction import predict_round
from asbuilt.apps.run.rounds import Round

__all__ = [
    "DRIVERS",
    "Driver",
    "DriverRequest",
    "Loop",
    "Outcome",
    "Round",
    "RunOptions",
    "open_driver",
    "predict_round",
]
