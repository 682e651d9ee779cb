"""Checks of output paths: what --overwrite may replace, and what interrupted work keeps there; one rule for all
commands."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tapetum.errors import InputError, StoppedError
from tapetum.files import CONTENTS, is_content, reserved, told_when_full

__all__ = ["check_output", "filling", "says_what_is_kept"]

_UNFINISHED = ".tapetum-unfinished"


def check_output(
    out: Path | None, force: bool, holds: str | None = None, *, sources: Sequence[Path | str] = ()
) -> None:
    """Refuse to replace an existing output, and a source always, before any work; no check for None.

    A name where nothing may be written is refused too. With `--overwrite` a file may be replaced by a file, and a
    folder by one that `holds` the same, a key of `tapetum.files.CONTENTS`. The writers keep the existing
    output until the new one is complete.
    """
    if out is None:
        return
    with told_when_full(out):
        above = next(parent for parent in out.absolute().parents if parent.exists())
    if not above.is_dir():
        raise InputError(f"{above} is a file, not a folder", where=out, remedy="choose another path")
    if not os.access(above, os.W_OK):
        raise InputError("may not be written", where=out, remedy="choose a folder you own")
    if not (out.exists() or out.is_symlink()):
        return
    for source in map(Path, sources):
        if not source.exists():
            continue
        if source.samefile(out):
            raise InputError("is what is read", where=out, remedy="name another file to write")
        if source.resolve().is_relative_to(out.resolve()):
            raise InputError("holds what is read", where=out, remedy="name another folder to write")
        if out.resolve().is_relative_to(source.resolve()) and any(
            (source / marker).is_file() for ((marker, _), *_) in CONTENTS.values()
        ):
            raise InputError(f"is a part of {source}, which is read", where=out, remedy="name another file to write")
    if not force:
        raise InputError("exists already", where=out, remedy="choose another name or pass --overwrite")
    if not (not out.is_dir() if holds is None else is_content(out, holds)):
        what = "is a folder" if holds is None else f"is no {holds} that may be replaced"
        raise InputError(what, where=out, remedy="choose another name or remove it yourself")


@contextlib.contextmanager
def filling(folder: Path, names: Mapping[str, str | None], force: bool, *, work: Path | None = None) -> Iterator[None]:
    """Apply `check_output` to all that a command writes into a folder: names, each with what it holds.

    Outputs of an interrupted run are not refused: a hidden file in the folder lists their names until the work is done.
    `work` is where the command keeps what it need not do again; Ctrl-C says so where anything is there.
    """
    begun = folder / _UNFINISHED
    left = begun.read_text(encoding="utf-8").splitlines() if begun.is_file() else []
    stood = folder.exists()
    if stood and not folder.is_dir():
        raise InputError("is a file, not a folder", where=folder, remedy="choose another name")
    for name, holds in names.items():
        check_output(folder / name, force or name in left, holds)
    with reserved(folder):
        with told_when_full(folder):
            folder.mkdir(parents=True, exist_ok=True)
            begun.write_text("\n".join({*left, *names}), encoding="utf-8")
        try:
            yield
        except BaseException as error:
            kept = [folder] if any((folder / name).exists() for name in names) else []
            if not kept:
                begun.unlink(missing_ok=True)
                if not stood:
                    # The folder may hold something else by now.
                    with contextlib.suppress(OSError):
                        folder.rmdir()
            if work is not None and work.is_dir() and any(work.iterdir()):
                kept = [work]
            if kept and isinstance(error, KeyboardInterrupt):
                raise StoppedError(f"what is done is kept in {kept[0]}, and the same command goes on") from error
            raise
        begun.unlink(missing_ok=True)


@contextlib.contextmanager
def says_what_is_kept(how: str = "") -> Iterator[None]:
    """Add the notes of an error, which say what interrupted work has kept, to its one-line message.

    `how` says how to resume after Ctrl-C.
    """
    try:
        yield
    except (KeyboardInterrupt, InputError) as error:
        notes = getattr(error, "__notes__", [])
        if not notes:
            raise
        if isinstance(error, KeyboardInterrupt):
            raise StoppedError("; ".join(filter(None, [*notes, how]))) from error
        remedy = "; ".join(filter(None, [error.remedy, *notes]))
        raise InputError(error.what, where=error.where, remedy=remedy) from error
