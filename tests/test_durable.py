"""Kills, crashes and second commands: what was promised is there afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from tapetum import files
from tapetum.durable import exchange, part_name, sole_writer
from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder

linux = pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for locks and exchanges")


def started(code: str, folder: Path) -> subprocess.Popen[str]:
    """Start Python in a folder; return when it has said that it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=folder, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def killed(code: str, folder: Path) -> None:
    process = started(code, folder)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.stdout is not None
    process.stdout.close()


WRITING = """
    import time
    from tapetum.files import {make}
    with {make}("a", **{options}) as part:
        {fill}
        print("ready", flush=True)
        time.sleep(60)
"""


def writing(make: str) -> str:
    fill = 'part.write_text("new")' if make == "atomic_file" else '(part / "x").write_text("new")'
    options = "{}" if make == "atomic_file" else "{'overwrite': True}"
    return WRITING.format(make=make, options=options, fill=fill)


@pytest.mark.parametrize("make", ["atomic_file", "atomic_folder"])
def test_what_a_killed_run_left_is_cleaned_by_the_next(tmp_path: Path, make: str) -> None:
    killed(writing(make), tmp_path)
    left = [path.name for path in tmp_path.iterdir()]
    assert left and all(name.startswith(".a") for name in left)
    with getattr(files, make)(tmp_path / "a") as part:
        if make == "atomic_file":
            part.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@linux
def test_what_a_living_run_owns_stays(tmp_path: Path) -> None:
    process = started(writing("atomic_file"), tmp_path)
    try:
        before = {path.name for path in tmp_path.iterdir()}
        with atomic_file(tmp_path / "a") as part:
            part.write_text("mine")
        assert before < {path.name for path in tmp_path.iterdir()} == before | {"a"}
    finally:
        process.kill()
        process.communicate()


@linux
def test_of_two_commands_that_write_one_folder_one_is_refused(tmp_path: Path) -> None:
    process = started(writing("atomic_folder"), tmp_path)
    try:
        refused = pytest.raises(InputError, match=f"a: is being written by process {process.pid}; wait for it")
        with refused, atomic_folder(tmp_path / "a", overwrite=True):
            pytest.fail("entered")
    finally:
        process.kill()
        process.communicate()
    with atomic_folder(tmp_path / "a") as part:
        (part / "x").write_text("mine")
    assert (tmp_path / "a" / "x").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_a_thread_may_take_its_lock_again_and_another_may_not(tmp_path: Path) -> None:
    told: list[str] = []

    def other() -> None:
        try:
            with sole_writer(tmp_path / "a"):
                told.append("entered")
        except InputError as error:
            told.append(str(error))

    with sole_writer(tmp_path / "a"), sole_writer(tmp_path / "a"):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(told) == 1 and "is being written by process" in told[0]
    other()
    assert told[1] == "entered" and not list(tmp_path.iterdir())


@linux
def test_two_folders_change_names_in_one_step(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "is").write_text(name)
    if not exchange(tmp_path / "a", tmp_path / "b"):
        pytest.skip("this file system cannot exchange names")
    assert (tmp_path / "a" / "is").read_text() == "b" and (tmp_path / "b" / "is").read_text() == "a"


def test_a_kill_between_two_renames_leaves_the_old_folder_to_be_put_back(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "x").write_text("old")
    killed(
        """
        import time
        from pathlib import Path
        from tapetum import files
        files.exchange = lambda one, other: False  # as where the system has no such thing
        rename = Path.rename
        def slow(self, to):
            if self.name.endswith(".part"):
                print("ready", flush=True)
                time.sleep(60)
            return rename(self, to)
        Path.rename = slow
        with files.atomic_folder("a", overwrite=True) as part:
            (part / "x").write_text("new")
        """,
        tmp_path,
    )
    assert not (tmp_path / "a").exists()
    with pytest.raises(InputError, match="exists already"), atomic_folder(tmp_path / "a"):
        pytest.fail("entered")
    assert (tmp_path / "a" / "x").read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["a"]


@linux
def test_at_every_moment_of_a_replacement_there_is_a_whole_folder(tmp_path: Path) -> None:
    """A reader that never stops looking never finds the folder missing or empty."""
    (tmp_path / "probe1").mkdir(), (tmp_path / "probe2").mkdir()
    if not exchange(tmp_path / "probe1", tmp_path / "probe2"):
        pytest.skip("this file system cannot exchange names")
    out = tmp_path / "a"
    with atomic_folder(out) as part:
        (part / "x").write_text("0")
    missing, stop = [0], threading.Event()

    def look() -> None:
        while not stop.is_set():
            missing[0] += not out.exists()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for n in range(100):
            with atomic_folder(out, overwrite=True) as part:
                (part / "x").write_text(str(n))
    finally:
        stop.set()
        thread.join()
    assert missing == [0]


