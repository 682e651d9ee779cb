"""The old name of `tapetum.simulate.eye_beam`, for one release."""

from tapetum.simulate.eye_beam import *  # noqa: F403
from tapetum.simulate.eye_beam import __all__  # noqa: F401
