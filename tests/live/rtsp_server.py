"""A camera that speaks RTSP, for tests: H.264 by RTP within the connection (RFC 2326, RFC 6184), with a password.

It sends what a room camera sends, made by libx264, and may be switched off and on again at the same port.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterable, Sequence
from fractions import Fraction

import av
import numpy as np

__all__ = ["RtspCamera", "encoded"]

_CLOCK = 90_000  # Hz, of RTP's time stamps for video
_TYPE = 96


def encoded(images: Iterable[np.ndarray], rate: int) -> list[list[bytes]]:
    """Return the NAL units of each frame; the first is a key frame with its parameter sets."""
    context = av.CodecContext.create("libx264", "w")
    frames = [av.VideoFrame.from_ndarray(one, format="gray").reformat(format="yuv420p") for one in images]
    context.width, context.height, context.pix_fmt = frames[0].width, frames[0].height, "yuv420p"  # pyright: ignore[reportAttributeAccessIssue]
    context.time_base = Fraction(1, rate)
    context.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "18", "x264-params": "keyint=20:slices=4"}
    packets = []
    for number, frame in enumerate(frames):
        frame.pts = number
        packets += context.encode(frame)  # pyright: ignore[reportAttributeAccessIssue]
    packets += context.encode(None)  # pyright: ignore[reportAttributeAccessIssue]
    return [_units(bytes(packet)) for packet in packets]


def _units(stream: bytes) -> list[bytes]:
    """Return the NAL units of a byte stream (Annex B)."""
    return [one.rstrip(b"\0") for one in stream.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]]


class RtspCamera:
    """A camera at a port of this machine.

    Parameters
    ----------
    frames
        NAL units of each frame, sent over and over.
    rate
        Frames a second.
    login
        "user:password" that it demands.

    Attributes
    ----------
    port, asked, refused
        Its port; the methods it was asked for; how many requests lacked the password.
    """

    def __init__(self, frames: Sequence[list[bytes]], rate: int = 20, login: str = "user:secret") -> None:
        self._frames, self._rate = frames, rate
        self._login = "Basic " + base64.b64encode(login.encode()).decode()
        self.port, self.asked, self.refused = 0, [], 0
        self._open: list[socket.socket] = []
        self.on()

    def on(self) -> None:
        """Listen, at the same port as before."""
        self._server = socket.create_server(("127.0.0.1", self.port))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._server,), daemon=True).start()

    def off(self) -> None:
        """Be gone: connections end, and nobody answers."""
        for one in [self._server, *self._open]:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._open = []

    def _accept(self, server: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = server.accept()
                self._open.append(client)
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError), client, client.makefile("rb") as lines:
            while request := lines.readline().decode():
                method = request.split()[0]
                headers: dict[str, str] = {}
                while line := lines.readline().decode().strip():
                    key, _, value = line.partition(": ")
                    headers[key] = value
                self.asked.append(method)
                answer, more, body = "200 OK", [], ""
                if method == "OPTIONS":
                    more = ["Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN"]
                elif headers.get("Authorization") != self._login:
                    self.refused += 1
                    answer, more = "401 Unauthorized", ['WWW-Authenticate: Basic realm="camera"']
                elif method == "DESCRIBE":
                    body = self._description()
                    more = ["Content-Type: application/sdp", f"Content-Length: {len(body)}"]
                elif method == "SETUP":
                    more = ["Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 7"]
                head = [f"RTSP/1.0 {answer}", f"CSeq: {headers.get('CSeq', '0')}", *more]
                client.sendall(("\r\n".join(head) + "\r\n\r\n" + body).encode())
                if method == "PLAY" and answer.startswith("200"):
                    self._play(client)

    def _description(self) -> str:
        sets = [one for one in self._frames[0] if one[0] & 31 in (7, 8)]
        said = ",".join(base64.b64encode(one).decode() for one in sets)
        return "\r\n".join(
            (
                "v=0",
                "o=- 0 0 IN IP4 127.0.0.1",
                "s=room",
                "t=0 0",
                f"m=video 0 RTP/AVP {_TYPE}",
                f"a=rtpmap:{_TYPE} H264/{_CLOCK}",
                f"a=fmtp:{_TYPE} packetization-mode=1;sprop-parameter-sets={said}",
                "a=control:track1",
                "",
            )
        )

    def _play(self, client: socket.socket) -> None:
        begun, sequence = time.monotonic(), 0
        for number in itertools.count():
            time.sleep(max(0.0, begun + number / self._rate - time.monotonic()))
            units = self._frames[number % len(self._frames)]
            for unit in units:
                # A frame's last packet is marked. Within TCP a packet may be as long as 65 535 bytes.
                mark = _TYPE | (0x80 if unit is units[-1] else 0)
                stamp = number * _CLOCK // self._rate & 0xFFFFFFFF
                packet = struct.pack(">BBHII", 0x80, mark, sequence & 0xFFFF, stamp, 0x7A7E) + unit
                sequence += 1
                client.sendall(struct.pack(">cBH", b"$", 0, len(packet)) + packet)
