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


class Log:
    """Events, pictures of them, and the ignored cameras; each write is whole on its own.

    Parameters
    ----------
    path
        A file, or ":memory:".
    days, picture_days
        How long events, and pictures of them, are kept.

    Attributes
    ----------
    newest
        Number of the latest event; 0 without any.

    Raises
    ------
    InputError
        When the file is no log, or was written by a newer Tapetum.
    """

    def __init__(self, path: str | os.PathLike[str], *, days: float = 30.0, picture_days: float = 7.0) -> None:
        for name, value in (("days", days), ("picture_days", picture_days)):
            if not value > 0:
                raise InputError(f"must be positive, is {value}", where=name)
        self.days, self.picture_days = days, picture_days
        self._lock = threading.Lock()
        where = str(path)
        try:
            self._base = sqlite3.connect(where, check_same_thread=False, isolation_level=None)
            self._base.execute("PRAGMA journal_mode=WAL")
            version = self._base.execute("PRAGMA user_version").fetchone()[0]
            if version > _VERSION:
                raise InputError(f"was written by a newer Tapetum (version {version})", where=where)
            self._base.executescript(
                "BEGIN;"
                "CREATE TABLE IF NOT EXISTS events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL,"
                " utc_ns INTEGER NOT NULL, body TEXT NOT NULL, picture BLOB);"
                "CREATE INDEX IF NOT EXISTS by_time ON events (utc_ns);"
                "CREATE TABLE IF NOT EXISTS ignored (body TEXT PRIMARY KEY);"
                "CREATE TABLE IF NOT EXISTS acknowledged (number INTEGER PRIMARY KEY, utc_ns INTEGER NOT NULL);"
                f"PRAGMA user_version={_VERSION}; COMMIT;"
            )
            self.newest = int(self._base.execute("SELECT coalesce(max(number), 0) FROM events").fetchone()[0])
        except sqlite3.Error as error:
            parent = Path(where).parent
            remedy = "name another file" if parent.is_dir() else f"make the folder {parent} first"
            raise InputError(f"cannot be used as a log ({error})", where=where, remedy=remedy) from error

    def add(self, event: Event, picture: bytes | None = None) -> int:
        """Write an event, with a picture of it; return its number."""
        with self._lock:
            row = (event.id, event.utc_ns, json.dumps(event.as_json()), picture)
            number = self._base.execute("INSERT INTO events (id, utc_ns, body, picture) VALUES (?,?,?,?)", row)
            self.newest = int(number.lastrowid or 0)
            return self.newest

    def events(self, after: int = 0, most: int = 100) -> list[dict[str, Any]]:
        """Return the latest events with a number above `after`, oldest first, each with its number."""
        query = "SELECT number, body, picture IS NOT NULL FROM events WHERE number > ? ORDER BY number DESC LIMIT ?"
        with self._lock:
            rows = self._base.execute(query, (after, max(0, min(most, _MOST)))).fetchall()
        return [{"number": number, "picture": bool(has), **json.loads(body)} for number, body, has in reversed(rows)]

    def picture(self, number: int) -> bytes | None:
        """Return an event's picture, JPEG; None where there is none, or no more."""
        with self._lock:
            row = self._base.execute("SELECT picture FROM events WHERE number = ?", (number,)).fetchone()
        return None if row is None else row[0]

    def alerts(self, most: int = 50) -> tuple[list[tuple[dict[str, Any], int | None]], int]:
        """Return the latest alerts, newest first, each with when it was acknowledged, and how many wait for that."""
        kind = "json_extract(body, '$.kind') = 'alert'"
        with self._lock:
            rows = self._base.execute(
                "SELECT e.number, e.body, e.picture IS NOT NULL, a.utc_ns FROM events e"
                f" LEFT JOIN acknowledged a USING (number) WHERE {kind} ORDER BY e.number DESC LIMIT ?",
                (max(0, min(most, _MOST)),),
            ).fetchall()
            waiting = self._base.execute(
                f"SELECT count(*) FROM events WHERE {kind} AND number NOT IN (SELECT number FROM acknowledged)"
            ).fetchone()[0]
        return [
            ({"number": number, "picture": bool(has), **json.loads(body)}, done) for number, body, has, done in rows
        ], waiting

    def acknowledge(self, number: int | None, utc_ns: int) -> int:
        """Acknowledge an alert, or all; return how many there were. One that was acknowledged keeps its time."""
        which = "json_extract(body, '$.kind') = 'alert' AND (?1 IS NULL OR number = ?1)"
        with self._lock:
            count = self._base.execute(f"SELECT count(*) FROM events WHERE {which}", (number,)).fetchone()[0]
            self._base.execute(
                f"INSERT OR IGNORE INTO acknowledged SELECT number, ?2 FROM events WHERE {which}", (number, utc_ns)
            )
        return int(count)

    def ignore(self, one: Ignored) -> None:
        """Add to the ignored cameras."""
        with self._lock:
            self._base.execute("INSERT OR IGNORE INTO ignored VALUES (?)", (json.dumps(vars(one)),))

    def forget_ignored(self) -> None:
        """Empty the list of ignored cameras."""
        with self._lock:
            self._base.execute("DELETE FROM ignored")

    def ignored(self) -> tuple[Ignored, ...]:
        """Return the ignored cameras."""
        with self._lock:
            rows = self._base.execute("SELECT body FROM ignored").fetchall()
        return tuple(Ignored(**json.loads(body)) for (body,) in rows)

    def expire(self, utc_ns: int | None = None) -> None:
        """Remove what is older than it may be kept."""
        now = time.time_ns() if utc_ns is None else utc_ns
        with self._lock:
            self._base.execute("DELETE FROM events WHERE utc_ns < ?", (now - round(self.days * _DAY),))
            self._base.execute("DELETE FROM acknowledged WHERE number NOT IN (SELECT number FROM events)")
            limit = (now - round(self.picture_days * _DAY),)
            self._base.execute("UPDATE events SET picture = NULL WHERE utc_ns < ? AND picture IS NOT NULL", limit)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._base.close()
