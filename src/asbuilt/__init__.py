"""The dynamic model of a robot arm as built, from its description and a recording of its motion and torque.

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
    from asbuilt.dynamics.base_parameters import BaseParameters, find_base_parameters
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.dynamics.newton_euler import forward_dynamics, gravity_torque, inverse_dynamics, mass_matrix
    from asbuilt.dynamics.regressor import observation_matrix, regressor
    from asbuilt.errors import AsbuiltError
    from asbuilt.excitation.design import design_motion
    from asbuilt.excitation.design_options import DesignOptions
    from asbuilt.experiment.checks import check_recording
    from asbuilt.experiment.free_motion import run_free
    from asbuilt.experiment.readers import read_recording
    from asbuilt.experiment.recording import Recording
    from asbuilt.experiment.samples import Samples
    from asbuilt.experiment.signal_chain import SignalChain, prepare_samples
    from asbuilt.experiment.simulation import simulate_recording
    from asbuilt.experiment.virtual_robot import VirtualRobot
    from asbuilt.identification.identify import identify
    from asbuilt.identification.payload import identify_payload
    from asbuilt.identification.result import IdentificationResult
    from asbuilt.validation.attribution import attribute
    from asbuilt.validation.comparison import compare
    from asbuilt.validation.prediction import validate
    from asbuilt.validation.study import Study, StudyOptions, run_study
    from asbuilt.writers.export import export_result
    from asbuilt.writers.report import write_report

__version__ = "0.1.0"

_HOME = {
    "AsbuiltError": "errors",
    "BaseParameters": "dynamics.base_parameters",
    "DesignOptions": "excitation.design_options",
    "DriveSet": "dynamics.drives.selection",
    "IdentificationResult": "identification.result",
    "LinkInertia": "description.inertia",
    "Recording": "experiment.recording",
    "RobotModel": "description.model",
    "Samples": "experiment.samples",
    "SignalChain": "experiment.signal_chain",
    "Study": "validation.study",
    "StudyOptions": "validation.study",
    "VirtualRobot": "experiment.virtual_robot",
    "attribute": "validation.attribution",
    "check_recording": "experiment.checks",
    "compare": "validation.comparison",
    "design_motion": "excitation.design",
    "export_result": "writers.export",
    "find_base_parameters": "dynamics.base_parameters",
    "forward_dynamics": "dynamics.newton_euler",
    "gravity_torque": "dynamics.newton_euler",
    "identify": "identification.identify",
    "identify_payload": "identification.payload",
    "inverse_dynamics": "dynamics.newton_euler",
    "load_robot": "description.load",
    "mass_matrix": "dynamics.newton_euler",
    "observation_matrix": "dynamics.regressor",
    "prepare_samples": "experiment.signal_chain",
    "read_recording": "experiment.readers",
    "regressor": "dynamics.regressor",
    "run_free": "experiment.free_motion",
    "run_study": "validation.study",
    "simulate_recording": "experiment.simulation",
    "validate": "validation.prediction",
    "write_report": "writers.report",
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
