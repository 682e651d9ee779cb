"""Machine-vision cameras: the source against a stand-in, and against Aravis' simulated camera where it is installed."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record import genicam
from tapetum.record.frames import Frame, open_frames
from tapetum.record.genicam import Aravis, GenicamCamera


class Camera:
    """Gives frames whose pixels are their number; skips some numbers, and stops."""

    def __init__(self, form: str, numbers: tuple[int, ...]) -> None:
        self.form, self.numbers = form, list(numbers)
        self.rate: float | None = 20.0
        self.hardware: dict[str, Any] = {"exposure": 2e-3, "model": "M"}
        self.closed = False

    def next(self, seconds: float) -> genicam.Raw | None:
        if not self.numbers:
            return None
        number = self.numbers.pop(0)
        return np.full((3, 4), number, "<u2").tobytes(), self.form, 4, 3, number, time.time_ns()

    def close(self) -> None:
        self.closed = True


class Library:
    """One camera."""

    name = "stand-in"

    def __init__(self, *numbers: int) -> None:
        self.camera = Camera("Mono12", numbers)
        self.asked: tuple[object, ...] = ()

    def list(self) -> list[genicam.Found]:
        return [("Maker-1", "Maker M", ["Mono8", "Mono12"])]

    def open(self, ident: str, form: str | None, rate: float | None) -> Camera:
        self.asked = (ident, form, rate)
        return self.camera


def test_frames_carry_their_depth_exposure_and_losses() -> None:
    library = Library(5, 6, 7, 11)
    camera = GenicamCamera("genicam:Maker-1,Mono12", 20, library)
    assert library.asked == ("Maker-1", "Mono12", 20)
    assert camera.full_scale == 4095 and camera.hardware["bits"] == 12 and camera.hardware["library"] == "stand-in"
    came: list[Frame] = []
    with pytest.raises(InputError, match=r"gave no frame for 5 s; check its cable"):
        came.extend(camera)
    assert [int(frame.image[0, 0]) for frame in came] == [6, 7, 11] and [frame.lost for frame in came] == [0, 0, 3]
    assert all(frame.exposure == 2e-3 and frame.image.dtype == np.uint16 for frame in came)
    camera.close()
    assert library.camera.closed


def test_a_camera_that_gives_nothing_is_closed() -> None:
    library = Library()
    with pytest.raises(InputError, match="gave no frame"):
        GenicamCamera("genicam:", None, library)
    assert library.camera.closed


def test_the_deepest_grey_form_is_chosen() -> None:
    assert genicam._deepest(["Mono8", "Mono12p", "BayerRG16", "Mono12"], None, "x") == "Mono12"
    assert genicam._deepest(["Mono8", "Mono12p"], None, "x") == "Mono12p"
    with pytest.raises(InputError, match="offers no Mono16; ask for one of Mono8"):
        genicam._deepest(["Mono8", "RGB8"], "Mono16", "x")
    with pytest.raises(InputError, match="offers no grey form, but RGB8"):
        genicam._deepest(["RGB8"], None, "x")


def test_without_a_library_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(genicam, "backends", list)
    with pytest.raises(InputError, match=r"genicam:: no library for GenICam is installed; install Aravis \(Debian"):
        open_frames("genicam:")
    assert genicam.find_genicam() is None


def test_aravis_simulated_camera() -> None:
    try:
        library = Aravis(simulated=True)
    except (ImportError, ValueError) as error:
        pytest.skip(f"Aravis is not installed ({error})")
    idents = [ident for ident, _, _ in library.list()]
    fake = next(ident for ident in idents if "Fake" in ident)
    camera = GenicamCamera(f"genicam:{fake}", 20, library)
    frames = iter(camera)
    came = [next(frames) for _ in range(5)]
    camera.close()
    assert all(frame.image.shape == came[0].image.shape for frame in came)
    assert camera.full_scale in (255, 65535) and came[0].image.std() > 0
    assert all((a.utc_ns or 0) < (b.utc_ns or 0) for a, b in itertools.pairwise(came))
