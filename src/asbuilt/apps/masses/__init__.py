"""Masses of links from their geometry and material, or from a table of a CAD program."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
