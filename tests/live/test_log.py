"""The events' log: what was written is there after anything."""

from __future__ import annotations

import contextlib
import signal
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
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


def endless(path: Path, told: Connection) -> None:
    log = Log(path)
    while True:
        told.send(log.add(Event("a", "new", "seen", 1), b"x" * 5000))


def test_a_killed_process_loses_nothing_that_it_wrote(tmp_path: Path, processes: BaseContext) -> None:
    told, sent = processes.Pipe(duplex=False)
    process = processes.Process(target=endless, args=(tmp_path / "log.db", sent))
    process.start()
    sent.close()
    written = 0
    for _ in range(50):
        written = told.recv()
    process.kill()
    with contextlib.suppress(EOFError, OSError):
        while True:
            written = told.recv()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    log = Log(tmp_path / "log.db")
    assert log.newest >= written
    assert written in {one["number"] for one in log.events(after=written - 10)}
    assert log._base.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_what_is_kept_in_memory_is_bounded_and_numbers_go_on() -> None:
    log = Log(":memory:", most=300, most_pictures=120)
    for n in range(1000):
        assert log.add(event(n), b"x") == n + 1
    count = log._base.execute("SELECT count(*), count(picture) FROM events").fetchone()
    # Trimmed now and then.
    assert 300 <= count[0] <= 400 and 120 <= count[1] <= 220
    assert [one["id"] for one in log.events(most=2)] == ["id998", "id999"]
    assert log.picture(1000) == b"x" and log.picture(720) is None
    usual = Log(":memory:")
    assert usual.most == 10_000 and usual.most_pictures == 1_000


def full(log: Log) -> None:
    """Let the file of a log grow no more."""
    size = log._base.execute("PRAGMA page_count").fetchone()[0]
    log._base.execute(f"PRAGMA max_page_count={size}")


def alert(n: int) -> Event:
    return Event(f"id{n}", "update", "alert", 1, "here")


def test_a_full_disk_keeps_events_in_memory_and_writes_them_when_there_is_room(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    log.add(alert(0))
    full(log)
    while not log.fault:
        log.add(alert(1), b"x" * 500)
    assert log.fault == "the log cannot be written (database or disk is full)"
    last = log.add(alert(2), b"seen")
    assert log.newest == last and log.picture(last) == b"seen"
    assert [one["id"] for one in log.events(after=last - 2)] == ["id1", "id2"]
    (newest, done), *_ = log.alerts()[0]
    waiting = log.alerts()[1]
    assert newest["number"] == last and done is None and waiting == last
    assert log.acknowledge(last, 7) == 1 and log.alerts()[1] == waiting - 1
    assert log.alerts()[0][0][1] == 7
    # Of those that wait the newest are kept.
    for n in range(1100):
        log.add(event(n))
    assert log._base.execute("SELECT count(*) FROM waiting.events").fetchone()[0] <= 1001
    log._base.execute("PRAGMA max_page_count=100000")
    log.add(alert(3))
    assert log.fault == ""
    log.close()
    again = Log(tmp_path / "log.db")
    assert again.newest == last + 1101 and len(again.events(after=last, most=1000)) == 1000
    assert again.events(after=last + 101, most=1)[0]["number"] == last + 1101
    assert again._base.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_an_alert_in_memory_keeps_its_acknowledgement_when_it_is_written(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    full(log)
    while not log.fault:
        log.add(alert(1), b"x" * 500)
    number = log.add(alert(2))
    log.acknowledge(None, 9)
    log._base.execute("PRAGMA max_page_count=100000")
    log.add(alert(3))
    log.close()
    found, waiting = Log(tmp_path / "log.db").alerts()
    assert waiting == 1 and {one["number"]: done for one, done in found}[number] == 9


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
