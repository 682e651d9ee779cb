"""Retro-reflections of one target, frame by frame, as patches on the probe's sensor."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import affine_transform

from tapetum.bench import PhoneTarget, Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.record.patch import Patch
from tapetum.simulate import Camera, tilt_of_gaze
from tapetum.simulate import dots as dot_light
from tapetum.simulate.foreshortening import turned
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.phone import phone_scenes, seen_from_probe
from tapetum.simulate.pixel_area import PixelArea
from tapetum.simulate.radiometry import photoelectrons, photon_energy

__all__ = ["Flashes", "Returns", "flashes_of", "returns_of", "windows_of"]

Array = npt.NDArray[np.float64]

# Frames rendered together: always the same ones, so that a frame does not depend on which others are requested.
_BATCH = 8
_CAMERAS_KEPT, _BATCHES_KEPT = 64, 2
# Accuracy (fraction of the peak) from which rotated images may be interpolated coarsely.
_COARSE = 0.025
# Fraction of a beam's peak below which its flank is not drawn.
_FAINT = 1e-3
# What an RR's light may have left where its patch ends, in the mean along an edge, over the brightest peak: within
# crops a hundredth of a digital number of 8 bits, beyond them three. Much more shows in the mean of many pixels, and
# networks learn where patches end.
_LEFT_IN_CROPS, _LEFT = 3e-5, 1e-4
# Width of a crop of 400 pixels and of what it may be off the patch's middle.
_CROPS = 481
# Beyond the edge of a picture out of focus light falls with the square of the distance, of one in focus with the cube.
_FALL, _WIDER = 2.5, (1.1, 1.5)
# Width behind the probe's aperture, over the usual one: what the widest return of the Focusing set needs, at 135 mm.
_AT_ONCE = 1.4
# A window of its own pays, for a beam or beside the one on which light was measured, where it is smaller than this.
_SMALLER = 0.8
# Tilts, over the steepest one, at which the light that is left is measured.
_TRIED = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.7, 0.7), (1.0, 0.0))


class Returns:
    """A target that moves before a probe; renders its RR in any frame.

    `tilts` [T, 2] are the target's tilts against the light, as sines, before it rolls; `place` [T, 2] its sideways
    position and `distance` [T] that from the probe, in metres; `roll` [T] its rotation about its optical axis, in
    radians from x to y. All light rotates with it except that of the second beam. The scene's own rotation is not used.

    Curved wavefronts (diverging light of a fixed area) need a simulation for each distance. Nodes of 1/d are spaced so
    closely that the phase error at the lens's edge, kr²/2 times the error of 1/d, stays below the scene's accuracy in
    radians; the irradiance, which falls as 1/d², is exact in each frame. Where the return overfills the probe's
    aperture R, the cut depends on the distance too, with r² + 2rR in place of r².

    A traced lens is planned for as many pictures as a distance has frames, see `Camera`.
    """

    def __init__(self, scene: Scene, tilts: torch.Tensor, place: Array, roll: Array, distance: Array) -> None:
        self.scene, self._roll, self._distance = scene, roll, distance
        sensor = scene.probe.sensor
        self._sines = _turned(tilts, roll)
        # A sideways shift of the target shifts its RR by f_p/d times as much.
        self._centres = torch.from_numpy(place * (scene.probe.lens.focal_length / distance)[:, None])
        columns, rows = sensor.pixels
        self.pixels = (np.array([columns, rows]) - 1) / 2 + self._centres.numpy() / sensor.pitch
        one = torch.ones((), dtype=torch.float64)
        self._electrons = float(photoelectrons(one, sensor, scene.illumination.wavelength))
        if distance.min() < 4 * scene.target.lens.focal_length:
            what = f"the target comes as near as {distance.min():.3g} m, which its lens cannot be simulated at"
            raise InputError(what, where="motion", remedy="walk less far, or reach out less")
        self._round, steepest = _is_round(scene), largest_sine(tilts)

        def opened(node: float, pictures: int = 1) -> Camera:
            # On the CPU, as a GPU would round differently; "dimmed" lets a spot cross the sensor's edge.
            at = replace(scene, distance=node)
            return Camera(at, steepest, edge="dimmed", pictures=pictures, device="cpu")

        ends = {float(distance.min()), float(distance.max())}
        self._node = self._nodes(any(opened(end).finite for end in ends))
        frames = len(distance) // len(np.unique(self._node))
        whole = functools.lru_cache(1)(lambda node: opened(node, frames))
        self._windows, planned = self._widest({end: whole(end) for end in ends}, steepest)
        kept = {node: camera for node, camera in planned.items() if node in self._node}
        self._camera_at = functools.lru_cache(_CAMERAS_KEPT)(
            lambda node, window: (kept.get(node) or whole(node)).on(window)
        )
        # Spline errors stay below 1e-3 of the peak for fringes of 7 pixels (cubic) or 4 pixels (quintic).
        fringe = scene.illumination.wavelength * scene.probe.lens.focal_length / (2 * scene.target.lens.aperture_radius)
        self._order = 3 if fringe >= 7 * sensor.pitch else 5
        # OpenCV is ten times as fast, but interpolates at steps of 1/32 pixel: errors up to 1e-2 of the peak.
        if scene.sampling.accuracy >= _COARSE and fringe >= 7 * sensor.pitch:
            self._order = 0
        # A weak reference avoids a cycle that would keep the cameras until garbage collection.
        own = weakref.proxy(self)
        self._batch = functools.lru_cache(_BATCHES_KEPT)(lambda number: own._render(number))

    def patches(self, frame: int) -> list[Patch]:
        """Return the patch of every beam in a frame, at the scene's power and exposure."""
        return self._batch(frame // _BATCH)[frame % _BATCH]

    def _widest(self, cameras: dict[float, Camera], steepest: float) -> tuple[dict[float, Grid], dict[float, Camera]]:
        """Return the window that holds a beam's RR at every distance, by its share of the light, and the cameras that
        were planned for this, by distance."""
        away, windows = float(self._centres.abs().max()), dict[float, Grid]()
        planned: dict[float, Camera] = {}
        for end, camera in cameras.items():
            found, planned[end] = windows_of(camera, steepest, away)
            for share, window in found.items():
                windows[share] = max(windows.get(share, window), window, key=lambda grid: grid.rows)
        return windows, planned

    def _nodes(self, finite: bool) -> Array:
        """Return the distance at which each frame is simulated, [T] in metres."""
        light, d = self.scene.illumination, self._distance
        if not light.wave.spherical and not finite:
            return np.full_like(d, self.scene.distance)
        if np.ptp(d) == 0:
            return d
        radius, aperture = self.scene.target.lens.aperture_radius, self.scene.probe.lens.aperture_radius
        area = radius**2 + (2 * radius * aperture if finite else 0.0)
        # At most half a step off: (2π/λ) area/2 · step/2 radians.
        step = 2 * self.scene.sampling.accuracy * light.wavelength / (math.pi * area)
        return 1 / (np.maximum(1, np.rint(1 / (d * step))) * step)

    def _render(self, number: int) -> list[list[Patch]]:
        frames = np.arange(number * _BATCH, min((number + 1) * _BATCH, len(self._distance)))
        found: list[list[Patch]] = [[] for _ in frames]
        nodes = self._node[frames]
        for node in np.unique(nodes):
            these = frames[nodes == node]
            with _one_thread():
                for frame, patch in self._render_at(float(node), these):
                    found[frame - frames[0]].append(patch)
        return found

    def _render_at(self, node: float, frames: npt.NDArray[np.int64]) -> Iterator[tuple[int, Patch]]:
        sensor = self.scene.probe.sensor
        gain = self._electrons * self.scene.illumination.spread(self._distance[frames], node)
        rolled = not self._round and bool(self._roll[frames].any())
        middle = (np.array(sensor.pixels) - 1) / 2
        widest = self._camera_at(node, max(self._windows.values(), key=lambda grid: grid.rows))
        for tilts, places, share in widest.beams(self._sines[frames], self._centres[frames]):
            window = self._windows[share]
            camera, half = self._camera_at(node, window), (window.rows - 1) / 2
            # Patches start on whole pixels; the sub-pixel rest of the place is rendered.
            corner = np.rint(middle + places.numpy() / sensor.pitch - half)
            rest = middle + places.numpy() / sensor.pitch - half - corner
            offset = torch.from_numpy(rest * sensor.pitch)
            if rolled and camera.takes_roll:
                roll = torch.from_numpy(self._roll[frames])
                images = camera.render(tilts, offset, share, equivalent=True, roll=roll).numpy()
            elif rolled:
                own = _turned(tilts, -self._roll[frames])
                images = camera.render(own, torch.zeros_like(places), share, equivalent=True).numpy()
                turns = zip(images, self._roll[frames], rest, strict=True)
                images = [_turn(one, roll, shift, self._order) for one, roll, shift in turns]
            else:
                images = camera.render(tilts, offset, share, equivalent=True).numpy()
            for frame, image, scale, (left, top) in zip(frames, images, gain, corner, strict=True):
                yield int(frame), Patch(int(left), int(top), np.asarray(image * np.float32(scale), np.float32))


def returns_of(scene: Scene, gaze: Array, place: Array, roll: Array, distance: Array) -> list[Returns]:
    """Return the returns of a target, or of all cameras of a phone, that whose gaze is given first.

    `gaze` [T, 2] is the laser's place in the target's field, in fractions of it; all else as for `Returns`.
    """
    tilts = tilt_of_gaze(scene, torch.from_numpy(gaze))
    rolled = _turned(tilts, roll)
    found: list[Returns] = []
    for unit in sorted(phone_scenes(scene), key=lambda unit: unit.place != (0.0, 0.0)):
        on_plate = _turned(torch.tensor([unit.place], dtype=torch.float64).expand(len(gaze), -1), roll)
        seen = seen_from_probe(on_plate, rolled)
        aside = _turned(seen / torch.from_numpy(distance)[:, None], -roll)
        found.append(Returns(unit.scene, unit.sines(tilts, aside), place + seen.numpy(), roll, distance))
    return found


class Flashes:
    """Direct light of the dot projector of a moving phone in the probe's frames.

    `seconds` [T] is how long the projector shines during each frame; `tilts`, `place`, `roll` and `distance` are as for
    `Returns`, of the camera whose gaze is given.
    """

    def __init__(self, scene: Scene, seconds: Array, tilts: Array, place: Array, roll: Array, distance: Array) -> None:
        assert isinstance(scene.target, PhoneTarget) and scene.target.phone.dots is not None
        self._dots, self._probe = scene.target.phone.dots, scene.probe
        self._accuracy = scene.sampling.accuracy
        self._seconds, self._distance, self._roll = seconds, distance, roll
        self._offsets = dot_light.beam_offsets(dot_light.beam_directions(self._dots), tilts, distance)
        gazing = scene.target.unit.position
        apart = [one - other for one, other in zip(self._dots.position, gazing, strict=True)]
        on_plate = _turned(torch.tensor([apart], dtype=torch.float64).expand(len(tilts), -1), roll)
        seen = seen_from_probe(on_plate, _turned(torch.from_numpy(tilts), roll)).numpy()
        self._centres = (place + seen) * (scene.probe.lens.focal_length / distance)[:, None]

    def patch(self, frame: int) -> Patch | None:
        """Return the electrons in a frame; None where no pulse or no beam reaches it."""
        lens, sensor, dots = self._probe.lens, self._probe.sensor, self._dots
        distance, offsets = float(self._distance[frame]), self._offsets[frame]
        waist = dot_light.waist_at(distance)
        past = np.maximum(0.0, np.hypot(offsets[:, 0], offsets[:, 1]) - lens.aperture_radius) / waist
        met = np.exp(-2 * past**2) > _FAINT
        if not self._seconds[frame] or not met.any():
            return None
        window = dot_light.dot_window(distance, lens.aperture_radius, lens.focal_length, dots.wavelength, sensor.pitch)
        middle = (np.array(sensor.pixels) - 1) / 2 + self._centres[frame] / sensor.pitch
        corner = np.rint(middle - (window.columns - 1) / 2)
        rest = (middle - (window.columns - 1) / 2 - corner) * sensor.pitch
        finest = dots.wavelength * lens.focal_length / (2 * lens.aperture_radius)
        area = PixelArea.of(window, sensor.fill, finest, self._accuracy)
        with _one_thread():
            light = dot_light.dot_image(
                area.samples,
                _turned(torch.from_numpy(offsets[met]), np.full(int(met.sum()), self._roll[frame])).numpy(),
                power=dots.power / (dots.columns * dots.rows),
                divergence=dot_light.DIVERGENCE,
                wavelength=dots.wavelength,
                distance=distance,
                radius=lens.aperture_radius,
                focal_length=lens.focal_length,
                centre=(float(rest[0]), float(rest[1])),
            )
            light = area.means(light).numpy()
        kept = self._probe.transmission * dot_light.PASSED * dot_light.EFFICIENCY
        gain = kept * sensor.pitch**2 * self._seconds[frame] / photon_energy(dots.wavelength)
        return Patch(int(corner[0]), int(corner[1]), np.asarray(gain * light, np.float32))


def flashes_of(
    scene: Scene, times: Array, exposure: Array, phase: float, held: tuple[Array, Array, Array, Array]
) -> Flashes | None:
    """Return the flashes of a phone with a dot projector and an open camera app; None for any other target.

    `times` [T] and `exposure` [T] are the middle and duration of the probe's exposures in seconds, `phase` that of the
    pulses (0 to 1 of their period), `held` gaze, place, roll and distance as for `returns_of`.
    """
    target = scene.target
    if not isinstance(target, PhoneTarget) or target.phone.dots is None or not target.imaging:
        return None
    gaze, place, roll, distance = held
    seconds = dot_light.lit_time(target.phone.dots, times, exposure, phase * target.phone.dots.period)
    return Flashes(scene, seconds, tilt_of_gaze(scene, torch.from_numpy(gaze)).numpy(), place, roll, distance)


def windows_of(camera: Camera, steepest: float, away: float) -> tuple[dict[float, Grid], Camera]:
    """Return windows that cut a beam's RR off only where little of its light is left, by the beam's share of the light.

    The light is measured at several tilts, on a window that is widened until little is left at its edges. The second
    result is the camera on which it was measured: planning for a traced lens takes seconds, and serves what is
    narrower.

    Parameters
    ----------
    camera
        What is to be rendered; its own pixels are not used.
    steepest
        Sine of the steepest tilt.
    away
        How far from the middle of the probe's sensor an RR may lie, in metres: no window is wider than the frame.
    """
    sensor, none = camera.scene.probe.sensor, torch.zeros((1, 2), dtype=torch.float64)
    shares = {share for _, _, share in camera.beams(none, none)}
    most = _odd(max(sensor.pixels) + 2 * math.ceil(away / sensor.pitch))
    usual = camera.window().rows
    side = max(usual, min(2 * usual - 1, _CROPS, most))
    if camera.finite:
        # Behind the probe's aperture a wide window takes no more planning than a narrow one, and serves any narrower.
        side = max(side, min(_odd(math.ceil(_AT_ONCE * usual)), most))
    tried = camera.on(Grid(side, side, sensor.pitch))
    with _one_thread():
        left = _left_at_edges(tried, steepest)
        while side < most and left[-1] > (least := _LEFT_IN_CROPS if side < _CROPS else _LEFT):
            wider = min(max((left[-1] / least) ** (1 / _FALL), _WIDER[0]), _WIDER[1])
            side = min(_odd(math.ceil(wider * side)), most)
            tried = camera.on(Grid(side, side, sensor.pitch))
            left = _left_at_edges(tried, steepest)
    sides: dict[float, int] = {}
    for share in shares:
        inside, outside = (_least(left * share / max(shares), least) for least in (_LEFT_IN_CROPS, _LEFT))
        sides[share] = max(usual, min(inside, max(outside, _CROPS), side))
    for largest in (side, max(sides.values())):
        sides = {share: one if one < _SMALLER * largest else largest for share, one in sides.items()}
    return {share: Grid(one, one, sensor.pitch) for share, one in sides.items()}, tried


def _odd(pixels: int) -> int:
    return pixels + 1 - pixels % 2


def _left_at_edges(camera: Camera, steepest: float) -> Array:
    """Mean light along the brightest edge of squares in a window's middle, over the brightest peak, of some tilts.

    The squares, [N], are 1, 3, 5 … pixels wide, the last as wide as the window.
    """
    tilts = steepest * torch.tensor(_TRIED, dtype=torch.float64)
    images = camera.render(tilts, torch.zeros_like(tilts), equivalent=True).double().numpy()
    middle = images.shape[1] // 2
    left = np.empty(middle + 1)
    for half in range(middle + 1):
        first, last = middle - half, middle + half
        square = images[:, first : last + 1, first : last + 1]
        left[half] = max(edge.mean(axis=1).max() for k in (0, -1) for edge in (square[:, k], square[:, :, k]))
    return left / max(float(images.max()), np.finfo(np.float64).tiny)


def _least(left: Array, most: float) -> int:
    """Width of the smallest square at whose edges, and at those of all wider ones, at most so much light is left."""
    above = np.flatnonzero(left > most)
    return 2 * (int(above[-1]) + 1 if len(above) else 0) + 1


def _is_round(scene: Scene) -> bool:
    """Return whether rotating the target about its axis equals rotating the incoming light."""
    sensor = scene.target.sensor
    straight = all(plane.tilt == (0.0, 0.0) for plane in (sensor, *sensor.layers))
    return straight and sensor.array is None and sensor.microlens is None and sensor.mask is None


def _turned(sines: torch.Tensor, angle: Array) -> torch.Tensor:
    """Return vectors [T, 2] rotated from x to y by angles [T]."""
    return turned(sines, torch.from_numpy(angle)) if angle.any() else sines


def _turn(image: npt.NDArray[np.float32], angle: float, shift: Array, order: int) -> npt.NDArray[np.float32]:
    """Return an image rotated from x to y and shifted by a sub-pixel, by splines; order 0 is OpenCV's bicubic."""
    c, s = math.cos(angle), math.sin(angle)
    middle = (np.array(image.shape) - 1) / 2
    # Maps (row, column) of the new image to the old one.
    back = np.array([[c, -s], [s, c]])
    if order == 0:
        x, y = middle[1] + shift[0], middle[0] + shift[1]
        forth = np.array([[c, -s, x - c * middle[1] + s * middle[0]], [s, c, y - s * middle[1] - c * middle[0]]])
        size = (image.shape[1], image.shape[0])
        return np.maximum(np.asarray(cv2.warpAffine(image, forth, size, flags=cv2.INTER_CUBIC), np.float32), 0)
    offset: Any = middle - back @ (middle + shift[::-1])
    turned = affine_transform(image, back, offset, order=order, mode="constant")
    return np.maximum(np.asarray(turned, np.float32), 0)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute in one thread, because the last bits of a product depend on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
