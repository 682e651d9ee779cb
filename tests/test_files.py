"""Files are whole or not there, and the system's refusals become one clear line."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from pathlib import Path

import pytest

from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder, sha256_file, told_when_full


def test_a_file_appears_whole_with_usual_permissions(tmp_path: Path) -> None:
    out = tmp_path / "new" / "deep" / "a.json"
    with atomic_file(out) as part:
        assert part.parent == out.parent and part.suffix == ".json"
        part.write_text("whole")
        assert not out.exists()
    assert out.read_text() == "whole" and list(out.parent.iterdir()) == [out]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(out.stat().st_mode) == 0o666 & ~umask


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    out = tmp_path / "a.txt"
    out.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_file(out) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert out.read_text() == "old" and list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("make", [atomic_file, atomic_folder])
def test_a_failure_leaves_no_new_folders(tmp_path: Path, make) -> None:
    with pytest.raises(RuntimeError), make(tmp_path / "new" / "deep" / "a"):
        raise RuntimeError
    assert not list(tmp_path.iterdir())


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "set.zarr"
    with atomic_folder(out) as part:
        (part / "one").write_text("1")
        assert not out.exists()
    assert (out / "one").read_text() == "1" and list(tmp_path.iterdir()) == [out]
    with pytest.raises(InputError, match=r"set\.zarr: exists already"), atomic_folder(out):
        raise AssertionError("not reached")


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_folder_is_replaced_only_by_a_whole_one(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "set"
    if kind == "file":
        out.write_text("old")
    else:
        out.mkdir()
        (out / "old").write_text("old")
    with pytest.raises(RuntimeError), atomic_folder(out, overwrite=True):
        raise RuntimeError
    assert (out if kind == "file" else out / "old").read_text() == "old"
    with atomic_folder(out, overwrite=True) as part:
        (part / "new").write_text("new")
    assert [path.name for path in out.iterdir()] == ["new"] and list(tmp_path.iterdir()) == [out]


def test_the_old_folder_comes_back_when_the_last_rename_fails(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tapetum.files.exchange", lambda one, other: False)
    out = tmp_path / "set"
    out.mkdir()
    (out / "old").write_text("old")
    rename = Path.rename

    def refused(self: Path, to: Path) -> Path:
        if self.name.endswith(".part"):
            raise OSError(errno.ENOSPC, "No space left on device", str(to))
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(InputError, match="no room left"), atomic_folder(out, overwrite=True):
        pass
    assert (out / "old").read_text() == "old" and list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "no room left on the disk; free some space"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "no room left on the disk"),
        (OSError("arrow: [errno 28] No space left on device"), "no room left on the disk"),
        # Safetensors raises an error of its own.
        (RuntimeError("I/O error: No space left on device (os error 28)"), "no room left on the disk"),
        (OSError(errno.EFBIG, "File too large"), "the largest size allowed here; write less"),
        (RuntimeError("I/O error: File too large (os error 27)"), "the largest size allowed here"),
        (PermissionError(errno.EACCES, "Permission denied"), "may not be written; choose a folder you own"),
        (OSError(errno.EROFS, "Read-only file system"), "may not be written"),
        (IsADirectoryError(errno.EISDIR, "Is a directory"), "cannot be written (Is a directory)"),
    ],
)
def test_refusals_become_one_line(tmp_path: Path, error: Exception, words: str) -> None:
    with pytest.raises(InputError) as raised, told_when_full(tmp_path / "a.bin"):
        raise error
    assert str(raised.value).startswith(f"{tmp_path / 'a.bin'}: ") and words in str(raised.value)
    assert raised.value.__cause__ is error


def test_other_errors_pass(tmp_path: Path) -> None:
    elsewhere = PermissionError(errno.EACCES, "Permission denied", "/somewhere/else/in.png")
    beside = PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "in.png"))
    missing = FileNotFoundError(errno.ENOENT, "No such file", str(tmp_path / "in.png"))
    for error in (elsewhere, beside, missing, ValueError("no"), InputError("No space left in the margin")):
        with pytest.raises(type(error)) as raised, told_when_full(tmp_path / "a.bin"):
            raise error
        assert raised.value is error


@pytest.mark.parametrize("make", [atomic_file, atomic_folder])
@pytest.mark.parametrize("below", ["a", "deep/er/a"])
def test_a_file_where_a_folder_should_be(tmp_path: Path, make, below: str) -> None:
    (tmp_path / "file").write_text("dear")
    with pytest.raises(InputError) as raised, make(tmp_path / "file" / below):
        raise AssertionError("not reached")
    assert f"{tmp_path / 'file'} is a file, not a folder" in str(raised.value)
    assert (tmp_path / "file").read_text() == "dear" and len(list(tmp_path.iterdir())) == 1


def test_a_folder_where_a_file_should_be(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="cannot be written"), atomic_file(tmp_path / "a") as part:
        part.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose another path"), atomic_file(tmp_path / ("a" * 300)):
        raise AssertionError("not reached")


def test_a_real_full_device() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("the system has no /dev/full")
    with pytest.raises(InputError, match="/dev/full: no room left on the disk"), told_when_full(full):
        full.write_bytes(b"x")


def test_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert sha256_file(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()
