"""The live watch: a source is read without end, its cameras are followed, and what happens is published.

`Watch` runs the loop, `Log` keeps the events, `make_app` shows both on a page.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
