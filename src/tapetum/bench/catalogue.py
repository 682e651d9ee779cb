"""Bench files: bundled ones by name, others by path."""

from __future__ import annotations

import difflib
import functools
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from tapetum.bench.plain_yaml import read_mapping
from tapetum.errors import InputError
from tapetum.files import read_text

__all__ = ["Catalogue"]


@dataclass(frozen=True)
class Catalogue:
    """The files of one `kind` (`lens`) that come with the package, in `folder`, with the `schema` they must state.

    For messages: `suffixes` a file may have, and the `likeness` (0 to 1) from which a name is suggested for an unknown
    one.
    """

    kind: str
    schema: str
    folder: str
    suffixes: str = "YAML"
    likeness: float = 0.6

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the files that come with the package, in order."""
        files = (resources.files("tapetum.bench") / self.folder).iterdir()
        return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))

    def path(self, source: str) -> Path:
        """Return the file of a name or path; raises an InputError with the nearest names if there is none."""
        if source in self.names:
            return Path(str(resources.files("tapetum.bench") / self.folder / f"{source}.yaml"))
        if Path(source).is_file():
            return Path(source)
        if Path(source).is_dir():
            raise InputError("is a folder", where=source, remedy=f"give the path of a {self.suffixes} file")
        near = difflib.get_close_matches(source, self.names, n=3, cutoff=self.likeness)
        listed = f"give the path of a {self.suffixes} file, or one of {', '.join(self.names)}"
        remedy = f"did you mean {' or '.join(near)}?" if near else listed
        raise InputError(f"no such {self.kind}", where=source, remedy=remedy)

    def read(self, source: str) -> dict[str, Any]:
        """Return what a YAML file holds, by its name or path, without its `schema`; errors as of `read_mapping`."""
        return read_mapping(read_text(self.path(source), f"give a {self.suffixes} file"), self.schema, source)
