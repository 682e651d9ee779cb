"""What must be known of a real probe: its sensor, the ghost of its beam splitter, the clocks of its cameras."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
