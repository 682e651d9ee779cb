"""`tapetum simulate`: retro-reflections of a scene, over sweeps of any of its fields."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from tapetum.bench import Scene, field_path, load_scene, with_values
from tapetum.cli.options import AsJson, Changes, Device, Force, SceneName, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError

if TYPE_CHECKING:
    from tapetum.simulate import Image

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".zarr")
_MOST_BYTES, _MOST_VALUES = 4 << 30, 100_000

_SHOWN_AS = {"rotation": "rotation {}°", "object_distance": "focused at {} m", "focal_length": "f = {} m"}


@dataclass(frozen=True)
class Sweep:
    """Values of one field of a scene."""

    key: str
    values: tuple[Any, ...]

    def labels(self) -> list[str]:
        """Their labels in a figure."""
        form = _SHOWN_AS.get(self.key.rsplit(".", 1)[-1], self.key + " = {}")
        return [form.format(f"{value:g}" if isinstance(value, float) else value) for value in self.values]


def simulate(
    scene: SceneName,
    out: Annotated[Path, option("FILE", f"Where to: {', '.join(IMAGE_SUFFIXES)}.", "-o", "--out")],
    changes: Changes = None,
    sweeps: Annotated[
        list[str] | None,
        option("KEY=VALUES", "V1,V2,... or A:B:N, from A to B in N values; two make a grid.", "--sweep"),
    ] = None,
    double: Annotated[bool, typer.Option("--double", help="Compute in double precision.")] = False,
    device: Device = "auto",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Simulate the retro-reflection that a probe sees.

    KEY is a field's path in the scene, or its last words: object_distance. A bare number for rotation is in degrees
    about x; any other is in SI units; units may be given: --set wavelength="532 nm".
    """
    if out.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"unknown image type {out.suffix!r}", where=out, remedy=f"use {', '.join(IMAGE_SUFFIXES)}")
    check_output(out, force, "store of images" if out.suffix.lower() == ".zarr" else None, sources=[scene])
    base = load_scene(scene, changes or ())
    axes = [parse_sweep(text) for text in sweeps or ()]
    if len(axes) > 2:
        raise InputError(f"{len(axes)} sweeps given", where="--sweep", remedy="sweep two fields at the most")
    if len({field_path(axis.key) for axis in axes}) < len(axes):
        raise InputError("the same field is swept twice", where="--sweep", remedy="sweep different fields")
    count = math.prod(len(axis.values) for axis in axes)
    if count * math.prod(base.probe.sensor.pixels) * 8 > _MOST_BYTES:
        remedy = "sweep fewer values, or fewer pixels of the probe"
        raise InputError(f"{count} images are more than memory should hold", where="--sweep", remedy=remedy)
    # Torch takes a second to import.
    import torch

    from tapetum.simulate import retroreflect

    image = _grid(
        base, axes, partial(retroreflect, dtype=torch.complex128 if double else torch.complex64, device=device)
    )
    if out.suffix.lower() == ".png" and axes:
        _draw(image, axes, out)
    else:
        image.save(out, overwrite=force)
    if as_json:
        typer.echo(json.dumps(_record(image, axes, out), allow_nan=False))
    else:
        typer.echo(_say(image, base, out))


