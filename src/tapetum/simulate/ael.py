"""The old name of `tapetum.simulate.eye_limits`, for one release."""

from tapetum.simulate.eye_limits import *  # noqa: F403
from tapetum.simulate.eye_limits import __all__  # noqa: F401
