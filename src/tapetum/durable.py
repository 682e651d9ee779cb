"""What survives a crash, and who may write: flushing to the disk, exchanging two folders in one step, locks."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import os
import re
import secrets
import shutil
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from tapetum.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: no lock is taken there
    fcntl = None

__all__ = ["clean_leftovers", "exchange", "part_name", "sole_writer", "sync", "sync_tree"]

# What a file system answers that cannot flush folders, lock or exchange.
_CANNOT = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF)
_AT_FDCWD, _EXCHANGE = -100, 2
_held: dict[Path, int] = {}
_guard = threading.Lock()


def sync(path: str | os.PathLike[str]) -> None:
    """Return when a file's content, or a folder's list of names, is on the disk."""
    folder = Path(path).is_dir()
    if os.name == "nt" and folder:
        return
    try:
        handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    except PermissionError:
        if folder:  # one may write into a folder that one may not read
            return
        raise
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _CANNOT:
            raise
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush every file of a folder, then every folder from the deepest up."""
    for place, _, files in os.walk(folder, topdown=False):
        for name in files:
            sync(Path(place) / name)
        sync(place)


def exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step, so that at no moment either is missing; False where the system cannot."""
    if sys.platform != "linux":
        return False
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    if call(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _CANNOT:
        return False
    raise OSError(number, os.strerror(number), str(other))


def _home() -> str:
    """An identifier of this machine, or of this container, which its processes share."""
    try:
        space = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        space = ""
    return hashlib.blake2b(f"{socket.gethostname()} {space}".encode(), digest_size=3).hexdigest()


def part_name(target: Path, *, end: str) -> Path:
    """Return a hidden name beside `target` that says which process of which machine it belongs to."""
    return target.with_name(f".{target.name}-{_home()}-{os.getpid()}-{secrets.token_hex(3)}{end}")


def clean_leftovers(target: Path) -> None:
    """Remove what runs that were killed left hidden beside `target`; what a living process owns stays.

    A folder that was set aside to be replaced, and whose place is empty, is put back.
    """
    own = re.compile(rf"\.{re.escape(target.name)}-{_home()}-(\d+)-[0-9a-f]{{6}}\.(part.*|old)")
    try:
        beside = list(target.parent.iterdir())
    except OSError:
        return
    for path in beside:
        found = own.fullmatch(path.name)
        # Signal 0 would end a process on Windows: there all of them count as living.
        if found is None or os.name == "nt" or _lives(int(found[1])):
            continue
        with contextlib.suppress(OSError):
            if found[2] == "old" and not target.exists():
                path.rename(target)
            elif path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        pass
    return True


@contextlib.contextmanager
def sole_writer(path: str | os.PathLike[str]) -> Iterator[None]:
    """Let no other command write `path` meanwhile. Within a thread it may be taken again.

    The lock is the system's, on the hidden file `.NAME.lock`: it ends with the process, however that ends. Where a
    file system has no locks, none is taken.

    Raises
    ------
    InputError
        When another process or thread is writing it.
    """
    target, own = Path(path).absolute(), threading.get_ident()
    with _guard:
        holder = _held.get(target)
        if holder is None:
            _held[target] = own
    if holder == own:
        yield
        return
    if holder is not None:
        raise _busy(target, os.getpid())
    handle = None
    try:
        handle = _locked(target)
        yield
    finally:
        with _guard:
            del _held[target]
        if handle is not None:
            # Removed while it is still locked: a process that waits for this very file finds that it is gone.
            _lock_file(target).unlink(missing_ok=True)
            os.close(handle)


def _lock_file(target: Path) -> Path:
    return target.with_name(f".{target.name}.lock")


def _locked(target: Path) -> int | None:
    """Take the lock; return its open file, None where there are no locks."""
    if fcntl is None:
        return None
    path = _lock_file(target)
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            words = os.pread(handle, 20, 0)
            os.close(handle)
            if error.errno in _CANNOT:
                return None
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise
            raise _busy(target, int(words) if words.isdigit() else None) from error
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), path.stat()):
                # Who it is only serves the message: a full disk is no reason to stop here.
                with contextlib.suppress(OSError):
                    os.ftruncate(handle, 0)
                    os.write(handle, str(os.getpid()).encode())
                return handle
        # The holder before has removed it: there may be a newer one.
        os.close(handle)


def _busy(target: Path, process: int | None) -> InputError:
    who = "another command" if process is None else f"process {process}"
    return InputError(f"is being written by {who}", where=target, remedy="wait for it, or choose another name")
