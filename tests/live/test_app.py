"""The server: what it answers, what it pushes, and whom it lets in."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

with warnings.catch_warnings():
    # Its own successor of httpx is not what other packages bring.
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from tests.live.conftest import Scripted, watched

from tapetum.errors import InputError
from tapetum.live import doors
from tapetum.live.app import make_app
from tapetum.live.doors import Doors, is_loopback
from tapetum.live.loop import Watch
from tapetum.record.source import Frame

TOKEN = "a-token-of-some-length"


@pytest.fixture(scope="module")
def watch(some_seconds: list[Frame]) -> Iterator[Watch]:
    yield watched(lambda: Scripted(some_seconds), name="room")


def client(watch: Watch, token: str | None = None, base: str = "http://localhost:8750") -> TestClient:
    # Without `with`: the watch is closed with the server, and these share one.
    return TestClient(make_app(watch, token=token), base_url=base)


def test_state_events_pictures_and_page_are_answered(watch: Watch) -> None:
    ask = client(watch)
    state = ask.get("/api/state").json()
    assert state["source"] == "room" and state["frame"] == 35 and state["health"]["ended"] is True
    events = ask.get("/api/events", params={"most": 2}).json()
    assert [one["kind"] for one in events] == ["gone", "gone"]
    assert [one["number"] for one in ask.get("/api/events", params={"after": 3}).json()] == [4, 5]
    picture = ask.get("/api/events/1/picture")
    assert picture.headers["content-type"] == "image/jpeg" and picture.content[:2] == b"\xff\xd8"
    assert ask.get("/api/frame.jpg").content[:2] == b"\xff\xd8"
    page = ask.get("/")
    assert "What the probe sees" in page.text
    assert "script-src 'self'" in page.headers["content-security-policy"]
    assert "<style" not in page.text and " style=" not in page.text and "onclick" not in page.text
    for path in ("watch.js", "style.css", "icon.svg"):
        assert ask.get(f"/static/{path}").status_code == 200


@pytest.mark.parametrize(
    "path", ["/api/events/99/picture", "/api/events/-1/picture", "/static/../app.py", "/static/%2e%2e/app.py", "/x"]
)
def test_what_is_not_there_is_404(watch: Watch, path: str) -> None:
    assert client(watch).get(path).status_code == 404


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"x": 1, "y": 1},
        {"x": 1e9, "radius": 3},
        {"radius": "3"},
        {"radius": 3, "more": 1},
        {"device": "x" * 300},
        [],
        "NaN",
    ],
)
def test_a_bad_camera_to_ignore_is_refused_with_a_reason(watch: Watch, body: object) -> None:
    answer = client(watch).post("/api/ignored", content=json.dumps(body), headers={"content-type": "application/json"})
    assert answer.status_code == 422 and answer.json()["detail"]
    assert client(watch).get("/api/ignored").json() == []


def test_a_camera_is_ignored_and_all_are_shown_again(watch: Watch) -> None:
    ask = client(watch)
    assert ask.post("/api/ignored", json={"x": 170, "y": 150, "radius": 40}).status_code == 204
    assert ask.post("/api/ignored", json={"device": "phone-03"}).status_code == 204
    place, device = ask.get("/api/ignored").json()
    assert {**place, "id": ""} == {
        **{"id": "", "by": "place", "x": 170.0, "y": 150.0, "radius": 40.0, "device": "", "looks": 0}
    }
    assert device["by"] == "device" and device["device"] == "phone-03"
    assert ask.delete("/api/ignored", params={"one": "none of them"}).status_code == 404
    assert ask.delete("/api/ignored", params={"one": place["id"]}).status_code == 204
    assert ask.get("/api/ignored").json() == [device]
    answer = ask.post("/api/ignored", json={"camera": "nobody"})
    assert answer.status_code == 409 and "is not here now" in answer.json()["detail"]
    assert ask.delete("/api/ignored").status_code == 204
    assert ask.get("/api/ignored").json() == []


def test_the_socket_pushes_state_events_and_the_picture(watch: Watch) -> None:
    with client(watch).websocket_connect("ws://localhost:8750/ws?after=3") as socket:
        state = json.loads(socket.receive_text())
        assert state["type"] == "state" and state["frame"] == 35
        told = [json.loads(socket.receive_text())["event"]["number"] for _ in range(2)]
        picture = socket.receive_bytes()
    assert told == [4, 5]
    assert int.from_bytes(picture[:8], "big") == 35 and picture[8:10] == b"\xff\xd8"


def test_strange_names_and_origins_are_kept_out(watch: Watch) -> None:
    ask = client(watch)
    assert ask.get("/api/state", headers={"host": "evil.example"}).status_code == 400
    assert ask.get("/api/state", headers={"host": "evil.example:8750"}).status_code == 400
    assert ask.get("/api/state", headers={"origin": "http://evil.example"}).status_code == 403
    assert ask.get("/api/state", headers={"origin": "http://localhost:9999"}).status_code == 403
    assert ask.get("/api/state", headers={"origin": "null"}).status_code == 403
    assert ask.get("/api/state", headers={"origin": "http://localhost:8750"}).status_code == 200
    for headers in ({"origin": "http://evil.example"}, {"host": "evil.example"}):
        with pytest.raises(WebSocketDisconnect), ask.websocket_connect("ws://localhost:8750/ws", headers=headers):
            pass


def test_a_token_is_demanded_and_kept_in_a_cookie(watch: Watch) -> None:
    ask = client(watch, TOKEN)
    assert ask.get("/").status_code == 401
    assert ask.get("/?token=another").status_code == 401
    assert ask.get("/api/state", headers={"authorization": "Bearer nö".encode()}).status_code == 401
    with pytest.raises(WebSocketDisconnect), ask.websocket_connect("ws://localhost:8750/ws"):
        pass
    assert ask.get("/api/state", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    answer = ask.get(f"/?token={TOKEN}")
    assert answer.status_code == 200
    assert "HttpOnly" in answer.headers["set-cookie"] and "SameSite=Strict" in answer.headers["set-cookie"]
    assert ask.get("/api/state").status_code == 200
    with ask.websocket_connect("ws://localhost:8750/ws") as socket:
        assert json.loads(socket.receive_text())["type"] == "state"


def test_bodies_floods_and_crowds_are_bounded(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    # At one moment, however long a busy machine takes.
    monkeypatch.setattr(doors, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    ask = client(watch)
    answer = ask.post("/api/ignored", content=b"x" * (2 << 20))
    assert answer.status_code == 413 and "larger than 1048576 bytes" in answer.json()["detail"]

    def endless() -> Iterator[bytes]:
        for _ in range(40):
            yield b" " * (1 << 16)

    assert ask.post("/api/ignored", content=endless()).status_code == 413
    codes = [ask.get("/api/ignored").status_code for _ in range(220)]
    assert codes[0] == 200 and codes[-1] == 429
    small = Doors(make_app(watch).app, ("localhost",), clients=1)
    ask = TestClient(small, base_url="http://localhost:8750")
    with (
        ask.websocket_connect("ws://localhost:8750/ws"),
        pytest.raises(WebSocketDisconnect),
        ask.websocket_connect("ws://localhost:8750/ws"),
    ):
        pass


def test_only_this_machines_addresses_are_loopback() -> None:
    assert all(is_loopback(one) for one in ("127.0.0.1", "127.9.9.9", "localhost", "::1"))
    assert not any(is_loopback(one) for one in ("0.0.0.0", "192.168.1.2", "::", "localhost.evil.example", ""))
    with pytest.raises(InputError, match="hosts: names no host"):
        Doors(make_app, ())  # pyright: ignore[reportArgumentType]


@pytest.mark.filterwarnings("ignore")
def test_requests_made_up_from_the_description_find_no_fault(watch: Watch) -> None:
    import schemathesis
    from hypothesis import HealthCheck, given, settings

    schema = schemathesis.openapi.from_asgi("/openapi.json", make_app(watch).app)
    made = settings(
        max_examples=8,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )
    paths = []
    operations: Any = schema.get_all_operations()
    for operation in (found.ok() for found in operations):
        paths.append(operation.path)

        @made
        @given(case=operation.as_strategy())
        def asks(case: Any) -> None:
            case.call_and_validate()

        asks()
    assert len(paths) == 7