def parse_sweep(text: str) -> Sweep:
    """Read `KEY=V1,V2,…` or `KEY=A:B:N`; refuses another form, an unknown key, and an empty sweep."""
    key, sign, values = text.partition("=")
    if not sign or not values.strip():
        raise InputError(f"{text!r} is no sweep", where="--sweep", remedy="write KEY=V1,V2,... or KEY=A:B:N")
    key = key.strip()
    field_path(key)
    steps = re.fullmatch(r"\s*([^:,]+?)\s*:\s*([^:,]+?)\s*:\s*(\d+)\s*", values)
    if not steps:
        given = [value.strip() for value in values.split(",")]
        if not all(given):
            raise InputError(f"{text!r} has an empty value", where="--sweep", remedy="write KEY=V1,V2,...")
        return Sweep(key, tuple(_number(value) for value in given))
    first, last, count = _number(steps[1]), _number(steps[2]), int(steps[3])
    if isinstance(first, str) or isinstance(last, str) or not 1 <= count <= _MOST_VALUES:
        remedy = f"write KEY=A:B:N with numbers and N from 1 to {_MOST_VALUES}"
        raise InputError(f"{text!r} is no range", where="--sweep", remedy=remedy)
    return Sweep(key, tuple(float(v) for v in np.linspace(first, last, count)))


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _grid(base: Scene, axes: list[Sweep], imaged: Callable[..., Image]) -> Image:
    """All images of the sweeps, the first sweep along columns, the second along rows; rotations in one batch."""
    import torch

    from tapetum.simulate import Image

    inner = axes[0] if axes else None
    turning = inner is not None and field_path(inner.key) == ("target", "rotation")
    images: list[Image] = []
    for outer in axes[1].values if len(axes) > 1 else (None,):
        scene = base if outer is None else with_values(base, {axes[1].key: outer}, where="--sweep")
        scenes = (
            [with_values(scene, {inner.key: value}, where="--sweep") for value in inner.values] if inner else [scene]
        )
        if turning:
            # Check every rotation as the scene's own.
            images.append(imaged(scene, np.degrees(np.array([one.target.rotation for one in scenes]))))
        else:
            images += [imaged(one) for one in scenes]
    if len({(image.irradiance.shape[1:], image.pitch) for image in images}) > 1:
        what = "the sweep changes the number or the pitch of the probe's pixels"
        raise InputError(what, where="--sweep", remedy="run it once for each")
    # The accuracy of the whole is that of its worst part.
    worst = max(images, key=lambda image: image.metadata["expected_error"])
    rotations = [r for image in images for r in image.metadata["rotation_deg"]]
    metadata = {**worst.metadata, "rotation_deg": rotations}
    metadata["change_by_area"] = max(image.metadata["change_by_area"] for image in images)
    metadata["sweep"] = {axis.key: list(axis.values) for axis in axes}
    return Image(torch.cat([image.irradiance for image in images]), images[0].pitch, metadata)


def _draw(image: Image, axes: list[Sweep], out: Path) -> None:
    # Matplotlib takes a second to import.
    from tapetum.report import fig_grid, save_figure

    images = image.numpy().reshape(-1, len(axes[0].values), *image.irradiance.shape[1:])
    height, width = (side * image.pitch * 1e6 for side in images.shape[2:])
    second = axes[1] if len(axes) > 1 else None
    figure = fig_grid(
        images,
        row_labels=second.labels() if second else [""],
        col_labels=axes[0].labels(),
        extent=(width, height),
        row_title=second.key if second else "",
        col_title=axes[0].key,
    )
    save_figure(figure, out)


def _record(image: Image, axes: list[Sweep], out: Path) -> dict[str, Any]:
    def finite(value: Any) -> Any:
        return value if isinstance(value, str) or math.isfinite(value) else None

    return {
        **image.metadata,
        "expected_error": finite(image.metadata["expected_error"]),
        "change_by_area": finite(image.metadata["change_by_area"]),
        "sampling": {name: finite(value) for name, value in image.metadata["sampling"].items()},
        "images": len(image),
        "shape": list(image.irradiance.shape),
        "peak": [float(one.max()) for one in image],
        "out": str(out),
        "axes": [axis.key for axis in axes],
    }


def _say(image: Image, scene: Scene, out: Path) -> str:
    from tapetum.simulate.plan_parts import within

    count, rows, columns = image.irradiance.shape
    error = image.metadata["expected_error"]
    asked = scene.sampling.accuracy
    claim = f"error {within(error, rim_light=image.metadata['rim_light'])}"
    claim += f" (asked {asked:g})" if error > 1.05 * asked else ""
    if not math.isfinite(error):
        # Not known, or without meaning, for two reasons.
        claim = "sampled by hand more coarsely than planned: error unknown"
        if scene.sampling.pupil is None and scene.sampling.sensor is None:
            claim = "nothing returns beyond the cut-off"
    change, points = image.metadata["change_by_area"], ""
    if change > asked:
        told = f"their area would change it by {change:.2g} of the peak" if math.isfinite(change) else ""
        points = f"; pixels count as points, {told or 'too far apart to show its fringes'}: see probe.sensor.fill"
    note = image.metadata["propagation"].removeprefix("far field").strip("; ")
    if image.metadata["cut_by_aperture"] > max(asked, error / 2):
        note = "mostly of rings that the probe's aperture cuts off, which sampling.propagation=finite computes"
    plural = "image" if count == 1 else "images"
    return f"{out}: {count} {plural} of {columns} x {rows} pixels, {claim}{points}" + (f" ({note})" if note else "")
