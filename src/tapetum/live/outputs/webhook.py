"""Webhooks: each event as JSON to a web address, tried again while the receiver is down."""

from __future__ import annotations

import base64
import http.client
import json
import time
import urllib.error
import urllib.request
import uuid
from importlib.metadata import version
from typing import Any

from tapetum.errors import TapetumError
from tapetum.live.events import Event
from tapetum.live.outputs.address import parse_address
from tapetum.live.outputs.base import Queued

__all__ = ["Webhook"]

_PORTS = {"http": 80, "https": 443}
_LATER = (408, 425, 429, 500, 502, 503, 504)  # answers after which another trial may succeed
_PAUSES = (0.5, 60.0)  # s between two trials: at first, and at most


class _Stay(urllib.request.HTTPRedirectHandler):
    """Follows no redirection: a POST would become a GET, to an address that nobody named."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> None:
        return None


class Webhook(Queued):
    """Posts each event to `http(s)://…`.

    The body is `Event.as_json()`; see `event_schema`. An answer of 2xx takes it. After no answer, 408, 425, 429, 500,
    502, 503 or 504 it is tried again, after 0.5 s, 1 s, 2 s … up to a minute, or as long as Retry-After says; any other
    answer is a failure. A receiver may get an event twice: the header Idempotency-Key is then the same.

    Parameters
    ----------
    text
        The address; a user and password in it are sent as basic authentication.
    timeout
        Seconds for an answer.
    trying
        Seconds for which one event is tried again before it counts as failed.
    pauses
        Seconds between two trials: at first, and at most.
    """

    def __init__(
        self, text: str, *, timeout: float = 5.0, trying: float = 3600.0, pauses: tuple[float, float] = _PAUSES
    ) -> None:
        address = parse_address(text, like="https://host/path", port=_PORTS.get(text.split(":")[0].lower()))
        super().__init__(str(address))
        self._url = f"{address}?{address.query}" if address.query else str(address)
        self._headers = {"Content-Type": "application/json", "User-Agent": f"tapetum/{version('tapetum')}"}
        if address.user is not None:
            login = base64.b64encode(f"{address.user}:{address.password or ''}".encode()).decode()
            self._headers["Authorization"] = f"Basic {login}"
        self._timeout, self._trying, self._pauses = timeout, trying, pauses
        self._opener = urllib.request.build_opener(_Stay())

    def send_event(self, event: Event) -> None:
        """Post an event, again and again until it is taken or there is no hope."""
        body = json.dumps(event.as_json(), allow_nan=False).encode()
        headers = {**self._headers, "Idempotency-Key": uuid.uuid4().hex}
        until, pause = time.monotonic() + self._trying, self._pauses[0]
        while True:
            why, wait = self._post(body, headers)
            if not why:
                return
            self.set_fault(why)
            if wait is None or time.monotonic() > until or self.hurried:
                raise TapetumError(why)
            wait = min(max(wait, pause), self._pauses[1])
            pause = min(2 * pause, self._pauses[1])
            if self.closing.is_set():
                # At the end no long pause: `close` waits for it.
                time.sleep(min(wait, 0.1))
            else:
                self.closing.wait(wait)

    def _post(self, body: bytes, headers: dict[str, str]) -> tuple[str, float | None]:
        """Post once; return what went wrong, and the seconds to wait at least: None where trying again is no use."""
        request = urllib.request.Request(self._url, body, headers, method="POST")
        try:
            with self._opener.open(request, timeout=self._timeout):
                return "", None
        except urllib.error.HTTPError as error:
            error.close()
            wait = error.headers.get("Retry-After") or "0"
            why = f"the receiver answered {error.code} {error.reason}"
            return why, (float(wait) if wait.isdecimal() else 0.0) if error.code in _LATER else None
        except (OSError, http.client.HTTPException) as error:
            return f"no answer ({getattr(error, 'reason', None) or error})", 0.0
