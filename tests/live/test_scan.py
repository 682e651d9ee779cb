"""Uploads, decoded behind limits; what is found in them; and the map of a scan."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.live.conftest import room_frames

from tapetum.errors import InputError
from tapetum.live.modes.coverage import Coverage
from tapetum.live.modes.scan import Scan, search
from tapetum.live.modes.uploads import decoded
from tapetum.live.state import CameraState, Health, State
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.source import Frame
from tapetum.record.video import VideoWriter


def coded(image: np.ndarray, kind: str = ".png") -> bytes:
    return cv2.imencode(kind, image)[1].tobytes()


@pytest.fixture(scope="module")
def pair() -> tuple[bytes, bytes]:
    room = DrawnRoom()
    return coded(room.picture(1.0, lit=True), ".jpg"), coded(room.picture(1.05, lit=False))


def film(folder: Path, frames: list[Frame]) -> bytes:
    with VideoWriter(folder / "film.mkv", (480, 640), 20.0) as writer:
        for one in frames:
            writer.write(one.image, one.time)
    return (folder / "film.mkv").read_bytes()


def test_a_pair_of_pictures_gives_the_rooms_cameras_with_pictures_of_them(pair: tuple[bytes, bytes]) -> None:
    lit, dark = pair
    found = search(lit + dark, "pair", len(lit))
    likely = [one for one in found.told.candidates if one.likely]
    places = DrawnRoom().places(1.0)
    assert len(likely) == len(places) == 2
    for one in likely:
        assert min(np.hypot(one.x - x, one.y - y) for x, y in places) < 3
        assert one.probability is not None and one.probability > 0.5
        assert found.crops[one.number, "lit"][:2] == found.crops[one.number, "dark"][:2] == b"\xff\xd8"
    assert found.whole[:2] == b"\xff\xd8" and (found.told.width, found.told.height) == (640, 480)
    # The dark one first: that is noticed.
    assert "swapped" in search(dark + lit, "pair", len(dark)).told.note


def test_a_film_gives_what_is_followed_through_it(tmp_path: Path) -> None:
    # With the light on all the time, as a phone's torch: every frame is lit.
    room = DrawnRoom()
    rng = np.random.default_rng(0)
    frames = []
    for k in range(24):
        image = room.picture(1.0 + k / 20, lit=True).astype(np.float32)
        frames.append(Frame(k, k / 20, np.clip(image + rng.normal(0, 1, image.shape), 0, 255).astype(np.uint8)))
    found = search(film(tmp_path, frames), "film")
    assert found.told.frames == 24 and found.told.candidates
    for x, y in room.places(1.5):
        near = [one for one in found.told.candidates if np.hypot(one.x - x, one.y - y) < 20]
        assert near and near[0].likely and near[0].frames >= 6
        assert found.crops[near[0].number, "lit"][:2] == b"\xff\xd8"


@pytest.mark.parametrize(
    ("content", "kind", "why"),
    [
        (b"", "single", "is empty"),
        (b"hello" * 100, "single", "is no JPEG, PNG or WebP"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "single", "cannot be decoded"),
        (b"GIF89a" + b"\0" * 50, "single", "is no JPEG, PNG or WebP"),
        (b"not a film at all", "film", "cannot be decoded"),
        (coded(np.zeros((8, 8), np.uint8)), "single", "less than 32"),
        (coded(np.zeros((64, 64), np.uint8)), "pair", "first: must divide"),
        (b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "film", "cannot be decoded"),
    ],
)
def test_what_is_no_picture_is_refused_with_a_reason(content: bytes, kind: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        list(decoded(content, kind))


def test_a_bomb_of_pixels_is_refused_before_it_is_unpacked() -> None:
    # A PNG that says it has 30000 x 30000 pixels, which would take 900 MB.
    import struct
    import zlib

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0)
    rows = zlib.compress(b"\0" * 30_001) * 2
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    begun = time.monotonic()
    with pytest.raises(InputError, match="more than 67 million pixels"):
        list(decoded(bomb, "single"))
    assert time.monotonic() - begun < 30


@pytest.mark.parametrize("does", ["import time; time.sleep(100)", "x = bytearray(3 << 30)", "import os; os.abort()"])
def test_a_decoder_that_hangs_bursts_or_dies_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, does: str, pair: tuple[bytes, bytes]
) -> None:
    from tapetum.live.modes import decode

    bad = tmp_path / "decode.py"
    text = Path(decode.__file__).read_text()
    assert "    limit()\n" in text
    bad.write_text(text.replace("    limit()\n", f"    limit()\n    {does}\n", 1))
    monkeypatch.setattr(decode, "__file__", str(bad))
    monkeypatch.setattr("tapetum.live.modes.uploads._SECONDS", 1.0 if "sleep" in does else 60.0)
    with pytest.raises(InputError, match="too much memory or time"):
        list(decoded(pair[0], "single"))


@pytest.mark.parametrize(
    "answer",
    [
        '{"width": 1000000, "height": 64, "time": 0}',
        '{"width": 64}',
        "[1]",
        '{"width": 64, "height": 64, "time": -1}',
    ],
)
def test_what_a_decoder_that_was_taken_over_says_is_checked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, answer: str
) -> None:
    from tapetum.live.modes import decode

    bad = tmp_path / "decode.py"
    bad.write_text(f"print('''{answer}''', flush=True)\nprint('x' * 10000)\n")
    monkeypatch.setattr(decode, "__file__", str(bad))
    with pytest.raises(InputError, match=r"makes no sense|damaged"):
        list(decoded(b"x", "single"))


def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end, "never"
        time.sleep(0.02)


def test_searches_wait_in_turn_and_too_many_are_refused(
    pair: tuple[bytes, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = Scan()
    gate = __import__("threading").Event()
    real = search
    monkeypatch.setattr("tapetum.live.modes.scan.search", lambda *args: (gate.wait(30), real(*args))[1])
    first = scan.begin(pair[0] + pair[1], "pair", len(pair[0]))
    bad = scan.begin(b"nothing", "single")
    scan.begin(pair[0], "single")
    with pytest.raises(InputError, match="too many uploads wait"):
        scan.begin(pair[0], "single")
    assert scan.full and {one.state for one in scan.state().searches} == {"searching", "waiting"}
    assert scan.picture(first) is None
    gate.set()
    until(lambda: all(one.state in ("done", "failed") for one in scan.state().searches))
    done = {one.id: one for one in scan.state().searches}
    assert done[first].state == "done" and done[first].candidates and done[first].seconds > 0
    assert done[bad].state == "failed" and "is no JPEG" in done[bad].fault
    assert scan.picture(first) and scan.picture(first, 1, "dark") and not scan.picture(first, 99)
    with pytest.raises(InputError, match="kind"):
        scan.begin(b"x", "poem")
    scan.close()


def test_the_map_follows_a_probe_that_is_turned_and_says_what_was_not_seen() -> None:
    wide = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (480, 2600)).astype(np.uint8), (0, 0), 5)
    wide = cv2.equalizeHist(wide)
    coverage = Coverage((640, 480))
    advice = set()
    for k in range(120):
        # 1.5 s still, then a turn by two pictures in 4 s, then still.
        at = round(2 * 640 * np.clip((k / 20 - 1.5) / 4, 0, 1))
        coverage.update(wide[:, at : at + 640], k / 20)
        advice.add(coverage.advice)
        if k % 10 == 0:
            coverage.see("a" if k < 60 else "b", (1500 - at) / 640, 0.5, 20.0, None, 0.05)
    told = coverage.state(running=True)
    assert told.x == pytest.approx(2.0, abs=0.12) and told.y == pytest.approx(0.0, abs=0.06)
    assert {"hold still", "go on"} <= advice
    assert told.columns in range(22, 28) and len(base64.b64decode(told.cells)) == told.columns * told.rows
    assert 0.2 < told.share < 1
    # One camera, though it came back under another name.
    assert [one.camera for one in told.sightings] == ["b"]
    assert told.sightings[0].x == pytest.approx(1500 / 640 - 0.5, abs=0.15)
    coverage.update(np.random.default_rng(9).integers(0, 255, (480, 640)).astype(np.uint8), 6.0)
    assert coverage.advice == "go slower"


def test_a_live_scan_begins_and_ends() -> None:
    scan = Scan()
    rooms = room_frames(0.5)
    assert not scan.state().coverage.running
    scan.start()
    for one in rooms:
        camera = CameraState("a", 1, 170, 150, 6, True, 0, 0)
        state = State("demo", one.index, 10**18 + round(one.time * 1e9), (640, 480), (camera,), Health())
        scan.update(state, one)
    now = scan.state().coverage
    assert now.running and now.columns >= 8 and now.sightings[0].camera == "a"
    scan.stop()
    assert not scan.state().coverage.running and scan.state().coverage.columns >= 8
    scan.close()
