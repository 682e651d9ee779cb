"""What the playground shows of a scene: pictures, budget, limit, eye safety and rays. No server here."""

from __future__ import annotations

import contextlib
import math
import time
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import PhoneTarget, PrescriptionLens, ProbeSensor, Scene
from tapetum.errors import InputError
from tapetum.live.playground.rays import Drawing, draw_rays
from tapetum.live.playground.settings import apply
from tapetum.simulate import FisherInformation, Image, LinkBudget, expose, fisher, link_budget
from tapetum.simulate.camera import Camera
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.phone import PhoneCamera, open_camera
from tapetum.simulate.plan_parts import EyeCheck
from tapetum.simulate.planning import eye_check
from tapetum.simulate.unknowns import not_told

__all__ = ["LIMITS", "Limit", "Playground", "Result"]

LIMITS = ("gaze_x", "gaze_y", "object_distance")
"""Parameters whose limits are stated, all unknown together."""

_DRAFT = 0.3
"""Accuracy of a first picture, in fractions of the peak: the fewest samples that the engine tries."""
_LIMIT_ACCURACY = 0.01
"""Of the pictures that the limit of a thin lens is computed from: with these it is within 1 % (tests)."""
_SLOW = 0.4
"""Seconds of a thin lens's picture above which its limit is not computed: it takes up to forty times as many."""
_MOST_SAMPLES = 4_000_000
_MOST_PIXELS = 1024 * 1024
_MOST_BYTES = 1 << 30
# Watts that a target is kept for: the picture is in proportion.
_POWER = 1e-3
# A traced lens is prepared for the next of these sines, each so many times the one before, so that it may turn further.
_FIRST_STEP, _STEP, _STEEPEST = 0.01, 1.25, 0.86

Draft = Literal["", "few samples", "thin lens"]
_Target = Camera | PhoneCamera


@dataclass(frozen=True)
class Result:
    """What a scene gives.

    Parameters
    ----------
    image
        The RR, one picture [1, H, W] in W/m² on the probe's sensor, with the engine's metadata.
    frame
        Digital numbers [H, W] of one frame with its noise.
    budget, eye, rays
        The light's way, eye safety at the target's distance, and a drawing in the plane of the gaze.
    draft
        Of a first picture, what it is for now: "few samples", or a "thin lens" in place of a traced one.
    prepared
        Whether the target was kept from an earlier scene.
    seconds
        That all of this took.
    """

    image: Image
    frame: npt.NDArray[np.uint8 | np.uint16]
    budget: LinkBudget
    eye: EyeCheck
    rays: Drawing
    draft: Draft
    prepared: bool
    seconds: float


@dataclass(frozen=True)
class Limit:
    """Cramér-Rao limits of one frame, or why there are none; and the seconds that they took."""

    found: FisherInformation | None
    left_out: dict[str, str]
    seconds: float


