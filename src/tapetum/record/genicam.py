"""Machine-vision cameras (GenICam: GigE Vision, USB3 Vision) by Aravis, or by Harvesters with a maker's producer.

Aravis comes with Linux distributions (`gir1.2-aravis-0.8` and `python3-gi` on Debian) and needs nothing of the maker;
Harvesters (extra `cameras`) needs a GenTL producer, a `.cti` file that GENICAM_GENTL64_PATH leads to. Buffers are
copied at once and given back, frames are numbered by the camera, and lost ones counted.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tapetum.errors import InputError
from tapetum.record.pixels import FORMATS, decode
from tapetum.record.source import Arrival, Live

__all__ = ["Backend", "Found", "GenicamCamera", "backends", "find_genicam", "is_genicam"]

PREFIX = "genicam:"
_BUFFERS = 16
_PATIENCE = 5.0  # s without a frame
_INSTALL = "install Aravis (Debian: gir1.2-aravis-0.8, python3-gi), or pip install 'tapetum[cameras]' and a producer"

Found = tuple[str, str, list[str]]
"""A camera: its name for `genicam:NAME`, maker and model, and its grey forms."""
Raw = tuple[bytes, str, int, int, int, int]
"""A frame: bytes, form, width, height, number by the camera, UTC in ns of its arrival."""


class Backend(Protocol):
    """A library that reads such cameras."""

    name: str

    def list(self) -> list[Found]:
        """Return the cameras that it sees."""
        ...

    def open(self, ident: str, form: str | None, rate: float | None) -> Opened:
        """Open a camera and start it. Raises an InputError."""
        ...


class Opened(Protocol):
    """A camera that streams."""

    hardware: dict[str, Any]
    rate: float | None

    def next(self, seconds: float) -> Raw | None:
        """Return the next whole frame, or None after that time."""
        ...

    def close(self) -> None:
        """Stop and release it."""
        ...


def is_genicam(source: str) -> bool:
    """Return whether a text names such a camera: `genicam:` and what `tapetum cameras` calls it."""
    return source.startswith(PREFIX)


def _deepest(forms: list[str], wanted: str | None, where: str) -> str:
    grey = [form for form in forms if form in FORMATS]
    if wanted is not None:
        if wanted not in grey:
            raise InputError(f"offers no {wanted}", where=where, remedy=f"ask for one of {', '.join(grey) or 'none'}")
        return wanted
    if not grey:
        offered = ", ".join(forms) or "nothing"
        raise InputError(f"offers no grey form, but {offered}", where=where, remedy="use a monochrome camera")
    # Of one depth, whole words need no unpacking.
    return max(grey, key=lambda form: (FORMATS[form].bits, not FORMATS[form].pieces))


class Aravis:
    """Cameras by Aravis, through its introspection."""

    name = "Aravis"

    def __init__(self, *, simulated: bool = False) -> None:
        import gi  # pyright: ignore[reportMissingImports]

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis as library  # pyright: ignore[reportMissingImports]

        self.library: Any = library
        if simulated:
            library.enable_interface("Fake")

    def list(self) -> list[Found]:
        """Return the cameras that Aravis sees; those that are in use show no forms."""
        self.library.update_device_list()
        found: list[Found] = []
        for n in range(self.library.get_n_devices()):
            ident = self.library.get_device_id(n)
            words = f"{self.library.get_device_vendor(n)} {self.library.get_device_model(n)}"
            forms: list[str] = []
            with contextlib.suppress(Exception):
                forms = list(self.library.Camera.new(ident).dup_available_pixel_formats_as_strings())
            found.append((ident, words, forms))
        return found

    def open(self, ident: str, form: str | None, rate: float | None) -> Opened:
        """Open a camera by its name, or the first where the name is empty."""
        where = PREFIX + ident
        try:
            camera = self.library.Camera.new(ident or None)
        except Exception as error:
            remedy = "see `tapetum cameras`, and close what else uses it"
            raise InputError(
                f"no such camera, or it is in use ({_short(error)})", where=where, remedy=remedy
            ) from error
        chosen = _deepest(list(camera.dup_available_pixel_formats_as_strings()), form, where)
        try:
            return _AravisStream(self.library, camera, chosen, rate)
        except Exception as error:
            remedy = "close what else uses the camera, or plug it in again"
            raise InputError(f"refuses {chosen} ({_short(error)})", where=where, remedy=remedy) from error


class _AravisStream:
    """An Aravis camera that streams."""

    def __init__(self, library: Any, camera: Any, form: str, rate: float | None) -> None:
        self.library, self.form = library, form
        self.camera: Any = camera
        camera.set_pixel_format_from_string(form)
        if rate is not None:
            camera.set_frame_rate(rate)
        told: dict[str, Any] = {}
        for name, read in (
            ("exposure", lambda: camera.get_exposure_time() / 1e6),
            ("gain", camera.get_gain),
            ("frames_a_second", camera.get_frame_rate),
            ("serial", camera.get_device_serial_number),
        ):
            with contextlib.suppress(Exception):
                told[name] = read()
        self.rate = told.get("frames_a_second", rate)
        self.hardware = {"maker": camera.get_vendor_name(), "model": camera.get_model_name(), "format": form, **told}
        payload = camera.get_payload()
        self.stream: Any = camera.create_stream(None, None)
        for _ in range(_BUFFERS):
            self.stream.push_buffer(library.Buffer.new_allocate(payload))
        camera.start_acquisition()

    def next(self, seconds: float) -> Raw | None:
        """Return the next whole frame; incomplete ones are given back, and count as lost by their numbers."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            buffer = self.stream.timeout_pop_buffer(int(left * 1e6))
            if buffer is None:
                return None
            try:
                if buffer.get_status() != self.library.BufferStatus.SUCCESS:
                    continue
                size = buffer.get_image_width(), buffer.get_image_height()
                number, utc = buffer.get_frame_id(), buffer.get_system_timestamp()
                return bytes(buffer.get_data()), self.form, *size, number, utc or time.time_ns()
            finally:
                self.stream.push_buffer(buffer)
        return None

    def close(self) -> None:
        """Stop the camera; the objects go with their last name."""
        with contextlib.suppress(Exception):
            self.camera.stop_acquisition()
        self.stream = self.camera = None


