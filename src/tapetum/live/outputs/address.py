"""The texts that name receivers, as osc://host:port."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from tapetum.errors import InputError

__all__ = ["Address", "parse_address"]


@dataclass(frozen=True)
class Address:
    """Parts of a text like scheme://user:password@host:port/path."""

    scheme: str
    host: str
    port: int
    path: str
    query: str
    user: str | None
    password: str | None

    @property
    def place(self) -> str:
        """Host and port, as a URL has them."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    def __str__(self) -> str:
        # For messages: passwords and queries, which may hold keys, stay out of them.
        return f"{self.scheme}://{self.place}{self.path}"


def parse_address(text: str, *, like: str, port: int | None = None) -> Address:
    """Return the parts of a receiver's address; `like` shows how it must look, `port` is the usual one."""
    try:
        parts = urlsplit(text)
        number = parts.port
    except ValueError as error:
        raise InputError(f"{str(error).lower()}: {_masked(text)!r}", where="output", remedy=f"write {like}") from None
    if not parts.hostname:
        raise InputError(f"no host in {_masked(text)!r}", where="output", remedy=f"write {like}")
    if any(ord(letter) <= 32 or ord(letter) in (127, 35) for letter in text):
        what = f"a space, # or control character in {_masked(text)!r}"
        raise InputError(what, where="output", remedy=f"write {like}, such characters as %20 or %23")
    if not (number := port if number is None else number):
        raise InputError(f"no port in {_masked(text)!r}", where="output", remedy=f"write {like}")
    user, password = (None if one is None else unquote(one) for one in (parts.username, parts.password))
    return Address(parts.scheme.lower(), parts.hostname, number, parts.path, parts.query, user, password)


def _masked(text: str) -> str:
    """A text without its password."""
    before, at, after = text.rpartition("@")
    return f"{before.split(':')[0]}://…@{after}" if at else text
