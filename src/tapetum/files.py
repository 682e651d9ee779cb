"""Files that are either whole or absent: write under a temporary name, then rename."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from tapetum.durable import clean_leftovers, exchange, part_name, sole_writer, sync, sync_tree
from tapetum.errors import InputError

__all__ = [
    "CONTENTS",
    "atomic_file",
    "atomic_folder",
    "check_replaceable",
    "free_name",
    "is_content",
    "read_text",
    "replace_folder",
    "reserved",
    "sha256_file",
    "told_when_full",
]

CONTENTS = {
    "tapetum-dataset": (("zarr.json", "tapetum-dataset"),),
    "tapetum-recording": (("recording.json", "tapetum-recording"),),
    "tapetum-model": (("model.json", "tapetum-model"),),
    "tapetum-evaluation": (("numbers.json", "tapetum-evaluation"),),
    "store of images": (("zarr.json", "pitch_m"), ("irradiance/zarr.json", "")),
}
"""By content of a folder: the files in it that identify the content, each with the word to find there."""

_FULL = (errno.ENOSPC, errno.EDQUOT)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_IMPOSSIBLE = (errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTEMPTY)


def read_text(path: str | os.PathLike[str], remedy: str, encoding: str = "utf-8") -> str:
    """Return a text file's content; raises an InputError with the remedy where it is missing, no file or no text."""
    try:
        return Path(path).read_text(encoding)
    except UnicodeDecodeError as error:
        raise InputError("is no text", where=path, remedy=remedy) from error
    except FileNotFoundError as error:
        raise InputError("no such file", where=path, remedy=remedy) from error
    except PermissionError as error:
        raise InputError("may not be read", where=path, remedy="check its permissions") from error
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", where=path, remedy=remedy) from error


@contextlib.contextmanager
def told_when_full(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the system's errors of writing (no room, no permission, no such place) into one InputError about `path`.

    An error that names a file elsewhere passes through: it is not about what is written here.
    """
    try:
        yield
    except Exception as error:
        told = None if isinstance(error, InputError) else _told(error, Path(path))
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
    """Whether an error is about `path`, its temporary names, what they hold, or a folder above, as far as it says."""
    if not isinstance(error.filename, str):
        return True
    named, target = Path(error.filename).absolute(), path.absolute()
    if target.is_relative_to(named):
        return True
    # Temporary names carry that of the target; what else stands beside it may be what is read.
    return named.is_relative_to(target.parent) and target.stem in named.relative_to(target.parent).parts[0]


@contextlib.contextmanager
def _parents(target: Path) -> Iterator[None]:
    """Make the folders above `target` and flush their names and its own; on failure remove those that were made."""
    made = list(itertools.takewhile(lambda parent: not parent.exists(), target.absolute().parents))
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
        for path in (target.absolute(), *made):
            sync(path.parent)
    except BaseException:
        for folder in made:
            with contextlib.suppress(OSError):  # something else is in it by now
                folder.rmdir()
        raise


@contextlib.contextmanager
def reserved(path: str | os.PathLike[str]) -> Iterator[None]:
    """Make the folder above `path`, and let no other command write `path` meanwhile (`durable.sole_writer`).

    Raises
    ------
    InputError
        When another command is writing it, or nothing may be written there.
    """
    with contextlib.ExitStack() as held:
        with told_when_full(path):
            Path(path).absolute().parent.mkdir(parents=True, exist_ok=True)
            held.enter_context(sole_writer(path))
        yield


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes the name `path`, on failure it is removed.

    The new file is on the disk before it takes the name, and the name before this returns: after a loss of power there
    is the old file or the new one, whole.
    """
    target = Path(path)
    with told_when_full(target), _parents(target):
        clean_leftovers(target)
        # The suffix stays last, so that writers which go by it still recognise the format.
        part = part_name(target, end=f".part{target.suffix}")
        try:
            with part.open("xb") as empty:
                mode = stat.S_IMODE(os.fstat(empty.fileno()).st_mode)
            yield part
            # Some writers keep a file to its owner.
            part.chmod(mode)
            sync(part)
            part.replace(target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def is_content(path: Path, holds: str) -> bool:
    """Return whether a path is a folder that holds a content, a key of `CONTENTS`."""
    try:
        return all(word in (path / name).read_text(encoding="utf-8") for name, word in CONTENTS[holds])
    except (OSError, UnicodeDecodeError):
        return False


def check_replaceable(path: Path, holds: str | None = None, *, overwrite: bool) -> None:
    """Raise an InputError when `path` exists and `overwrite` is false, or it is not what is to take its place.

    `holds`, a key of `CONTENTS`, is what alone may be replaced; None for anything.
    """
    if not path.exists() and not path.is_symlink():
        return
    if not overwrite:
        raise InputError("exists already", where=path, remedy="choose another name or remove it first")
    if holds is not None and not is_content(path, holds):
        what = f"is no {holds} that may be replaced"
        raise InputError(what, where=path, remedy="choose another name or remove it yourself")


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], holds: str | None = None, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it takes the name `path`, on failure it is removed.

    All of it is on the disk before it takes the name. A folder that it replaces stands until then.

    Raises
    ------
    InputError
        When `path` may not be replaced (`check_replaceable`), or another command is writing it.
    """
    target = Path(path)
    with told_when_full(target), _parents(target), sole_writer(target):
        clean_leftovers(target)
        check_replaceable(target, holds, overwrite=overwrite)
        part = part_name(target, end=".part")
        try:
            part.mkdir()
            yield part
            replace_folder(part, target)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise


def replace_folder(new: Path, target: Path) -> None:
    """Let a folder take the name of another, or a free one beside it, once all of it is on the disk.

    Where the system can exchange two names there is a whole folder at `target` at every moment; elsewhere the old one
    is set aside for a moment, from where `clean_leftovers` puts it back after a kill.
    """
    sync_tree(new)
    if not target.exists() and not target.is_symlink():
        new.rename(target)
        sync(target.parent)
        return
    if exchange(new, target):
        old = new
    else:
        old = part_name(target, end=".old")
        target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            old.rename(target)
            raise
    sync(target.parent)
    shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()


def free_name(path: Path, word: str) -> Path:
    """Return a name beside `path` that nothing has: `NAME.word.SUFFIX`, `NAME.word-2.SUFFIX` and so on."""
    numbers = itertools.chain([""], (f"-{n}" for n in itertools.count(2)))
    names = (path.with_name(f"{path.stem}.{word}{number}{path.suffix}") for number in numbers)
    return next(name for name in names if not name.exists() and not name.is_symlink())


def sha256_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