class Harvesters:
    """Cameras by Harvesters and the GenTL producers of GENICAM_GENTL64_PATH; whole words only."""

    name = "Harvesters"

    def __init__(self) -> None:
        from harvesters.core import Harvester  # pyright: ignore[reportMissingImports]

        self.harvester: Any = Harvester()
        places = os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep)
        self.producers = [str(file) for place in places if place for file in sorted(Path(place).glob("*.cti"))]
        for file in self.producers:
            self.harvester.add_file(file)

    def list(self) -> list[Found]:
        """Return the cameras that the producers see."""
        self.harvester.update()
        return [(str(one.id_), f"{one.vendor} {one.model}", []) for one in self.harvester.device_info_list]

    def open(self, ident: str, form: str | None, rate: float | None) -> Opened:
        """Open a camera by its name, or the first where the name is empty."""
        where = PREFIX + ident
        names = [one[0] for one in self.list()]
        if not names or (ident and ident not in names):
            raise InputError("no such camera", where=where, remedy="see `tapetum cameras`; is a producer installed?")
        try:
            acquirer = self.harvester.create({"id_": ident or names[0]})
            return _HarvestersStream(acquirer, form, rate, where)
        except InputError:
            raise
        except Exception as error:
            remedy = "close what else uses the camera, or plug it in again"
            raise InputError(f"refuses ({_short(error)})", where=where, remedy=remedy) from error


