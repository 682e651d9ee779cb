"""Files that are either whole or not there: write under a temporary name, then rename."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tapetum.errors import InputError

__all__ = ["atomic_file", "atomic_folder", "sha256_file", "told_when_full"]


_FULL = (errno.ENOSPC, errno.EDQUOT)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_IMPOSSIBLE = (errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTEMPTY)


@contextlib.contextmanager
def told_when_full(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the system's errors of writing (no room, no permission, no such place) into one clear line about `path`.

    An error that names a file elsewhere passes through: it is not about what is written here.

    Raises
    ------
    InputError
        In place of an error that a user can mend.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        told = _told(error, Path(path))
        if told is None:
            raise
        raise told from error


def _told(error: Exception, path: Path) -> InputError | None:
    """Say what an error of writing `path` means to its user; None for any other error."""
    number = error.errno if isinstance(error, OSError) else None
    # Arrow, FFmpeg and safetensors pass the number on only in their text, the last one in an error of its own.
    text = str(error)
    if number in _FULL or "No space left" in text or "Disk quota exceeded" in text:
        return InputError("no room left on the disk", where=path, remedy="free some space or write elsewhere")
    if number == errno.EFBIG or "File too large" in text:
        remedy = "write less or to another file system"
        return InputError("the file has the largest size allowed here", where=path, remedy=remedy)
    if not isinstance(error, OSError) or not _concerns(error, path):
        return None
    if number in _FORBIDDEN:
        return InputError("may not be written", where=path, remedy="choose a folder you own")
    if number in _IMPOSSIBLE:
        above = next((parent for parent in path.parents if parent.exists()), None)
        if above is not None and not above.is_dir():
            return InputError(f"{above} is a file, not a folder", where=path, remedy="choose another path")
        return InputError(f"cannot be written ({error.strerror})", where=path, remedy="choose another path")
    return None


def _concerns(error: OSError, path: Path) -> bool:
    """Whether an error is about `path`, something beside or inside it, or a folder above it, as far as it says."""
    if not isinstance(error.filename, str):
        return True
    named, target = Path(error.filename).absolute(), path.absolute()
    return named.is_relative_to(target.parent) or target.is_relative_to(named)


def _make_parents(target: Path) -> list[Path]:
    """Make the folders above `target`; return those that were not there, the deepest first."""
    made: list[Path] = []
    for parent in target.absolute().parents:
        if parent.exists():
            break
        made.append(parent)
    target.parent.mkdir(parents=True, exist_ok=True)
    return made


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):  # something else is in it by now
            folder.rmdir()


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes the name `path`, on failure it is removed."""
    target = Path(path)
    with told_when_full(target):
        made = _make_parents(target)
        try:
            # The suffix stays last, so that writers which go by it still recognise the format.
            kind = f".part{target.suffix}"
            handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=kind, dir=target.parent)
        except BaseException:
            _remove_empty(made)
            raise
        os.close(handle)
        part = Path(name)
        try:
            yield part
            umask = os.umask(0)
            os.umask(umask)
            part.chmod(0o666 & ~umask)
            part.replace(target)
        except BaseException:
            part.unlink(missing_ok=True)
            _remove_empty(made)
            raise


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it takes the name `path`, on failure it is removed.

    Raises
    ------
    InputError
        When `path` exists and `overwrite` is false.
    """
    target = Path(path)
    with told_when_full(target):
        if target.exists() and not overwrite:
            raise InputError("exists already", where=target, remedy="choose another name or remove it first")
        made = _make_parents(target)
        try:
            part = Path(tempfile.mkdtemp(prefix=f".{target.name}-", suffix=".part", dir=target.parent))
        except BaseException:
            _remove_empty(made)
            raise
        old = None
        try:
            yield part
            umask = os.umask(0)
            os.umask(umask)
            part.chmod(0o777 & ~umask)
            if target.exists():
                # Two renames: the old one stays whole until the new one stands in its place.
                old = target.with_name(f".{target.name}-{os.getpid()}.old")
                target.rename(old)
            part.rename(target)
        except BaseException:
            if old is not None and old.exists():
                old.rename(target)
            shutil.rmtree(part, ignore_errors=True)
            _remove_empty(made)
            raise
        if old is not None:
            shutil.rmtree(old) if old.is_dir() else old.unlink()


def sha256_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
