"""A robot at work: external torque, contact and fault, from sample to sample."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