class Playground:
    """Computes scenes one after the other, and keeps the targets that it prepared: the last ones used, up to `most`.

    A target serves any gaze up to the steepest one it was prepared for, any power of one wavelength, and all of the
    probe's sensor but its pixels.
    """

    def __init__(self, most: int = 12) -> None:
        self._most = most
        # Of the last scenes' pictures, the target being prepared.
        self._seconds: OrderedDict[Scene, float] = OrderedDict()
        # Fewer than the engine keeps traces of.
        self._traced: deque[tuple[Any, ...]] = deque(maxlen=8)
        self._kept: OrderedDict[tuple[Scene, bool, float], _Target] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def first(self, base: Scene, values: Mapping[str, object], *, seed: int = 0) -> tuple[Scene, Result]:
        """Compute a first picture of a scene with settings changed, as `apply` changes them; also returns its scene.

        Of a lens that was not traced yet at this focus and wavelength it is that of a thin lens, as the link budget
        counts it: tracing takes half a second and more. Else it is `result` with its drafts.
        """
        unturned = apply(base, {name: value for name, value in values.items() if not name.startswith("gaze_")})
        alone = isinstance(unturned.target.lens, PrescriptionLens) and not isinstance(unturned.target, PhoneTarget)
        if alone and _trace_of(unturned) not in self._traced:
            # The traced lens may be possible where the thin one is refused.
            with contextlib.suppress(InputError):
                scene = apply(base, values, thin=True)
                return scene, replace(self.result(scene, seed=seed), draft="thin lens")
        scene = apply(base, values)
        return scene, self.result(scene, draft=True, seed=seed)

    def result(self, scene: Scene, *, draft: bool = False, seed: int = 0) -> Result:
        """Compute a scene.

        Parameters
        ----------
        scene
            Checked, as of `apply`.
        draft
            Whether a traced lens that is not prepared yet may be computed on the fewest samples.
        seed
            Of the frame's noise.

        Raises
        ------
        InputError
            For more pixels than a page should show, samples beyond memory, and all that the engine refuses.
        """
        begin = time.perf_counter()
        _check_size(scene)
        sines = torch.sin(torch.tensor([scene.target.rotation], dtype=torch.float64))
        target, coarse, prepared = self._prepared(scene, largest_sine(sines), draft)
        if isinstance(scene.target.lens, PrescriptionLens):
            self._traced.append(_trace_of(scene))
        # Waiting for other programs does not make a scene slow, nor do several threads make it fast.
        clocks = (time.perf_counter, time.process_time)
        start = [clock() for clock in clocks]
        image = _image(scene, target, sines)
        self._seconds[scene] = min(clock() - at for clock, at in zip(clocks, start, strict=True))
        while len(self._seconds) > self._most:
            self._seconds.popitem(last=False)
        return Result(
            image=image,
            frame=expose(image, scene, seed)[0],
            budget=link_budget(scene),
            eye=eye_check(scene),
            rays=draw_rays(scene),
            draft="few samples" if coarse else "",
            prepared=prepared,
            seconds=time.perf_counter() - begin,
        )

    def limit(self, scene: Scene) -> Limit:
        """Limits of gaze and focus of one frame; of the gaze alone behind a traced lens, whose focus takes long."""
        begin = time.perf_counter()
        _check_size(scene)
        traced = _is_traced(scene)
        reasons = {name: not_told(scene, name) for name in LIMITS}
        if traced and reasons["object_distance"] is None:
            reasons["object_distance"] = "takes long behind a traced lens, ask tapetum plan for it by name"
        if not traced and self._seconds.get(scene, 0.0) > _SLOW:
            reasons = dict.fromkeys(LIMITS, "takes long in this scene, ask tapetum plan for it")
        left_out = {name: why for name, why in reasons.items() if why is not None}
        names = [name for name in LIMITS if name not in left_out]
        own = scene.sampling.accuracy
        found = fisher(scene, names, accuracy=own / 2 if traced else max(own, _LIMIT_ACCURACY)) if names else None
        return Limit(found, left_out, time.perf_counter() - begin)

    def _prepared(self, scene: Scene, steepest: float, draft: bool) -> tuple[_Target, bool, bool]:
        """The scene's target, whether its samples are few, and whether it was there already."""
        optics, traced = _of_optics(scene), _is_traced(scene)
        coarse = traced and draft and scene.sampling.accuracy < _DRAFT
        for few in (False, True)[: 1 + coarse]:
            # A thin lens is planned in milliseconds: for its own tilt, as `tapetum simulate` does.
            fits = [
                key
                for key in self._kept
                if key[:2] == (optics, few) and (key[2] >= steepest if traced else key[2] == steepest)
            ]
            if fits:
                self._kept.move_to_end(fits[-1])
                return self._kept[fits[-1]], few, True
        steps = max(0, math.ceil(math.log(max(steepest, _FIRST_STEP) / _FIRST_STEP) / math.log(_STEP)))
        up_to = max(steepest, min(_FIRST_STEP * _STEP**steps, _STEEPEST)) if traced else steepest
        camera = open_camera(optics, up_to, accuracy=_DRAFT if coarse else None, device="cpu")
        try:
            plan = camera.plan
        except InputError:
            if not coarse:
                raise
            # Too few samples for this lens: the engine says so, and the full picture comes at once.
            return self._prepared(scene, steepest, draft=False)
        # A phone's plan is that of one of its cameras.
        across, down = plan.columns, plan.rows
        if across * down > _MOST_SAMPLES or plan.bytes_needed(1, math.prod(optics.probe.sensor.pixels)) > _MOST_BYTES:
            what = f"{across} x {down} samples over the pupil are more than a page can wait for"
            remedy = "focus nearer to the light's source, stop down, lower the accuracy, or use tapetum simulate"
            raise InputError(what, where="sampling", remedy=remedy)
        self._kept[optics, coarse, up_to] = camera
        while len(self._kept) > self._most:
            self._kept.popitem(last=False)
        return camera, coarse, False


def _is_traced(scene: Scene) -> bool:
    return isinstance(scene.target, PhoneTarget) or isinstance(scene.target.lens, PrescriptionLens)


def _trace_of(scene: Scene) -> tuple[Any, ...]:
    """What the rays through a lens depend on, except for their tilt."""
    target, light = scene.target, scene.illumination
    return target.lens, target.object_distance, light.wavelength, light.curvature(scene.distance)


def _check_size(scene: Scene) -> None:
    columns, rows = scene.probe.sensor.pixels
    if columns * rows > _MOST_PIXELS:
        what = f"{columns} x {rows} pixels are more than the page shows"
        raise InputError(what, where="probe.sensor.pixels", remedy=f"give at most {_MOST_PIXELS} in all")


def _of_optics(scene: Scene) -> Scene:
    """The scene without what does not change where light goes: gaze, noise, and the power of a single wavelength."""
    own = scene.probe.sensor
    sensor = ProbeSensor(pixels=own.pixels, pitch=own.pitch)
    light = scene.illumination if scene.illumination.lines else replace(scene.illumination, power=_POWER)
    target = replace(scene.target, rotation=(0.0, 0.0))
    return replace(scene, target=target, illumination=light, probe=replace(scene.probe, sensor=sensor))


def _image(scene: Scene, camera: _Target, sines: torch.Tensor) -> Image:
    scale = 1.0 if scene.illumination.lines else scene.illumination.power / _POWER
    irradiance = camera(sines).detach() * scale
    equivalent = camera(sines, equivalent=True).detach() * scale if camera.polychromatic else None
    metadata: dict[str, Any] = {
        "rotation_deg": [tuple(math.degrees(angle) for angle in scene.target.rotation)],
        "wavelength": scene.illumination.wavelength,
        **camera.metadata(),
    }
    metadata["irradiance_at_target"] *= scale
    return Image(irradiance, scene.probe.sensor.pitch, metadata, equivalent)
