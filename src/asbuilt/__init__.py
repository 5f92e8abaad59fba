"""The dynamic model of a robot arm as built, from its description and recordings of its motion.

>>> import asbuilt
>>> model = asbuilt.load_robot("kuka-iiwa7-r800")
>>> asbuilt.find_base_parameters(model).n_base
43
"""

from asbuilt.faces import attach_face

__getattr__, __dir__, __all__ = attach_face(__name__, __file__)

__version__ = "0.1.0"
