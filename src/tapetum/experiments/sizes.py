"""Sizes of the sets and trainings for the paper's section 5, and the note about them on its pages."""

from __future__ import annotations

__all__ = ["DEFAULT", "SIZES", "SMOKE_TEST", "is_smoke_test", "size_note", "with_note"]

SIZES = ("laptop", "small", "paper")
DEFAULT = "laptop"

SMOKE_TEST = "a smoke test: it shows that every step runs, and nothing about the method"

_NOTES = {
    "small": f"""**Size `small`** is {SMOKE_TEST}. Networks were trained for four epochs on a few hundred frames and
have learned next to nothing. `tapetum paper -o DIR` makes the size `laptop`, whose networks have.""",
    "laptop": """**Size `laptop`**: the videos of the paper's sets, each 8 to 30 seconds long, and networks for smaller
pictures and fewer epochs than at size `paper`.""",
    "paper": "**Size `paper`**: as many and as long videos as the paper's.",
}


def is_smoke_test(size: str) -> bool:
    """Whether sets of a size are too small to learn from."""
    return size == "small"


def size_note(size: str) -> str:
    """Return the paragraph that names the size of what was filmed and trained."""
    return " ".join(_NOTES[size].split())


def with_note(page: str, size: str) -> str:
    """Put the note about the size below the heading of a page."""
    heading, _, rest = page.partition("\n")
    return f"{heading}\n\n{size_note(size)}\n{rest}"
