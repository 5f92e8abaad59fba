"""From samples to numbers: estimates with standard errors, and what can be calibrated."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
