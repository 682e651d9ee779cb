"""Find and follow every retro-reflection in a folder of pictures, and print a table.

.venv/bin/python examples/track_photos.py FOLDER     # PNG, TIFF, PGM, BMP or JPEG, 8 or 16 bit
.venv/bin/python examples/track_photos.py            # no folder at hand: some frames of the virtual bench
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2

import tapetum as tp


def main(arguments: Sequence[str] | None = None) -> list[tuple[str, int, float, float]]:
    """Print the table; return its file names, tracks and places."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--min-snr", type=float, default=7.0, help="least signal-to-noise ratio of a detection")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as spare:
        folder = options.folder or take_pictures(Path(spare))
        table = []
        print(f"{'picture':<24} {'track':>5} {'x / px':>8} {'y / px':>8} {'width / px':>10} {'SNR':>6}")
        for frame in tp.track(folder, detect_options={"min_snr": options.min_snr}):
            for row in frame.rows:
                if not row.seen:
                    # Between two sightings a track goes on by its own motion; there is no spot to measure.
                    continue
                print(
                    f"{row.name:<24} {row.track:>5} {row.x:>8.1f} {row.y:>8.1f} {row.diameter:>10.1f} {row.snr:>6.0f}"
                )
                table.append((row.name, row.track, row.x, row.y))
    return table


def take_pictures(folder: Path) -> Path:
    """Film half a second of the demo's scene and leave what the probe sees as PNG files."""
    recording = tp.film(tp.load_scene("hand-held"), folder / "short.rec", tp.Session(seconds=0.5, seed=4))
    pictures = folder / "pictures"
    pictures.mkdir()
    for frame in tp.open_frames(recording.path):
        cv2.imwrite(str(pictures / f"frame-{frame.index:03d}.png"), frame.image)
    return pictures


if __name__ == "__main__":
    main()
