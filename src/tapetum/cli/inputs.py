"""What several commands ask of their arguments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tapetum.errors import InputError

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["check_replaceable", "find_model"]


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
