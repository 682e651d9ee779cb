"""What an interrupted adaptation has kept: finished folds, and the checkpoint of the last training."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.models.training import remove_checkpoint

__all__ = ["WHOLE", "KeptFolds", "remove_kept"]

_STATE = "adapt.json"
WHOLE = "whole"
"""Folder of the checkpoint of the training that is kept."""
_AGAIN = "remove the folder and adapt from the start"


@dataclass(frozen=True)
class KeptFolds:
    """A folder with the errors of finished folds, or None; and whether to go on from it."""

    folder: Path | None
    resume: bool

    def begin(self, identity: dict[str, Any]) -> None:
        """Start with an empty folder, or go on with this one; refuse one of another adaptation."""
        if self.folder is None:
            return
        file = self.folder / _STATE
        if self.resume and file.exists():
            if _read(file).get("identity") != identity:
                what = "was left by an adaptation with other settings or other data"
                raise InputError(what, where=self.folder, remedy="give the same arguments, or " + _AGAIN)
            return
        remove_kept(self.folder)
        with atomic_file(file) as part:
            part.write_text(json.dumps({"identity": identity}, indent=1) + "\n", encoding="utf-8")

    def fold(self, number: int) -> NDArray[np.float64] | None:
        """Return what was kept of a fold that is finished, a row a frame, or None."""
        file = None if self.folder is None or not self.resume else self.folder / f"fold-{number + 1}.json"
        return None if file is None or not file.exists() else np.array(_read(file)["errors"], dtype=float)

    def keep(self, number: int, errors: NDArray[np.float64]) -> None:
        """Keep the errors of a finished fold, a row a frame."""
        if self.folder is not None:
            with atomic_file(self.folder / f"fold-{number + 1}.json") as part:
                part.write_text(json.dumps({"errors": errors.tolist()}), encoding="utf-8")


def _read(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"damaged checkpoint ({error})", where=file, remedy=_AGAIN) from error
    if not isinstance(found, dict):
        raise InputError("damaged checkpoint", where=file, remedy=_AGAIN)
    return found


def remove_kept(folder: Path) -> None:
    """Remove what an adaptation has kept in a folder, and the folder if nothing else is in it."""
    if not folder.is_dir():
        return
    for file in (folder / _STATE, *folder.glob("fold-*.json")):
        file.unlink(missing_ok=True)
    remove_checkpoint(folder / WHOLE)
    with contextlib.suppress(OSError):
        folder.rmdir()
