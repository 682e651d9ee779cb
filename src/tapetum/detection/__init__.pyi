from .find import find_cameras
from .found import Found
from .many import find_each
from .registration import Registered, register

__all__ = [
    "Found",
    "Registered",
    "find_cameras",
    "find_each",
    "register",
]
