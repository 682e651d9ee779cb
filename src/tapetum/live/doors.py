"""Access checks of a watch's server: an ASGI layer in front of the application that every request and socket passes.

The check of Host stops DNS rebinding, the check of Origin stops pages of other sites, the token stops strangers, and
the limits stop floods of requests.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import secrets
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from tapetum.errors import InputError

__all__ = ["COOKIE", "Doors", "is_loopback", "make_token"]

COOKIE = "tapetum"
"""Name of the cookie that keeps the token once a page was opened with it."""

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = [
    (b"content-security-policy", _POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
]
_LARGEST = 1 << 20
_RATE, _BURST = 50.0, 200.0  # requests a second of one address, and at once
_ADDRESSES = 1000
_REFUSED = 1008  # WebSocket: policy violation

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


def make_token() -> str:
    """Return a new token of 128 bits."""
    return secrets.token_urlsafe(16)


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Doors:
    """An ASGI application behind checks.

    Parameters
    ----------
    app
        The application.
    hosts
        Names and addresses under which the server is asked, without ports; "*" allows any.
    token
        What every request must bring: as `Authorization: Bearer TOKEN`, `?token=TOKEN` or the cookie that the latter
        sets. None: nothing, which only a loopback address may do.
    largest
        Bytes of a request's body, at most; by path's beginning, and "" for the rest.
    clients
        WebSockets at the same time, at most.

    Raises
    ------
    InputError
        Where there is no host.
    """

    def __init__(
        self,
        app: App,
        hosts: tuple[str, ...],
        token: str | None = None,
        *,
        largest: dict[str, int] | None = None,
        clients: int = 100,
    ) -> None:
        if not hosts:
            raise InputError("names no host", where="hosts", remedy="give the names under which the server is asked")
        self.app, self.hosts, self.token, self.clients = app, hosts, token, clients
        self.largest = {"": _LARGEST, **(largest or {})}
        self._open = 0
        # By address: what is left of its allowance, and when that was.
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it with 400, 401, 403, 413 or 429."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await _refuse(scope, receive, send, *refusal)
        elif scope["type"] == "websocket":
            self._open += 1
            try:
                await self.app(scope, receive, send)
            finally:
                self._open -= 1
        else:
            await self._http(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Return the status and reason with which a request is refused."""
        given = _headers(scope)
        if not self._affords(scope):
            return 429, "too many requests; wait a second"
        host = given.get("host", "")
        if "*" not in self.hosts and _name(host) not in self.hosts:
            return 400, f"the server is not asked as {_name(host)[:80] or 'nothing'}; allow it with --host-name"
        origin = given.get("origin")
        # A browser names the page that asks; other programs name none.
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return 403, "pages of other sites may not ask"
        if self.token is not None and not self._knows(scope, given):
            return 401, "the token is missing or wrong; open the address that the command printed"
        if scope["type"] == "websocket" and self._open >= self.clients:
            return 429, f"{self.clients} clients are connected; close one"
        return None

    def _knows(self, scope: Scope, given: dict[str, str]) -> bool:
        said = [given.get("authorization", "").removeprefix("Bearer "), _asked(scope)]
        try:
            cookie = SimpleCookie(given.get("cookie", "")).get(COOKIE)
            said.append("" if cookie is None else cookie.value)
        except CookieError:
            pass
        token = (self.token or "").encode()
        # All are compared, in constant time.
        return any([hmac.compare_digest(one.encode(), token) for one in said])  # noqa: C419

    def _affords(self, scope: Scope) -> bool:
        """Take one of the address's allowance, a token bucket."""
        address = (scope.get("client") or ("", 0))[0]
        now = time.monotonic()
        left, then = self._left.pop(address, (_BURST, now))
        left = min(_BURST, left + (now - then) * _RATE)
        self._left[address] = (max(0.0, left - 1), now)
        if len(self._left) > _ADDRESSES:
            self._left.popitem(last=False)
        return left >= 1

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope["path"]
        limit = self.largest[max((start for start in self.largest if path.startswith(start)), key=len)]
        length = _headers(scope).get("content-length", "0")
        if not length.isdecimal() or int(length) > limit:
            await _refuse(scope, receive, send, 413, f"larger than {limit} bytes")
            return
        held, over, begun = 0, False, False

        async def bounded() -> MutableMapping[str, Any]:
            nonlocal held, over
            message = await receive()
            held += len(message.get("body", b""))
            if held > limit:
                # A body without a length that does not end: the application hears that the client disconnected.
                over = True
                return {"type": "http.disconnect"}
            return message

        async def guarded(message: MutableMapping[str, Any]) -> None:
            nonlocal begun
            if over and not begun:
                # The application's answer to a client that has disconnected.
                return
            if message["type"] == "http.response.start":
                begun = True
                headers = [*message.get("headers", ()), *_HEADERS]
                if self.token is not None and _asked(scope):
                    line = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                    headers.append((b"set-cookie", line.encode()))
                message = {**message, "headers": headers}
            await send(message)

        try:
            await self.app(scope, bounded, guarded)
        except Exception:
            if not over or begun:
                raise
        if over and not begun:
            await _refuse(scope, receive, send, 413, f"larger than {limit} bytes")


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}


def _asked(scope: Scope) -> str:
    """Return the token of the query."""
    return parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]


def _name(host: str) -> str:
    """Return the name of a Host header, without its port and brackets."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        # Closed before it is accepted: the client gets 403.
        await receive()
        await send({"type": "websocket.close", "code": _REFUSED, "reason": why[:120]})
        return
    headers = [(b"content-type", b"application/json"), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps({"detail": why}).encode()})
