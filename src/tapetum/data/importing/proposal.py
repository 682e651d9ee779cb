"""A proposed mapping, with the guesses it rests on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import yaml

from tapetum.data.importing.mapping import ImportMapping, mapping_from_text
from tapetum.errors import InputError

__all__ = ["Proposal"]


@dataclass
class Proposal:
    """A mapping as plain values, what was guessed, and what a person must fill in.

    Attributes
    ----------
    content
        The mapping.
    notes
        Guesses, a line each.
    gaps
        What could not be guessed, a sentence each.
    dropped
        Files that the mapping leaves out, and why, a line each.
    """

    content: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The proposal as a mapping file, its guesses as comments."""
        body = yaml.safe_dump(self.content, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
        told = [f"# guess: {note}" for note in dict.fromkeys(self.notes)]
        told += [f"# missing: {gap}" for gap in dict.fromkeys(self.gaps)]
        told += [f"# left out: {line}" for line in dict.fromkeys(self.dropped)]
        return "\n".join([*told, body])

    def mapping(self, where: str) -> ImportMapping:
        """The proposal as a checked mapping.

        Raises
        ------
        InputError
            When something could not be guessed.
        """
        if self.gaps:
            remedy = "write the mapping by the proposal above and pass it with --mapping"
            raise InputError(f"no mapping could be made: {self.gaps[0]}", where=where, remedy=remedy)
        return mapping_from_text(self.text, where)
