"""Programs in the languages of robot makers, which run a motion and record it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
