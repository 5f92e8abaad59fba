"""The dynamic model of a robot arm as built, from its description and a recording of its motion and
torque.

>>> import asbuilt
>>> model = asbuilt.load_robot("kuka-iiwa7-r800")
>>> asbuilt.find_base_parameters(model).n_base
43
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from asbuilt.description.inertia import LinkInertia
    from asbuilt.description.load import load_robot
    from asbuilt.description.model import RobotModel
    from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.dynamics.newton_euler import (
        forward_dynamics,
        gravity_torque,
        inverse_dynamics,
        mass_matrix,
    )
    from asbuilt.dynamics.regressor import observation_matrix, regressor
    from asbuilt.errors import AsbuiltError
    from asbuilt.excitation.design.design import design_motion
    from asbuilt.excitation.design.options import DesignOptions
    from asbuilt.experiment.logs.readers import read_recording
    from asbuilt.experiment.quality.checks import check_recording
    from asbuilt.experiment.recording import Recording
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.experiment.signal.signal_chain import SignalChain, prepare_samples
    from asbuilt.experiment.virtual.free_motion import run_free
    from asbuilt.experiment.virtual.simulation import simulate_recording
    from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
    from asbuilt.identification.calibration.payload import identify_payload
    from asbuilt.identification.identify import identify
    from asbuilt.identification.result.result import IdentificationResult
    from asbuilt.validation.attribution.attribution import attribute
    from asbuilt.validation.comparison.comparison import compare
    from asbuilt.validation.prediction import validate
    from asbuilt.workflow.study import Study, StudyOptions, run_study
    from asbuilt.writers.models.export import export_result
    from asbuilt.writers.reports.report import write_report

__version__ = "0.1.0"

_HOME = {
    "AsbuiltError": "errors",
    "BaseParameters": "dynamics.base.base_parameters",
    "DesignOptions": "excitation.design.options",
    "DriveSet": "dynamics.drives.selection",
    "IdentificationResult": "identification.result.result",
    "LinkInertia": "description.inertia",
    "Recording": "experiment.recording",
    "RobotModel": "description.model",
    "Samples": "experiment.signal.samples",
    "SignalChain": "experiment.signal.signal_chain",
    "Study": "workflow.study",
    "StudyOptions": "workflow.study",
    "VirtualRobot": "experiment.virtual.virtual_robot",
    "attribute": "validation.attribution.attribution",
    "check_recording": "experiment.quality.checks",
    "compare": "validation.comparison.comparison",
    "design_motion": "excitation.design.design",
    "export_result": "writers.models.export",
    "find_base_parameters": "dynamics.base.base_parameters",
    "forward_dynamics": "dynamics.newton_euler",
    "gravity_torque": "dynamics.newton_euler",
    "identify": "identification.identify",
    "identify_payload": "identification.calibration.payload",
    "inverse_dynamics": "dynamics.newton_euler",
    "load_robot": "description.load",
    "mass_matrix": "dynamics.newton_euler",
    "observation_matrix": "dynamics.regressor",
    "prepare_samples": "experiment.signal.signal_chain",
    "read_recording": "experiment.logs.readers",
    "regressor": "dynamics.regressor",
    "run_free": "experiment.virtual.free_motion",
    "run_study": "workflow.study",
    "simulate_recording": "experiment.virtual.simulation",
    "validate": "validation.prediction",
    "write_report": "writers.reports.report",
}

__all__ = [
    "AsbuiltError",
    "BaseParameters",
    "DesignOptions",
    "DriveSet",
    "IdentificationResult",
    "LinkInertia",
    "Recording",
    "RobotModel",
    "Samples",
    "SignalChain",
    "Study",
    "StudyOptions",
    "VirtualRobot",
    "attribute",
    "check_recording",
    "compare",
    "design_motion",
    "export_result",
    "find_base_parameters",
    "forward_dynamics",
    "gravity_torque",
    "identify",
    "identify_payload",
    "inverse_dynamics",
    "load_robot",
    "mass_matrix",
    "observation_matrix",
    "prepare_samples",
    "read_recording",
    "regressor",
    "run_free",
    "run_study",
    "simulate_recording",
    "validate",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Load a public name from the module that owns it, on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module 'asbuilt' has no attribute {name!r}")
    value = getattr(import_module(f"asbuilt.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return [*__all__, "__version__"]
