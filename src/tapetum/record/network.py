"""Cameras of a network as sources of frames: RTSP and video over HTTP, by FFmpeg."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import av
from av.error import FFmpegError

from tapetum.errors import InputError
from tapetum.record.source import Arrival, Live

__all__ = ["NetworkCamera", "is_network"]

SCHEMES = ("rtsp", "rtsps", "http", "https")
_SECONDS = 10.0  # without a packet after which the camera is lost
# What an address may lead to; play lists, which name files and further hosts, are not among the containers.
_PROTOCOLS = {
    "rtsp": "rtsp,rtp,rtcp,udp,tcp,tls",
    "rtsps": "rtsp,rtp,rtcp,tcp,tls",
    "http": "http,tcp",
    "https": "https,tls,tcp",
}
_CONTAINERS = "rtsp,rtp,sdp,mpjpeg,mjpeg,mpegts,matroska,webm,flv,h264,hevc,mov,mp4,asf"


def is_network(source: str) -> bool:
    """Return whether a text names a camera of a network."""
    return source.partition("://")[0].lower() in SCHEMES and "://" in source


class NetworkCamera(Live):
    """A camera that sends video over a network; colour becomes grey, 8 bit.

    Frames carry their time of arrival: the camera's own clock says nothing of this machine's, and the delay of the
    network and of the encoder is not known.

    Parameters
    ----------
    address
        `rtsp://user:password@host/path`, `rtsps://…`, `http://…` or `https://…`. Redirections to other protocols and
        play lists are not followed.
    seconds
        Without a picture after which the camera is lost.

    Raises
    ------
    InputError
        When nothing answers there, or what answers sends no video.
    """

    full_scale = 255

    def __init__(self, address: str, seconds: float = _SECONDS) -> None:
        self.name = without_password(address)
        scheme = urlsplit(address).scheme.lower()
        options = {"protocol_whitelist": _PROTOCOLS[scheme], "fflags": "nobuffer", "flags": "low_delay"}
        if scheme.startswith("rtsp"):
            # Over TCP no packets are lost on the way, which would tear pictures.
            options["rtsp_transport"] = "tcp"
        else:
            options["format_whitelist"] = _CONTAINERS
        self._container: Any = None
        try:
            self._container = av.open(address, "r", options=options, timeout=(seconds, seconds))
            if not self._container.streams.video:
                raise InputError("sends no video", where=self.name, remedy="look up the camera's address for video")
            self._stream: Any = self._container.streams.video[0]
            self._stream.thread_type = "SLICE"
            self._seen = next(self._pictures())[0]
        except StopIteration:
            self.close()
            raise InputError("sends no picture", where=self.name, remedy="is the camera on?") from None
        except InputError:
            self.close()
            raise
        except (FFmpegError, OSError, ValueError) as error:
            self.close()
            remedy = "check address, user and password, and that the camera is on"
            # FFmpeg's message may hold the address, and that a password.
            what = f"cannot be watched ({getattr(error, 'strerror', None) or type(error).__name__})"
            raise InputError(what, where=self.name, remedy=remedy) from None
        rate = self._stream.average_rate
        self.rate: float | None = float(rate) if rate and 0 < rate < 1000 else None
        self.hardware: dict[str, Any] = {
            "camera": self.name,
            "codec": self._stream.codec_context.name,
            "time": "arrival of the frame",
            "lost_frames": "only those that this program could not take are counted",
        }

    def _pictures(self) -> Iterator[tuple[Any, int]]:
        for frame in self._container.decode(self._stream):
            yield frame.to_ndarray(format="gray"), time.monotonic_ns()

    def _arrivals(self, utc_ahead: int) -> Iterator[Arrival]:
        try:
            for image, moment in self._pictures():
                yield Arrival(image, moment)
        except (FFmpegError, OSError) as error:
            what = f"gives no more pictures ({getattr(error, 'strerror', None) or type(error).__name__})"
            raise InputError(what, where=self.name, remedy="is it still there?") from None
        raise InputError("gives no more pictures", where=self.name, remedy="is it still there?")

    def close(self) -> None:
        """Close the connection."""
        if self._container is not None:
            self._container.close()
            self._container = None


def without_password(address: str) -> str:
    """Return an address as it may be shown: without user, password and query, which may hold a key."""
    shown = re.sub(r"//[^/@]*@", "//", address, count=1)
    return shown.partition("?")[0]
