"""Memory that was freed is asked for again without the system's help."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

# Counts the pages that the system hands out for ten blocks, one after another, before and after.
_PROGRAM = """
import resource
import numpy as np
from tapetum.memory import keep_freed

def pages():
    first = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        one, other = (np.ones(3_000_000, np.uint8) for _ in range(2))
        del one, other
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - first

keep_freed()
pages()
print(pages())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_blocks_that_are_freed_are_used_again() -> None:
    told = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    # Without it every block of 3 MB takes 700 pages anew.
    assert int(told.stdout) < 200
