"""The checks of a calibration's numbers, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Check", "rows", "to_mend", "verdict"]


@dataclass(frozen=True)
class Check:
    """A number that was checked.

    Attributes
    ----------
    what, found, wanted
        What it is, its value, and the range that is right, in words.
    good, remedy
        Whether it is, and what to do where it is not.
    """

    what: str
    found: str
    wanted: str
    good: bool
    remedy: str

    @property
    def line(self) -> str:
        """The check in one line."""
        return f"{self.what}: {self.found} (wanted: {self.wanted}); {self.remedy}"


def to_mend(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that failed."""
    return [check for check in checks if not check.good]


def verdict(checks: Sequence[Check]) -> str:
    """Return "good", or which checks failed."""
    failed = to_mend(checks)
    return "to correct: " + ", ".join(check.what for check in failed) if failed else "good"


def rows(checks: Sequence[Check]) -> list[tuple[str, str, str, str]]:
    """Return the checks as rows of a table, the failed ones first: what, found, wanted, and the remedy."""
    ordered = sorted(checks, key=lambda check: check.good)
    return [(one.what, one.found, one.wanted, "good" if one.good else one.remedy) for one in ordered]
