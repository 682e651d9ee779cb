"""Decoding of strangers' pictures and films: a program of its own, run by `tapetum.live.modes.uploads`.

    python decode.py picture|film FIRST < bytes

It reads the upload from its standard input (of a pair FIRST is the length of the first picture), gives itself limits of
memory, time and files, decodes, and writes grey frames: a line of JSON {"width", "height", "time"}, then the pixels; at
the end, or in place of a frame, {"end": true} or {"fault": "..."}. It imports nothing of Tapetum, so that little code
runs in the process that reads crafted bytes.
"""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path
from typing import NoReturn

MOST_PIXELS = 2**26
FILM_PIXELS = 4096 * 2304
FILM_SECONDS = 20.0
FILM_FRAMES = 240
FILM_WIDTH = 1280
CPU_SECONDS = 30
MEMORY = 1200 << 20  # beyond what the libraries take
CONTAINERS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi"
MAGIC = ((0, b"\xff\xd8\xff"), (0, b"\x89PNG\r\n\x1a\n"), (8, b"WEBP"))

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)


def refuse(why: str) -> NoReturn:
    """Say why, and end."""
    sys.stdout.buffer.write(json.dumps({"fault": why}).encode() + b"\n")
    sys.stdout.buffer.flush()
    # Without the libraries' own farewells, which may fail once memory is short.
    os._exit(0)


def limit() -> None:
    """Give up memory, time and files beyond what decoding needs; elsewhere the parent's clock is the only limit."""
    try:
        import resource
    except ImportError:
        return
    try:
        text = Path("/proc/self/statm").read_text(encoding="ascii")
        now = int(text.split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, now + MEMORY))
    except OSError:
        pass
    for which, most in (("RLIMIT_CPU", CPU_SECONDS), ("RLIMIT_FSIZE", 0), ("RLIMIT_CORE", 0), ("RLIMIT_NOFILE", 16)):
        resource.setrlimit(getattr(resource, which), (most, most))


def write(image, time: float) -> None:
    """Write a grey frame."""
    head = {"width": image.shape[1], "height": image.shape[0], "time": time}
    sys.stdout.buffer.write(json.dumps(head).encode() + b"\n" + image.tobytes())
    sys.stdout.buffer.flush()


def picture(content: bytes) -> None:
    """Decode a JPEG, PNG or WebP."""
    import cv2
    import numpy as np

    if not any(content[at : at + len(magic)] == magic for at, magic in MAGIC):
        refuse("is no JPEG, PNG or WebP")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    if image is None:
        refuse(f"cannot be decoded, or has more than {MOST_PIXELS // 10**6} million pixels")
    elif min(image.shape) < 32:
        refuse(f"has {image.shape[1]} x {image.shape[0]} pixels, less than 32")
    else:
        write(image, 0.0)


def film(content: bytes) -> None:
    """Decode the first seconds of a film."""
    import av
    import numpy as np

    sent = 0
    with av.open(
        io.BytesIO(content), "r", options={"format_whitelist": CONTAINERS, "protocol_whitelist": ""}
    ) as opened:
        if not opened.streams.video:
            refuse("holds no pictures")
        stream = opened.streams.video[0]
        stream.thread_type = "NONE"
        begin = None
        for frame in opened.decode(stream):
            if frame.width * frame.height > FILM_PIXELS:
                refuse(f"has {frame.width} x {frame.height} pixels, more than {FILM_PIXELS}")
            if min(frame.width, frame.height) < 32:
                refuse(f"has {frame.width} x {frame.height} pixels, less than 32")
            time = float(frame.time) if frame.time is not None else sent / 25
            begin = time if begin is None else begin
            if time - begin > FILM_SECONDS or sent >= FILM_FRAMES:
                break
            width = min(FILM_WIDTH, frame.width)
            height = max(32, round(frame.height * width / frame.width))
            grey = frame.reformat(width, height, "gray").to_ndarray()
            write(np.ascontiguousarray(grey), max(0.0, time - begin))
            sent += 1
    if not sent:
        refuse("holds no picture")


def main() -> None:
    """Read, limit, decode."""
    kind, first = sys.argv[1], int(sys.argv[2])
    content = sys.stdin.buffer.read()
    # Imported before the limit of open files.
    import cv2

    cv2.setNumThreads(1)
    if kind == "film":
        import av  # noqa: F401
    limit()
    try:
        if kind == "film":
            film(content)
        else:
            picture(content[:first])
            if first < len(content):
                picture(content[first:])
    except MemoryError:
        refuse("needs more memory than it may have")
    except Exception as error:
        refuse(f"cannot be decoded ({type(error).__name__})")
    sys.stdout.buffer.write(b'{"end": true}\n')
    sys.stdout.buffer.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
