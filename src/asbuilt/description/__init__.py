"""What the robot is: links, joints, mass properties and limits, from every common description."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
