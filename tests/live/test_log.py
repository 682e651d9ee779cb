"""The events' log: what was written is there after anything."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tapetum.errors import InputError
from tapetum.live.events import Event, Ignored
from tapetum.live.log import Log

_DAY = 86400 * 10**9


def event(n: int, utc_ns: int = 1) -> Event:
    return Event(f"id{n}", "new", "seen", utc_ns)


def test_events_are_read_by_number_and_pictures_apart(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    assert [log.add(event(n), b"jpeg" if n == 1 else None) for n in range(5)] == [1, 2, 3, 4, 5]
    assert [(one["number"], one["id"], one["picture"]) for one in log.events(after=1, most=2)] == [
        (4, "id3", False),
        (5, "id4", False),
    ]
    assert (log.picture(2), log.picture(1), log.picture(99), log.newest) == (b"jpeg", None, None, 5)


def test_old_events_and_pictures_expire_and_numbers_go_on(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db", days=2, picture_days=1)
    for n, age in enumerate((3, 1.5, 0.5)):
        log.add(event(n, round((10 - age) * _DAY)), b"x")
    log.expire(10 * _DAY)
    assert [(one["id"], one["picture"]) for one in log.events()] == [("id1", False), ("id2", True)]
    log.close()
    again = Log(tmp_path / "log.db", days=2, picture_days=1)
    assert again.newest == 3 and again.add(event(9)) == 4


def test_ignored_cameras_are_kept(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    one = Ignored(3.0, 4.0, 5.0)
    log.ignore(one)
    log.ignore(one)
    log.close()
    log = Log(tmp_path / "log.db")
    assert log.ignored() == (one,)
    log.forget_ignored()
    assert log.ignored() == ()


def test_a_killed_process_loses_nothing_that_it_wrote(tmp_path: Path) -> None:
    code = (
        "import sys; from tapetum.live.log import Log; from tapetum.live.events import Event\n"
        "log = Log(sys.argv[1])\n"
        "n = 0\n"
        "while True: print(log.add(Event('a', 'new', 'seen', 1), b'x' * 5000), flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "log.db")], stdout=subprocess.PIPE)
    assert process.stdout is not None
    written = [int(process.stdout.readline()) for _ in range(50)][-1]
    os.kill(process.pid, signal.SIGKILL)
    rest = process.stdout.read().split()
    process.wait()
    written = max([written, *(int(one) for one in rest[:-1])])
    log = Log(tmp_path / "log.db")
    assert log.newest >= written
    assert written in {one["number"] for one in log.events(after=written - 10)}
    assert log._base.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_a_file_that_is_no_log_a_newer_one_and_a_missing_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.db").write_bytes(b"no database at all" * 100)
    with pytest.raises(InputError, match=r"a\.db: cannot be used as a log .*name another file"):
        Log(tmp_path / "a.db")
    log = Log(tmp_path / "b.db")
    log._base.execute("PRAGMA user_version=9")
    log.close()
    with pytest.raises(InputError, match="newer Tapetum"):
        Log(tmp_path / "b.db")
    with pytest.raises(InputError, match="make the folder"):
        Log(tmp_path / "none" / "c.db")
    with pytest.raises(InputError, match="days: must be positive, is 0"):
        Log(":memory:", days=0)