class _HarvestersStream:
    """A camera of Harvesters that streams."""

    def __init__(self, acquirer: Any, form: str | None, rate: float | None, where: str) -> None:
        self.acquirer = acquirer
        nodes = acquirer.remote_device.node_map
        offered = [str(one) for one in nodes.PixelFormat.symbolics]
        whole = [one for one in offered if one in FORMATS and not FORMATS[one].pieces]
        nodes.PixelFormat.value = self.form = _deepest(whole, form, where)
        self.rate = rate
        if rate is not None:
            with contextlib.suppress(Exception):
                nodes.AcquisitionFrameRate.value = rate
        self.hardware: dict[str, Any] = {"format": self.form, "model": str(acquirer.device.module.model)}
        with contextlib.suppress(Exception):
            self.hardware["exposure"] = float(nodes.ExposureTime.value) / 1e6
        acquirer.start()

    def next(self, seconds: float) -> Raw | None:
        """Return the next frame."""
        try:
            fetched = self.acquirer.fetch(timeout=seconds)
        except Exception as error:
            if "imeout" in type(error).__name__:
                return None
            raise
        with fetched as buffer:
            part = buffer.payload.components[0]
            data = np.ascontiguousarray(part.data).tobytes()
            return data, self.form, part.width, part.height, buffer.module.frame_id, time.time_ns()

    def close(self) -> None:
        """Stop and release the camera."""
        with contextlib.suppress(Exception):
            self.acquirer.stop()
        with contextlib.suppress(Exception):
            self.acquirer.destroy()


def backends() -> list[Backend]:
    """Return the libraries that are installed, the preferred one first."""
    found: list[Backend] = []
    for kind in (Aravis, Harvesters):
        with contextlib.suppress(ImportError, ValueError):
            found.append(kind())
    return found


def find_genicam() -> list[Found] | None:
    """Return the cameras that the first installed library sees; None where none is installed."""
    libraries = backends()
    return libraries[0].list() if libraries else None


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


class GenicamCamera(Live):
    """A machine-vision camera as a source of frames, 8 to 16 bits.

    Parameters
    ----------
    source
        `genicam:` and the camera's name; `genicam:` alone is the first one. A grey form may follow:
        `genicam:NAME,Mono12`. By default the deepest that it offers.
    rate
        Frames a second to ask for; None keeps the camera's own.
    backend
        The library; by default the first that is installed.

    Raises
    ------
    InputError
        When no library is installed, there is no such camera, or it gives no picture.
    """

    def __init__(self, source: str, rate: float | None = None, backend: Backend | None = None) -> None:
        self.name = source
        ident, _, form = source.removeprefix(PREFIX).partition(",")
        library = backend or next(iter(backends()), None)
        if library is None:
            raise InputError("no library for GenICam is installed", where=source, remedy=_INSTALL)
        self._camera = library.open(ident, form or None, rate)
        self.rate = self._camera.rate
        try:
            raw = self._taken()
        except BaseException:
            self.close()
            raise
        self.full_scale = FORMATS[raw[1]].full_scale
        self._exposure = self._camera.hardware.get("exposure")
        self._seen = decode(raw[0], raw[1], raw[2], raw[3], where=source)
        self.hardware: dict[str, Any] = {
            "camera": source,
            "library": library.name,
            **self._camera.hardware,
            "bits": FORMATS[raw[1]].bits,
            "time": "arrival of the frame",
        }

    def _taken(self) -> Raw:
        raw = self._camera.next(_PATIENCE)
        if raw is None:
            remedy = "check its cable, power and trigger mode, and for GigE the packet size and the firewall"
            raise InputError(f"gave no frame for {_PATIENCE:g} s", where=self.name, remedy=remedy)
        return raw

    def _arrivals(self, utc_ahead: int) -> Iterator[Arrival]:
        while True:
            data, form, width, height, number, utc = self._taken()
            # Numbers of GigE Vision have 16 bits and leave 0 out: one that starts again counts as none lost.
            image = decode(data, form, width, height, where=self.name)
            yield Arrival(image, utc - utc_ahead, number, self._exposure)

    def close(self) -> None:
        """Stop and release the camera."""
        self._camera.close()
