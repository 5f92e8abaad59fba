"""The 2015 paper by Hayat, Abhishek and Saha, reproduced, and the demonstrations."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
