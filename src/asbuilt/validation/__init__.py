"""Does it hold: predictions of other recordings, residuals, CAD against as built."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
