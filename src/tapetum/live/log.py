"""The events' log: SQLite in write-ahead mode, which a killed process does not tear."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import time
from pathlib import Path
from typing import Any

from tapetum.errors import InputError
from tapetum.live.events import Event, Ignored

__all__ = ["Log"]

_VERSION = 1
_DAY = 86400 * 10**9
_MOST = 1000
_IN_MEMORY, _PICTURES_IN_MEMORY = 10_000, 1_000
_WAITING = 1_000  # events that wait in memory while the file cannot be written
_TRIM_EVERY = 100
_TABLES = (
    "CREATE TABLE IF NOT EXISTS {where}.events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL,"
    " utc_ns INTEGER NOT NULL, body TEXT NOT NULL, picture BLOB);"
    "CREATE INDEX IF NOT EXISTS {where}.by_time ON events (utc_ns);"
    "CREATE TABLE IF NOT EXISTS {where}.acknowledged (number INTEGER PRIMARY KEY, utc_ns INTEGER NOT NULL);"
)
# Which the file cannot take, as on a full disk, goes into the database `waiting`, in memory; both are read as one.
_BOTH = "".join(
    f"CREATE TEMP VIEW {name}_all AS SELECT * FROM main.{name} UNION ALL SELECT * FROM waiting.{name};"
    for name in ("events", "acknowledged")
)


class Log:
    """Events, pictures of them, and the ignored cameras; each write is whole on its own.

    What a file cannot take, as on a full disk, is kept in memory and read like the rest: the newest thousand events. It
    is written once that is possible again.

    Parameters
    ----------
    path
        A file, or ":memory:", which keeps the newest 10,000 events and 1,000 pictures.
    days, picture_days
        How long events, and pictures of them, are kept.
    most, most_pictures
        Newest events, and newest events with their pictures, that are kept; None: no limit. Default: those of memory.

    Attributes
    ----------
    newest
        Number of the latest event; 0 without any.
    fault
        Why the file cannot be written now; empty where it can.

    Raises
    ------
    InputError
        When the file is no log, or was written by a newer Tapetum.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        days: float = 30.0,
        picture_days: float = 7.0,
        most: int | None = None,
        most_pictures: int | None = None,
    ) -> None:
        for name, value in (
            ("days", days),
            ("picture_days", picture_days),
            ("most", most),
            ("most_pictures", most_pictures),
        ):
            if value is not None and not value > 0:
                raise InputError(f"must be positive, is {value}", where=name)
        self.days, self.picture_days = days, picture_days
        self._lock = threading.Lock()
        where = str(path)
        in_memory = where == ":memory:"
        self.most = _IN_MEMORY if in_memory and most is None else most
        self.most_pictures = _PICTURES_IN_MEMORY if in_memory and most_pictures is None else most_pictures
        self.fault = ""
        self._waits = False
        try:
            self._base = sqlite3.connect(where, check_same_thread=False, isolation_level=None)
            self._base.execute("PRAGMA journal_mode=WAL")
            # A full disk must not keep a query from its answer.
            self._base.execute("PRAGMA temp_store=MEMORY")
            version = self._base.execute("PRAGMA user_version").fetchone()[0]
            if version > _VERSION:
                raise InputError(f"was written by a newer Tapetum (version {version})", where=where)
            self._base.executescript(
                f"BEGIN; {_TABLES.format(where='main')}"
                "CREATE TABLE IF NOT EXISTS ignored (body TEXT PRIMARY KEY);"
                f"PRAGMA user_version={_VERSION}; COMMIT;"
            )
            self._base.executescript(f"ATTACH ':memory:' AS waiting; {_TABLES.format(where='waiting')} {_BOTH}")
            self.newest = int(self._base.execute("SELECT coalesce(max(number), 0) FROM events").fetchone()[0])
        except sqlite3.Error as error:
            parent = Path(where).parent
            remedy = "name another file" if parent.is_dir() else f"make the folder {parent} first"
            raise InputError(f"cannot be used as a log ({error})", where=where, remedy=remedy) from error

    def add(self, event: Event, picture: bytes | None = None) -> int:
        """Write an event, with a picture of it; return its number. Where it cannot be written, `fault` says why."""
        with self._lock:
            # A number is never used twice, also of events that were removed.
            number = max(self.newest, self._last_number()) + 1
            row = (number, event.id, event.utc_ns, json.dumps(event.as_json()), picture)
            self._write("INSERT INTO {where}.events VALUES (?,?,?,?,?)", row)
            self.newest = number
            if number % _TRIM_EVERY == 0:
                self._trim()
            return number

    def events(self, after: int = 0, most: int = 100) -> list[dict[str, Any]]:
        """Return the latest events with a number above `after`, oldest first, each with its number."""
        query = "SELECT number, body, picture IS NOT NULL FROM events_all WHERE number > ? ORDER BY number DESC LIMIT ?"
        with self._lock:
            rows = self._base.execute(query, (after, max(0, min(most, _MOST)))).fetchall()
        return [{"number": number, "picture": bool(has), **json.loads(body)} for number, body, has in reversed(rows)]

    def picture(self, number: int) -> bytes | None:
        """Return an event's picture, JPEG; None where there is none, or no more."""
        with self._lock:
            row = self._base.execute("SELECT picture FROM events_all WHERE number = ?", (number,)).fetchone()
        return None if row is None else row[0]

    def alerts(self, most: int = 50) -> tuple[list[tuple[dict[str, Any], int | None]], int]:
        """Return the latest alerts, newest first, each with when it was acknowledged, and how many wait for that."""
        kind = "json_extract(body, '$.kind') = 'alert'"
        with self._lock:
            rows = self._base.execute(
                "SELECT e.number, e.body, e.picture IS NOT NULL, a.utc_ns FROM events_all e"
                f" LEFT JOIN acknowledged_all a USING (number) WHERE {kind} ORDER BY e.number DESC LIMIT ?",
                (max(0, min(most, _MOST)),),
            ).fetchall()
            waiting = self._base.execute(
                f"SELECT count(*) FROM events_all WHERE {kind} AND number NOT IN (SELECT number FROM acknowledged_all)"
            ).fetchone()[0]
        return [
            ({"number": number, "picture": bool(has), **json.loads(body)}, done) for number, body, has, done in rows
        ], waiting

    def acknowledge(self, number: int | None, utc_ns: int) -> int:
        """Acknowledge an alert, or all; return how many there were. One that was acknowledged keeps its time."""
        which = "json_extract(body, '$.kind') = 'alert' AND (?1 IS NULL OR number = ?1)"
        with self._lock:
            count = self._base.execute(f"SELECT count(*) FROM events_all WHERE {which}", (number,)).fetchone()[0]
            self._write(
                f"INSERT INTO {{where}}.acknowledged SELECT number, ?2 FROM events_all WHERE {which}"
                " AND number NOT IN (SELECT number FROM acknowledged_all)",
                (number, utc_ns),
            )
        return int(count)

    def ignore(self, one: Ignored) -> None:
        """Add to the ignored cameras."""
        with self._lock:
            self._base.execute("INSERT OR IGNORE INTO ignored VALUES (?)", (one.as_text(),))

    def forget_ignored(self, one: Ignored | None = None) -> None:
        """Take one off the list of ignored cameras, or all."""
        with self._lock:
            rows = self._base.execute("SELECT body FROM ignored").fetchall()
            for (body,) in rows:
                if one is None or Ignored.from_text(body) == one:
                    self._base.execute("DELETE FROM ignored WHERE body = ?", (body,))

    def ignored(self) -> tuple[Ignored, ...]:
        """Return the ignored cameras."""
        with self._lock:
            rows = self._base.execute("SELECT body FROM ignored").fetchall()
        return tuple(Ignored.from_text(body) for (body,) in rows)

    def expire(self, utc_ns: int | None = None) -> None:
        """Remove what is older than it may be kept."""
        now = time.time_ns() if utc_ns is None else utc_ns
        with self._lock:
            self._base.execute("DELETE FROM events WHERE utc_ns < ?", (now - round(self.days * _DAY),))
            self._base.execute("DELETE FROM acknowledged WHERE number NOT IN (SELECT number FROM events)")
            limit = (now - round(self.picture_days * _DAY),)
            self._base.execute("UPDATE events SET picture = NULL WHERE utc_ns < ? AND picture IS NOT NULL", limit)
            self._trim()

    def _last_number(self) -> int:
        """The last number that the file gave out, the removed ones included."""
        row = self._base.execute("SELECT seq FROM main.sqlite_sequence WHERE name = 'events'").fetchone()
        return 0 if row is None else int(row[0])

    def _write(self, statement: str, values: tuple[Any, ...]) -> None:
        """Run a statement on the file, or in memory where the file cannot take it; what waits goes first."""
        try:
            if self._waits:
                self._base.executescript(
                    "BEGIN; INSERT INTO main.events SELECT * FROM waiting.events;"
                    "INSERT OR IGNORE INTO main.acknowledged SELECT * FROM waiting.acknowledged; COMMIT;"
                )
                self._waits, self.fault = False, ""
                self._base.executescript("DELETE FROM waiting.events; DELETE FROM waiting.acknowledged;")
            self._base.execute(statement.format(where="main"), values)
        except sqlite3.OperationalError as error:
            if self._base.in_transaction:
                self._base.execute("ROLLBACK")
            self.fault, self._waits = f"the log cannot be written ({error})", True
            self._base.execute(statement.format(where="waiting"), values)
            self._base.execute("DELETE FROM waiting.events WHERE number <= ?", (self.newest - _WAITING,))

    def _trim(self) -> None:
        """Keep the newest events and pictures only, where there is a limit."""
        for most, statement in (
            (self.most, "DELETE FROM main.events WHERE number <= ?"),
            (self.most_pictures, "UPDATE main.events SET picture = NULL WHERE number <= ? AND picture IS NOT NULL"),
        ):
            if most is not None:
                self._base.execute(statement, (self.newest - most,))
        if self.most is not None:
            self._base.execute("DELETE FROM main.acknowledged WHERE number <= ?", (self.newest - self.most,))

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._base.close()
