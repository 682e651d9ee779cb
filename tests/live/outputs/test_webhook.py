"""Webhooks to a real server: one that answers, one that is down for a while, one that refuses, one that hangs."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from live_messages import make_event, until

from tapetum.live.outputs.webhook import Webhook


@contextmanager
def receiver(answers: list[int], port: int = 0) -> Iterator[tuple[str, list]]:
    """A server that answers with these numbers in turn, then 200; its address, and what it got."""
    got: list = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            got.append((self.path, dict(self.headers), body))
            code = answers.pop(0) if answers else 200
            self.send_response(code)
            if code == 302:
                self.send_header("Location", "/elsewhere")
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield f"http://me:secret@127.0.0.1:{server.server_port}/hook?key=k", got
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def opened(url: str, **more) -> Webhook:
    output = Webhook(url, pauses=(0.01, 0.02), **more)
    output.start()
    return output


def test_events_arrive_as_json_and_busy_receivers_get_them_again():
    with receiver([503, 429, 200, 404, 302]) as (url, got):
        output = opened(url)
        for number in range(4):
            output.event(make_event(number))
        until(lambda: output.counts.sent == 2 and output.counts.failed == 2)
        output.close()
    # Twice again after 503 and 429; no more after 404, and no redirection is followed.
    assert [body["id"] for _, _, body in got] == ["event-0"] * 3 + ["event-1", "event-2", "event-3"]
    assert {path for path, _, _ in got} == {"/hook?key=k"}
    assert got[0][2] == json.loads(json.dumps(make_event(0).as_json()))
    keys = [headers["Idempotency-Key"] for _, headers, _ in got]
    assert keys[0] == keys[1] == keys[2] and len(set(keys)) == 4
    assert got[0][1]["Authorization"] == "Basic bWU6c2VjcmV0" and got[0][1]["Content-Type"] == "application/json"
    assert "secret" not in output.name and "key" not in output.name


def test_a_receiver_that_is_down_gets_what_happened_meanwhile_when_it_returns():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    output = opened(f"http://127.0.0.1:{port}/")
    for number in range(3):
        output.event(make_event(number))
    until(lambda: "no answer" in output.counts.fault)
    with receiver([], port) as (_, got):
        until(lambda: output.counts.sent == 3)
        assert [body["id"] for _, _, body in got] == ["event-0", "event-1", "event-2"]
    assert output.counts.fault == ""
    output.close()


def test_events_go_on_while_a_receiver_never_answers():
    with socket.socket() as hanging:
        hanging.bind(("127.0.0.1", 0))
        hanging.listen()
        output = opened(f"http://127.0.0.1:{hanging.getsockname()[1]}/", timeout=30.0)
        output._patience = 0.05
        output.event(make_event(0))
        connection, _ = hanging.accept()
        with connection:
            # The receiver has the first event and says nothing; 1000 wait, and of all others each costs one.
            for number in range(1, 1501):
                output.event(make_event(number))
            assert output.counts.waiting == 1000 and output.counts.dropped == 500 and output.counts.sent == 0
            output.close()
            assert output.counts.dropped == 1500