class Disk:
    """What the disk is known to hold: what was flushed before a rename, in the order of the calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[tuple[str, str]] = []
        flush, rename, replace = os.fsync, os.rename, os.replace

        def fsync(handle: int) -> None:
            self.calls.append(("flush", str(Path(f"/proc/self/fd/{handle}").readlink())))
            flush(handle)

        def renamed(one, other, **more):
            self.calls.append(("rename", str(Path(other).absolute())))
            return rename(one, other, **more)

        def replaced(one, other, **more):
            self.calls.append(("rename", str(Path(other).absolute())))
            return replace(one, other, **more)

        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(os, "rename", renamed)
        monkeypatch.setattr(os, "replace", replaced)


@linux
def test_a_file_is_on_the_disk_before_its_name_and_its_name_before_we_go_on(tmp_path: Path, monkeypatch) -> None:
    disk = Disk(monkeypatch)
    with atomic_file(tmp_path / "new" / "a.txt") as part:
        part.write_text("whole")
    kinds = [(what, Path(where).name) for what, where in disk.calls]
    assert kinds == [("flush", part.name), ("rename", "a.txt"), ("flush", "new"), ("flush", tmp_path.name)]


@linux
def test_a_folder_is_on_the_disk_with_all_its_files_before_its_name(tmp_path: Path, monkeypatch) -> None:
    disk = Disk(monkeypatch)
    with atomic_folder(tmp_path / "a") as part:
        (part / "deep").mkdir()
        (part / "deep" / "x").write_text("x")
        (part / "y").write_text("y")
    names = [(what, Path(where).name) for what, where in disk.calls]
    renamed = names.index(("rename", "a"))
    for name in ("x", "y", "deep", part.name):
        assert ("flush", name) in names[:renamed]
    assert names.index(("flush", "x")) < names.index(("flush", "deep"))
    assert ("flush", tmp_path.name) in names[renamed:]


def test_other_threads_keep_their_permissions(tmp_path: Path) -> None:
    """The mask of new files is the whole process's: it must not be touched while others make files."""
    seen: set[int] = set()
    stop = threading.Event()

    def make() -> None:
        while not stop.is_set():
            path = tmp_path / "other"
            path.unlink(missing_ok=True)
            os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o666))
            seen.add(path.stat().st_mode & 0o777)

    before = os.umask(0o077)
    thread = threading.Thread(target=make)
    thread.start()
    try:
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            with atomic_file(tmp_path / "x") as part:
                part.write_text("x")
    finally:
        stop.set()
        thread.join()
        os.umask(before)
    assert seen == {0o600} and (tmp_path / "x").stat().st_mode & 0o777 == 0o600


def test_a_name_says_whose_it_is(tmp_path: Path) -> None:
    name = part_name(tmp_path / "a.zarr", end=".part").name
    assert name.startswith(".a.zarr-") and f"-{os.getpid()}-" in name and name.endswith(".part")


LONG = """
    import signal, sys, time, types
    {before}
    command = types.ModuleType("tapetum.cli.app")
    command.main = lambda: (print("ready", flush=True), time.sleep({seconds}))[1] or 0
    sys.modules["tapetum.cli.app"] = command
    from tapetum.__main__ import main
    sys.exit(main())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
def test_a_scheduler_and_a_closing_terminal_end_a_command_as_ctrl_c_does(tmp_path: Path) -> None:
    for number in (signal.SIGTERM, signal.SIGHUP):
        # The tests themselves may run where these are ignored.
        usual = f"signal.signal({int(number)}, signal.SIG_DFL)"
        process = started(LONG.format(before=usual, seconds=60), tmp_path)
        process.send_signal(number)
        assert process.wait(20) == 130
        assert process.stdout is not None
        process.stdout.close()
    # As `nohup` has it.
    process = started(LONG.format(before="signal.signal(signal.SIGHUP, signal.SIG_IGN)", seconds=1), tmp_path)
    process.send_signal(signal.SIGHUP)
    assert process.wait(20) == 0 and process.stdout is not None
    process.stdout.close()
