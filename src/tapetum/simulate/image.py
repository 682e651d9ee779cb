"""The irradiance a simulation puts on the probe's pixels, with where it came from."""

# Matplotlib and Zarr type these functions in part only.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import html
import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["IMAGE_SUFFIXES", "Image"]

IMAGE_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".zarr")


@dataclass(frozen=True, eq=False, repr=False)
class Image:
    """One or many retro-reflections on the same pixels.

    Parameters
    ----------
    irradiance
        [B, H, W] in W/m² on the probe's sensor; carries gradients where the scene's values do.
    pitch
        Pixel pitch in metres.
    metadata
        Plain values: rotations in degrees, wavelength, sampling and its expected error.
    equivalent
        For several wavelengths: the irradiance of the metadata's wavelength with as many photons.
    """

    irradiance: torch.Tensor
    pitch: float
    metadata: dict[str, Any] = field(default_factory=dict[str, Any])
    equivalent: torch.Tensor | None = None

    @property
    def light(self) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² as a sensor counts it: of the metadata's wavelength."""
        return self.irradiance if self.equivalent is None else self.equivalent

    def __len__(self) -> int:
        return len(self.irradiance)

    def __iter__(self) -> Iterator[torch.Tensor]:
        return iter(self.irradiance)

    def numpy(self) -> npt.NDArray[np.float64]:
        """The irradiance as float64, [B, H, W]."""
        return self.irradiance.detach().to("cpu", torch.float64).numpy()

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """`numpy.asarray(image)`: the irradiance as float64, [B, H, W]; `numpy.array(image)`: a copy of it."""
        array = self.numpy() if dtype is None else self.numpy().astype(dtype, copy=False)
        held = self.irradiance.device.type == "cpu" and self.irradiance.dtype == torch.float64
        copied = not held or array.dtype != np.float64
        if copy is False and copied:
            what = f"is {self.irradiance.dtype} on {self.irradiance.device}, no {array.dtype} array without a copy"
            raise InputError(what, where="image", remedy="leave copy out")
        return array.copy() if copy and not copied else array

    def to_xarray(self) -> xr.DataArray:
        """The irradiance as a labelled array [image, y, x] in W/m².

        `x` and `y` are in metres from the middle of the sensor (x right, y down), rotations in degrees along `image`;
        other metadata are attributes.
        """
        import xarray

        count, height, width = self.irradiance.shape
        axes = {
            name: (name, (np.arange(size) - (size - 1) / 2) * self.pitch, {"units": "m"})
            for name, size in (("y", height), ("x", width))
        }
        turned = self.metadata.get("rotation_deg")
        if turned is not None and len(turned) == count:
            for k, name in enumerate(("rotation_y", "rotation_x")):
                axes[name] = ("image", np.array([one[k] for one in turned], np.float64), {"units": "degree"})
        rest = {name: value for name, value in self.metadata.items() if name != "rotation_deg"}
        attributes = {"units": "W/m^2", "pitch": self.pitch, **_plain(rest)}
        return xarray.DataArray(np.array(self), axes, ("image", "y", "x"), "irradiance", attributes)

    def plot(self, *, columns: int = 4) -> Figure:
        """Draw the square root of each irradiance, scaled to its own peak, `columns` in a row; axes in millimetres.

        The figure belongs to no window: a notebook shows it, `savefig` writes it.
        """
        from matplotlib.figure import Figure

        wide = max(1, min(columns, len(self)))
        figure = Figure(figsize=(3 * wide, 3 * -(-len(self) // wide)), layout="constrained")
        half = [size * self.pitch * 1e3 / 2 for size in self.irradiance.shape[1:]]
        for n, image in enumerate(self.numpy()):
            axis = figure.add_subplot(-(-len(self) // wide), wide, n + 1)
            axis.imshow(_stretched(image), cmap="inferno", extent=(-half[1], half[1], half[0], -half[0]))
            axis.set_title(self._title(n), fontsize=9)
            axis.set_xlabel("x, mm")
            axis.set_ylabel("y, mm")
        return figure

    def _title(self, number: int) -> str:
        turned = self.metadata.get("rotation_deg")
        return f"image {number}" if turned is None else f"{turned[number][0]:g}°, {turned[number][1]:g}°"

    def __repr__(self) -> str:
        count, height, width = self.irradiance.shape
        peak = float(self.irradiance.detach().max()) if self.irradiance.numel() else 0.0
        return f"<Image: {count} of {width} x {height} pixels of {self.pitch * 1e6:g} µm, peak {peak:.3g} W/m²>"

    def _repr_html_(self) -> str:
        """For notebooks: the first images, with their metadata."""
        import base64

        few = self.numpy()[:4]
        png = _encoded(".png", [np.hstack([_stretched(image) for image in few])]) if len(few) else b""
        more = f", the first {len(few)} shown" if len(few) < len(self) else ""
        picture = f'<img alt="" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        words = html.escape(repr(self)[1:-1])
        return f"<figure>{picture}<figcaption>{words}{more}; square root of the irradiance</figcaption></figure>"

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the images to one file, in place of one that exists, or to a store.

        `.npy`: float64 irradiance, [H, W] for one image and [B, H, W] for several. `.tif`: a float32 page an image.
        `.png`: all images beside each other, square root of the irradiance, each to its own peak: to look at, not to
        measure. `.zarr`: irradiance with pitch and metadata.

        Parameters
        ----------
        path
            The file or, by its suffix `.zarr`, the store to write.
        overwrite
            Replace a store that this wrote earlier. No other folder ever is.

        Raises
        ------
        InputError
            For another suffix, a folder that may not be replaced, or a place that cannot be written.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in IMAGE_SUFFIXES:
            raise InputError(
                f"unknown image type {path.suffix!r}", where=path, remedy=f"use {', '.join(IMAGE_SUFFIXES)}"
            )
        images = self.numpy()
        if suffix == ".zarr":
            import zarr

            with atomic_folder(path, "store of images", overwrite=overwrite) as part:
                group = zarr.open_group(part, mode="w")
                group.create_array("irradiance", data=images)
                group.attrs.update({"units": "W/m^2", "pitch_m": self.pitch, **_plain(self.metadata)})
            return path
        with atomic_file(path) as part:
            # Encoded in memory first: NumPy and OpenCV do not say why a write to disk fails.
            if suffix == ".npy":
                buffer = io.BytesIO()
                np.save(buffer, images[0] if len(images) == 1 else images)
                part.write_bytes(buffer.getbuffer())
            elif suffix == ".png":
                part.write_bytes(_encoded(suffix, [np.hstack([_stretched(image) for image in images])]))
            else:
                part.write_bytes(_encoded(suffix, [image.astype(np.float32) for image in images]))
        return path

    def show(self) -> None:
        """Show the images in a Matplotlib window, square root of the irradiance, each to its own peak."""
        from matplotlib import pyplot

        _, axes = pyplot.subplots(1, len(self), squeeze=False, figsize=(3 * len(self), 3))
        rotations = self.metadata.get("rotation_deg", [None] * len(self))
        for axis, image, rotation in zip(axes[0], self.numpy(), rotations, strict=True):
            axis.imshow(_stretched(image), cmap="inferno")
            axis.set_axis_off()
            if rotation is not None:
                axis.set_title(f"{rotation[0]:g}°, {rotation[1]:g}°")
        pyplot.show()


def _stretched(image: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    peak = image.max()
    return np.round(255 * np.sqrt(np.clip(image, 0, None) / (peak if peak > 0 else 1))).astype(np.uint8)


def _encoded(suffix: str, pages: list[npt.NDArray[Any]]) -> bytes:
    import cv2

    done, data = cv2.imencodemulti(suffix, pages)
    if not done:
        shape = tuple(pages[0].shape)
        raise InputError(f"no {suffix} can hold images of {shape}", where="image", remedy="write .npy or .zarr")
    return data.tobytes()


def _plain(metadata: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(metadata, default=float))
