"""What several commands ask of their arguments."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tapetum.errors import InputError, StoppedError

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["check_replaceable", "find_model", "says_what_is_kept"]


def check_replaceable(out: Path, overwrite: bool, marker: str, kind: str) -> None:
    """Refuse early what `--overwrite` may not replace: anything that does not show it is of the same kind.

    Parameters
    ----------
    out
        The folder to write.
    overwrite
        Whether the option was given.
    marker
        A file that every folder of this kind holds, and that names its format.
    kind
        The format, as the marker names it.

    Raises
    ------
    InputError
        When something stands there that must stay.
    """
    if not out.exists() and not out.is_symlink():
        return
    if not overwrite:
        raise InputError("exists already", where=out, remedy="choose another name or pass --overwrite")
    try:
        known = kind in (out / marker).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        known = False
    if not known:
        what = f"is no {kind} that may be replaced"
        raise InputError(what, where=out, remedy="choose another name or remove it yourself")


@contextlib.contextmanager
def says_what_is_kept(how: str = "") -> Iterator[None]:
    """Put what work that ended early has kept, the notes on its error, into the one line that a person sees.

    Parameters
    ----------
    how
        How to go on, for what Ctrl-C ended.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        notes = getattr(error, "__notes__", [])
        if not notes:
            raise
        raise StoppedError("; ".join([*notes, *([how] if how else [])])) from error
    except InputError as error:
        notes = getattr(error, "__notes__", [])
        if not notes:
            raise
        remedy = "; ".join([*([error.remedy] if error.remedy else []), *notes])
        raise InputError(error.what, where=error.where, remedy=remedy) from error


def find_model(name: str) -> Predictor:
    """Load a model by its folder, by its exported file NAME.onnx or by the name of a bundled one.

    Raises
    ------
    InputError
        When there is neither, or the folder is damaged.
    """
    from tapetum.models import load_predictor, pretrained

    if Path(name).exists() or Path(name).suffix.lower() == ".onnx" or Path(name).name != name:
        return load_predictor(name)
    try:
        return pretrained(name)
    except InputError as error:
        what = "is neither a model's folder or .onnx file nor the name of a bundled model"
        raise InputError(what, where=name, remedy=error.remedy) from error
