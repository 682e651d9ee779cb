"""Reproduce the paper's Figs. 4 to 12 and its tables: simulate, learn, measure, draw, and state the differences."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
