"""The requests of the modes: what they answer, what they refuse, and that none breaks on made-up ones."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient
from tests.live.conftest import Scripted

from tapetum.live.app import make_app
from tapetum.live.doors import Doors
from tapetum.live.guard import Guard
from tapetum.live.loop import Watch
from tapetum.live.modes import Modes
from tapetum.live.modes.router import LARGEST, modes_router
from tapetum.live.rules import rules_from_text
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.hand import Aim
from tapetum.record.source import Frame

RULES = "schema: tapetum/rules/1\nrules: [{name: here}]\n"
ZONES = [
    {"name": "a", "left": 0.0, "top": 0.0, "right": 0.4, "bottom": 1.0},
    {"name": "b", "left": 0.5, "top": 0.0, "right": 1.0, "bottom": 1.0},
]


@pytest.fixture(scope="module")
def served(some_seconds: list[Frame], tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Doors, Modes, Aim]]:
    watch = Watch(lambda: Scripted(some_seconds), mode="all", guard=Guard(rules_from_text(RULES)))
    modes, aim = Modes(watch, tmp_path_factory.mktemp("folder"), 1), Aim()
    watch.start()
    assert watch.join(60)
    app = make_app(watch, routers=[modes_router(modes, aim)], pushed=modes.text, largest=LARGEST)
    yield app, modes, aim
    watch.close()


@pytest.fixture
def ask(served: tuple[Doors, Modes, Aim]) -> TestClient:
    served[0]._left.clear()
    return TestClient(served[0], base_url="http://localhost:8750")


def test_modes_are_answered_and_pushed(ask: TestClient) -> None:
    now = ask.get("/api/modes").json()
    assert set(now) == {"exhibit", "vote", "guard", "scan", "record", "hands"} and now["hands"] == 1
    assert now["guard"]["waiting"] == 2 and now["record"]["possible"]
    with ask.websocket_connect("ws://localhost:8750/ws?pictures=false") as socket:
        kinds = []
        for _ in range(30):
            said = json.loads(socket.receive_text())
            kinds.append(said["type"])
            if said["type"] == "modes":
                assert said["guard"] == now["guard"]
                break
    assert kinds[-1] == "modes"


def test_a_calibration_and_a_vote_begin_and_end(ask: TestClient) -> None:
    assert ask.post("/api/exhibit/calibration", json={"width": 100, "height": 50, "marks": 1}).status_code == 409
    assert ask.post("/api/exhibit/calibration", json={"width": 100, "height": 50, "marks": 4}).status_code == 204
    assert ask.delete("/api/exhibit/calibration").status_code == 204
    refused = ask.post("/api/vote", json={"question": "?", "zones": ZONES, "plane": "screen"})
    assert refused.status_code == 409 and "needs a calibration" not in refused.text and "calibration" in refused.text
    wrong = ask.post("/api/vote", json={"question": "?", "zones": [ZONES[0], {**ZONES[1], "left": 0.3}]})
    assert wrong.status_code == 409 and "overlap" in wrong.json()["detail"]
    assert ask.post("/api/vote", json={"question": "Which?", "zones": ZONES}).status_code == 204
    vote = ask.get("/api/modes").json()["vote"]
    assert vote["is_open"] and vote["voices"] == {"a": 0, "b": 0} and vote["file"].startswith("vote-")
    assert ask.delete("/api/vote").status_code == 204
    assert ask.get("/api/vote/replay").json() == []


def test_alerts_are_acknowledged(ask: TestClient) -> None:
    alert = ask.get("/api/modes").json()["guard"]["alerts"][0]
    assert ask.post("/api/guard/acknowledged", json={"number": alert["number"]}).status_code == 204
    assert ask.post("/api/guard/acknowledged", json={"number": 99999}).status_code == 404
    assert ask.get("/api/modes").json()["guard"]["alerts"][0]["acknowledged_utc_ns"]


def test_a_hand_is_led(ask: TestClient, served: tuple[Doors, Modes, Aim]) -> None:
    assert ask.post("/api/hand", json={"x": 0.25, "y": 0.75}).status_code == 204
    assert served[2].at(0) == (0.25, 0.75) and served[2].at(1) is None
    assert ask.post("/api/hand", json={"x": 7, "y": 0}).status_code == 422


def test_an_upload_is_searched_and_its_pictures_are_served(ask: TestClient) -> None:
    room = DrawnRoom()
    lit, dark = (cv2.imencode(".png", room.picture(1.0, lit=one))[1].tobytes() for one in (True, False))
    told = ask.post(f"/api/scan?kind=pair&first={len(lit)}", content=lit + dark)
    assert told.status_code == 202
    number, end = told.json()["id"], time.monotonic() + 60
    while True:
        search = next(one for one in ask.get("/api/modes").json()["scan"]["searches"] if one["id"] == number)
        if search["state"] == "done":
            break
        assert time.monotonic() < end and search["state"] != "failed", search
        time.sleep(0.1)
    assert sum(one["likely"] for one in search["candidates"]) == 2
    picture = ask.get(f"/api/scan/{number}/picture?candidate=1&which=dark")
    assert picture.headers["content-type"] == "image/jpeg"
    assert ask.get(f"/api/scan/{number}/picture?candidate=77").status_code == 404
    # More than a page's other requests may bring, and no more than uploads may.
    assert ask.post("/api/scan?kind=single", content=b"x" * (2 << 20)).status_code == 202
    assert ask.post("/api/scan?kind=single", content=b"x" * ((32 << 20) + 1)).status_code == 413
    assert ask.post("/api/scan?kind=poem", content=b"x").status_code == 422


def test_a_recording_is_named_by_the_server(ask: TestClient, served: tuple[Doors, Modes, Aim]) -> None:
    told = ask.post("/api/recording", content=b'{"name": "/etc/passwd"}')
    assert told.status_code == 201
    name = told.json()["name"]
    assert name.startswith("watch-") and "/" not in name
    assert ask.post("/api/recording").status_code == 409
    assert ask.delete("/api/recording").status_code == 204
    folder = served[1].recorder.folder
    # The source had ended: nothing came, and nothing stays.
    assert isinstance(folder, Path) and not (folder / name).exists()


@pytest.mark.filterwarnings("ignore")
def test_requests_made_up_from_the_description_find_no_fault(served: tuple[Doors, Modes, Aim]) -> None:
    import schemathesis
    from hypothesis import HealthCheck, given, settings

    schema = schemathesis.openapi.from_asgi("/openapi.json", served[0].app)
    made = settings(
        max_examples=8,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )
    paths = set()
    operations: Any = schema.get_all_operations()
    for operation in (found.ok() for found in operations):
        paths.add(operation.path)

        @made
        @given(case=operation.as_strategy())
        def asks(case: Any) -> None:
            case.call_and_validate()

        asks()
    assert len(paths) == 15
