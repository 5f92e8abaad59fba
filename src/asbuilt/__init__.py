"""The dynamic model of a robot arm as built, from its description and recordings of its motion.

>>> import asbuilt
>>> model = asbuilt.load_robot("kuka-iiwa7-r800")
>>> asbuilt.find_base_parameters(model).n_base
43
"""

from asbuilt.registry import attach_face

__getattr__, _list_all_names, _ = attach_face(__name__, __file__)

__version__ = "1.0.0"

__all__ = [
    "check_recording",
    "compare",
    "design_motion",
    "export_result",
    "identify",
    "identify_payload",
    "load_robot",
    "read_recording",
    "read_study",
    "robot_names",
    "simulate_recording",
    "validate",
    "write_study",
]
"""What most studies need; the other names of the stub are at home in the stages."""


def __dir__() -> list[str]:
    """Return the names that one needs, and those of every module."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
