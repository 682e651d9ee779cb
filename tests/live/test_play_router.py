"""The requests of the playground: good ones, bad ones, and many at once."""

from __future__ import annotations

import base64
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from tapetum.bench import load_scene
from tapetum.live.playground import Playground, apply
from tapetum.live.playground.router import make_play_app
from tapetum.simulate import expose, retroreflect


@pytest.fixture(scope="module")
def client():
    with TestClient(make_play_app()) as found:
        yield found


def test_it_says_what_can_be_set(client):
    found = client.get("/api/play").json()
    assert {one["name"] for one in found["settings"]} >= {"gaze_x", "focus", "lens", "tilt_x", "filter", "power"}
    assert found["scenes"]["thin-lens"]["focal_length"] == pytest.approx(100)
    assert found["lenses"]["zoom-5-15mm"]["focal_length"][1] > 2 * found["lenses"]["zoom-5-15mm"]["focal_length"][0]


def test_a_scene_comes_back_as_pictures_and_figures(client):
    values = {"gaze_x": 0.1, "focus": 4}
    answer = client.post("/api/play", json={"settings": values, "seed": 3})
    assert answer.status_code == 200
    found, scene = answer.json(), apply(load_scene("thin-lens"), values)
    frame = cv2.imdecode(
        np.frombuffer(base64.b64decode(found["frame"].partition(",")[2]), np.uint8), cv2.IMREAD_GRAYSCALE
    )
    assert (np.abs(frame - expose(retroreflect(scene), scene, 3)[0].astype(int)) > 0).mean() < 1e-3
    assert found["eye"]["class"] == "1M" and found["snr"] > 100 and not found["draft"]
    assert found["settings"]["focus"] == pytest.approx(4) and "object_distance: 4.0" in found["yaml"]
    limit = client.post("/api/play", json={"settings": values, "part": "limit"}).json()
    assert 0 < limit["bounds"]["gaze_x"] < 1e-3


@pytest.mark.parametrize(
    ("body", "status", "says"),
    [
        ('{"settings": {"gaze_x": 3}}', 422, "gaze_x: 3 is out of range; give -0.5 to 0.5 of field"),
        ('{"settings": {"nonsense": 3}}', 422, "nonsense: there is no such setting"),
        ('{"settings": {"focal_length": 300, "focus": 0.25}}', 422, "focus farther away"),
        (
            '{"settings": {"lens": "compact-6mm-f1.9", "gaze_x": 0.5, "gaze_y": 0.5}}',
            422,
            "the spot lies across the edge",
        ),
        ('{"scene": "/etc/passwd"}', 422, "scene: no scene is called"),
        ('{"settings": {"gaze_x": NaN}}', 422, "settings"),
        ('{"pixels": 9}', 422, "pixels"),
        ("not JSON", 422, "JSON"),
        ('{"scene": "' + "x" * 20000 + '"}', 413, "16384 bytes"),
    ],
)
def test_bad_requests_are_refused_in_one_line(client, body, status, says):
    answer = client.post("/api/play", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == status and says in answer.json()["detail"]
    assert "\n" not in answer.json()["detail"]


def test_of_requests_that_wait_the_newest_of_a_page_is_computed(monkeypatch):
    begun, go, computed, handed_over = threading.Event(), threading.Event(), [], []
    usual = Playground.result

    class Counting(ThreadPoolExecutor):
        def submit(self, *work: Any, **options: Any) -> Any:
            try:
                return super().submit(*work, **options)
            finally:
                handed_over.append(work)

    def held(self, scene, **options):
        computed.append(options["seed"])
        begun.set()
        assert go.wait(20)
        return usual(self, scene, **options)

    monkeypatch.setattr(Playground, "result", held)
    monkeypatch.setattr("tapetum.live.playground.router.ThreadPoolExecutor", Counting)
    with TestClient(make_play_app()) as client, ThreadPoolExecutor(4) as pool:

        def ask(seed: int, page: str = "one") -> int:
            return client.post("/api/play", json={"seed": seed, "page": page}).status_code

        first = pool.submit(ask, 1)
        assert begun.wait(20)
        other = pool.submit(ask, 2, "two")
        older = pool.submit(ask, 3)
        newest = pool.submit(ask, 4)
        # Of the page's two requests that wait, whichever came last wins.
        end = time.monotonic() + 20
        while len(handed_over) < 4:
            assert time.monotonic() < end, "the requests did not arrive"
            time.sleep(0.01)
        go.set()
        statuses = [one.result() for one in (first, other, older, newest)]
    assert statuses[:2] == [200, 200]
    assert sorted(statuses[2:]) == [200, 409] and len(computed) == 3


@pytest.mark.filterwarnings("ignore")
def test_requests_made_up_from_the_description_find_no_fault(monkeypatch):
    import schemathesis
    from hypothesis import HealthCheck, given, settings
    from schemathesis.specs.openapi.checks import positive_data_acceptance

    # What is computed is tried above.
    monkeypatch.setattr("tapetum.live.playground.router.result_json", lambda scene, result: {})
    monkeypatch.setattr("tapetum.live.playground.router.limit_json", lambda limit: {})
    monkeypatch.setattr(Playground, "limit", lambda self, scene: None)
    monkeypatch.setattr(Playground, "first", lambda self, base, values, seed: (apply(base, values), None))
    monkeypatch.setattr(Playground, "result", lambda self, scene, seed: None)
    schema = schemathesis.openapi.from_asgi("/openapi.json", make_play_app())
    made = settings(
        max_examples=15,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )
    operations: Any = schema.get_all_operations()
    for operation in (found.ok() for found in operations):

        @made
        @given(case=operation.as_strategy())
        def asks(case: Any) -> None:
            # Values in range may still make no camera: that is refused as bad ones are.
            case.call_and_validate(excluded_checks=[positive_data_acceptance])

        asks()
