"""`tapetum simulate`: retro-reflections of a scene, over sweeps of any of its fields."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from tapetum.bench import Scene, field_path, load_scene, scene_names, with_values
from tapetum.errors import InputError

if TYPE_CHECKING:
    import torch

    from tapetum.simulate import Image

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".zarr")
_MOST_BYTES, _MOST_VALUES = 4 << 30, 100_000

_SHOWN_AS = {
    "rotation": "rotation {}°",
    "object_distance": "focused at {} m",
    "focal_length": "f = {} m",
}


@dataclass(frozen=True)
class Sweep:
    """Values of one field of a scene."""

    key: str
    values: tuple[Any, ...]

    def labels(self) -> list[str]:
        """How a picture names them."""
        form = _SHOWN_AS.get(self.key.rsplit(".", 1)[-1], self.key + " = {}")
        return [form.format(f"{value:g}" if isinstance(value, float) else value) for value in self.values]


def simulate(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help=f"A bundled scene ({', '.join(scene_names())}) or a YAML file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help=f"Where to: {', '.join(IMAGE_SUFFIXES)}.")],
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change any field of the scene; may be repeated."),
    ] = None,
    sweeps: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep", metavar="KEY=VALUES", help="V1,V2,... or A:B:N, from A to B in N values; two make a grid."
        ),
    ] = None,
    double: Annotated[bool, typer.Option("--double", help="Compute in double precision.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")] = False,
) -> None:
    """Simulate the retro-reflection that a probe sees.

    KEY is a field's path in the scene, or its last words: object_distance. A bare number for rotation is in degrees
    about x; any other is in SI units; units may be given: --set wavelength="532 nm".
    """
    if out.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"unknown image type {out.suffix!r}", where=out, remedy=f"use {', '.join(IMAGE_SUFFIXES)}")
    if out.is_dir():
        # Of a folder nobody knows what else is in it.
        raise InputError("exists already", where=out, remedy="choose another name or remove it first")
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

    image = _grid(base, axes, torch.complex128 if double else torch.complex64)
    if out.suffix.lower() == ".png" and axes:
        _draw(image, axes, out)
    else:
        image.save(out)
    if as_json:
        typer.echo(json.dumps(_record(image, axes, out), allow_nan=False))
    else:
        typer.echo(_say(image, base, out))


def parse_sweep(text: str) -> Sweep:
    """Read `KEY=V1,V2,…` or `KEY=A:B:N`.

    Raises
    ------
    InputError
        For another form, an unknown key, or fewer than one value.
    """
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


def _changed(scene: Scene, values: dict[str, Any]) -> Scene:
    return with_values(scene, values, where="--sweep")


def _grid(base: Scene, axes: list[Sweep], dtype: torch.dtype) -> Image:
    """All images of the sweeps, the first sweep along columns, the second along rows; rotations in one batch."""
    import torch

    from tapetum.simulate import Image, retroreflect

    outer = [{}] if len(axes) < 2 else [{axes[1].key: value} for value in axes[1].values]
    inner = axes[0] if axes else None
    turning = inner is not None and field_path(inner.key) == ("target", "rotation")
    images: list[Image] = []
    for change in outer:
        scene = _changed(base, change) if change else base
        if inner is None:
            images.append(retroreflect(scene, dtype=dtype))
        elif turning:
            # The checks of a scene's own rotation hold for each.
            turned = [_changed(scene, {inner.key: value}).target.rotation for value in inner.values]
            images.append(retroreflect(scene, np.degrees(np.array(turned)), dtype=dtype))
        else:
            images += [retroreflect(_changed(scene, {inner.key: v}), dtype=dtype) for v in inner.values]
    if len({(image.irradiance.shape[1:], image.pitch) for image in images}) > 1:
        what = "the sweep changes the number or the pitch of the probe's pixels"
        raise InputError(what, where="--sweep", remedy="run it once for each")
    # The frame as a whole is as good as its worst part.
    worst = max(images, key=lambda image: image.metadata["expected_error"])
    rotations = [r for image in images for r in image.metadata["rotation_deg"]]
    metadata = {**worst.metadata, "rotation_deg": rotations}
    metadata["sweep"] = {axis.key: list(axis.values) for axis in axes}
    return Image(torch.cat([image.irradiance for image in images]), images[0].pitch, metadata)


def _draw(image: Image, axes: list[Sweep], out: Path) -> None:
    # Matplotlib takes a second to import.
    from tapetum.report import fig_grid, save_figure

    columns = len(axes[0].values)
    images = image.numpy().reshape(-1, columns, *image.irradiance.shape[1:])
    micrometres = image.pitch * 1e6
    rows = axes[1].labels() if len(axes) > 1 else [""]
    save_figure(
        fig_grid(
            images,
            row_labels=rows,
            col_labels=axes[0].labels(),
            extent=(images.shape[3] * micrometres, images.shape[2] * micrometres),
            row_title=axes[1].key if len(axes) > 1 else "",
            col_title=axes[0].key,
        ),
        out,
    )


def _record(image: Image, axes: list[Sweep], out: Path) -> dict[str, Any]:
    error = image.metadata["expected_error"]
    return {
        **image.metadata,
        "expected_error": error if math.isfinite(error) else None,
        "sampling": {
            k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in image.metadata["sampling"].items()
        },
        "images": len(image),
        "shape": list(image.irradiance.shape),
        "peak": [float(one.max()) for one in image],
        "out": str(out),
        "axes": [axis.key for axis in axes],
    }


def _say(image: Image, scene: Scene, out: Path) -> str:
    count, rows, columns = image.irradiance.shape
    error = image.metadata["expected_error"]
    claim = f"error within {error:.1e} of the peak"
    if not math.isfinite(error):
        # Not known, or without meaning, for two reasons.
        claim = "sampled by hand more coarsely than planned: error unknown"
        if scene.sampling.pupil is None and scene.sampling.sensor is None:
            claim = "nothing returns beyond the cut-off"
    note = image.metadata["propagation"].removeprefix("far field").strip("; ")
    plural = "image" if count == 1 else "images"
    return f"{out}: {count} {plural} of {columns} x {rows} pixels, {claim}" + (f" ({note})" if note else "")
