"""Masks from files behind traced lenses: against what a plain reflectance, a thin lens and a finer sampling say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench import Scene
from tapetum.bench.load import scene_from_dict
from tapetum.errors import InputError
from tapetum.simulate import Camera
from tapetum.simulate.traced_information import TracedSlopes

SECTION = "Traced lenses"
WAVELENGTH, PROBE_FOCAL = 640e-9, 0.1


def scene_of(
    lens: dict[str, Any], f_number: float, mask: dict[str, Any] | None = None, *, side: int = 21, **other: Any
) -> Scene:
    """A target whose RR fills the picture; `lens` has a focal length of about 4 mm, or gives it."""
    angle = 8 * WAVELENGTH * f_number / lens.get("focal_length", 4e-3)
    sensor = {"reflectance": 0.3, "pixels": [2000, 1500], "pitch": 2.2e-6, **({} if mask is None else {"mask": mask})}
    sampling = {"accuracy": other.pop("accuracy", 3e-3), "propagation": "far field", **other.pop("sampling", {})}
    return scene_from_dict(
        {
            "schema": "tapetum/scene/1",
            "distance": 5.0,
            "illumination": {"mode": "collimated", "wavelength": WAVELENGTH, "power": 1e-3, "diameter": 0.02},
            "target": {"lens": lens, "object_distance": 2.0, "sensor": sensor, **other},
            "probe": {
                "lens": {"focal_length": PROBE_FOCAL, "aperture_radius": 0.025},
                "sensor": {"pixels": [side, side], "pitch": 2 * PROBE_FOCAL * angle / side},
            },
            "sampling": sampling,
        }
    )


def traced(name: str, f_number: float) -> dict[str, Any]:
    return {"kind": "prescription", "name": name, "f_number": f_number}


def camera_of(scene: Scene, steepest: float = 0.015) -> Camera:
    return Camera(scene, steepest, device="cpu")


def saved(folder: Path, values: np.ndarray, pitch: float) -> dict[str, Any]:
    np.save(folder / "mask.npy", values)
    return {"file": str(folder / "mask.npy"), "pitch": pitch}


def pattern(count: int) -> np.ndarray:
    """Amplitudes and phases alike in no direction."""
    x, y = np.meshgrid(np.arange(count), np.arange(count))
    size = 0.55 + 0.3 * np.cos(0.5 * x + 0.3 * y + 1) + 0.1 * np.cos(0.9 * y)
    return size * np.exp(2.4j * np.sin(0.35 * y - 0.2 * x + 0.5))


TILTS = torch.tensor([[0.0, 0.0], [0.004, 0.011], [-0.009, 0.003], [0.006, -0.007]], dtype=torch.float64)


@pytest.mark.parametrize(("name", "f_number"), [("phone-d", 4.0), ("compact-6mm-f1.9", 5.6)])
def test_a_uniform_mask_is_a_plain_reflectance(name: str, f_number: float, tmp_path: Path, validated: Any) -> None:
    mask = saved(tmp_path, np.ones((60, 60)), 8e-6)
    plain = camera_of(scene_of(traced(name, f_number), f_number))
    masked = camera_of(scene_of(traced(name, f_number), f_number, mask))
    want, ours = plain(TILTS), masked(TILTS)
    error = float(((ours - want).abs().amax((1, 2)) / want.amax((1, 2))).max())
    stated = plain.metadata()["expected_error"] + masked.metadata()["expected_error"]
    validated(SECTION, f"a uniform mask behind {name}", error, 6e-3, "the same lens with a plain reflectance")
    assert error < stated < 6e-3


@pytest.mark.parametrize("distance", [2.0, 0.5])
def test_a_mask_behind_a_nearly_perfect_lens_is_the_thin_lenss(distance: float, tmp_path: Path, validated: Any) -> None:
    """A plano-convex lens at f/25, f = 20 mm; its sensor stands where a thin lens of that focal length is sharp."""
    focal, f_number = 0.02, 25.0
    mask = saved(tmp_path, pattern(12), 2 * WAVELENGTH * f_number)
    given = {"focal_length": focal, "design_wavelength": WAVELENGTH}
    lens = {"kind": "prescription", "name": "la1509", "f_number": f_number, **given}
    thin = {"focal_length": focal, "aperture_radius": focal / 2 / f_number}
    scenes = (scene_of(one, f_number, mask, object_distance=distance) for one in (lens, thin))
    ours, want = (camera_of(scene, 0.004)(0.3 * TILTS) for scene in scenes)
    error = float(((ours - want).abs().amax((1, 2)) / want.amax((1, 2))).max())
    what = f"a mask behind a plano-convex lens at f/25, x_d = {distance:g} m"
    validated(SECTION, what, error, 5e-3, "the thin lens's mask")


def test_a_mirrored_mask_returns_the_mirrored_picture(tmp_path: Path, validated: Any) -> None:
    """With the tilt mirrored too; a mask read the wrong way round would not."""
    # A lens that is traced for other tests, too.
    pitch, lens = WAVELENGTH * 8, traced("phone-d", 4.0)
    want = camera_of(scene_of(lens, 4.0, saved(tmp_path, pattern(8), pitch), accuracy=1e-2))(TILTS[1:2])[0]
    mirrored = camera_of(scene_of(lens, 4.0, saved(tmp_path, pattern(8)[:, ::-1], pitch), accuracy=1e-2))
    ours = mirrored(TILTS[1:2] * torch.tensor([-1.0, 1.0]).double())[0].flip(1)
    # Columns and rows of the pupil on the way out are turned with the tilt, so the samples are not mirrored.
    error = float((ours - want).abs().max() / want.max())
    validated(SECTION, "a mirrored mask behind phone-d, f/4, the tilt mirrored too", error, 1e-3, "symmetry")
    assert float((mirrored(TILTS[1:2])[0] - want).abs().max() / want.max()) > 0.1


def test_a_faint_picture_states_its_error(tmp_path: Path) -> None:
    """A spot some 15 rings beside a small mask: computed by the finer pass, with the difference stated."""
    lens, tilt = traced("phone-d", 4.0), torch.tensor([[0.0, 0.022]], dtype=torch.float64)
    camera = camera_of(scene_of(lens, 4.0, saved(tmp_path, np.ones((12, 12)), 8e-6)), 0.025)
    bright = camera(torch.zeros(1, 2, dtype=torch.float64))
    planned = camera.metadata()["expected_error"]
    assert planned <= 3e-3
    faint = camera(tilt)
    assert 0 < float(faint.max()) < 1e-3 * float(bright.max())
    stated = camera.metadata()["expected_error"]
    assert planned < stated < 1
    finer = camera_of(scene_of(lens, 4.0, saved(tmp_path, np.ones((12, 12)), 8e-6), accuracy=3e-4), 0.025)
    assert float((finer(tilt) - faint).abs().max() / faint.max()) < stated


def test_samples_of_the_sensor_are_not_forced(tmp_path: Path) -> None:
    mask = saved(tmp_path, np.ones((24, 24)), 4e-6)
    with pytest.raises(InputError, match="cannot be forced on a traced lens"):
        camera_of(scene_of(traced("phone-d", 4.0), 4.0, mask, sampling={"sensor": 200}))


def test_too_fine_a_mask_is_refused_with_a_remedy(tmp_path: Path) -> None:
    mask = saved(tmp_path, np.ones((24, 24)), 2e-8)
    with pytest.raises(InputError, match=r"give the mask a coarser pitch than 0\.02 um"):
        camera_of(scene_of(traced("phone-d", 4.0), 4.0, mask))(TILTS[:1])


def test_limits_behind_a_mask_are_refused(tmp_path: Path) -> None:
    """The steps of a gaze are shares of the spot or of a photosite, not of a mask's detail."""
    mask = saved(tmp_path, np.ones((24, 24)), 4e-6)
    with pytest.raises(InputError, match="light off a mask is not differentiated behind a traced lens"):
        TracedSlopes(scene_of(traced("phone-d", 4.0), 4.0, mask), ["gaze_x"], torch.zeros(1, 2))
