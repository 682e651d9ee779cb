"""Make lightpipes.npz: the paper's double pass by LightPipes on a fixed grid, to compare with.

    .venv/bin/python tests/references/make_lightpipes.py      # some 25 s and 2.5 GB an image

Scene: r = 3 mm, f = 100 mm, 640 nm, collimated light, mirror sensor, x_d and rotation as listed, the probe f_p = 200 mm
at its lens. LightPipes' `Forvard` propagates, on 4096 x 4096 samples over 24 mm. Its pupil is binary, ours is not: the
two agree to about the ragged edge's error.
"""

from __future__ import annotations

from pathlib import Path

import LightPipes as lp
import numpy as np

WAVELENGTH, RADIUS, FOCAL, PROBE_FOCAL = 640e-9, 3e-3, 100e-3, 200e-3
SIZE, SAMPLES = 24e-3, 4096
CASES = ((0.0, 5.0), (0.5, 2.5), (1.0, 1.0))
HALF = 48  # pixels kept on either side of the middle, at LightPipes' own pitch


def retro_reflection(rotation: float, object_distance: float) -> np.ndarray:
    """Irradiance on the probe's focal plane, [2 HALF, 2 HALF], for 1 W/m² on the target."""
    z = 1 / (1 / FOCAL - 1 / object_distance)
    sine = np.sin(np.radians(rotation))
    x = (np.arange(SAMPLES) - SAMPLES // 2) * SIZE / SAMPLES
    # Tilts as phases of our own: the sign of LightPipes' Tilt is the other one.
    tilt = np.exp(1j * 2 * np.pi / WAVELENGTH * sine * x)[:, None]
    field = lp.Begin(SIZE, WAVELENGTH, SAMPLES)
    field.field = field.field * tilt
    field = lp.Lens(lp.CircAperture(field, RADIUS), FOCAL)
    # Mirror sensor: both ways in one, 2 z.
    field = lp.Forvard(field, 2 * z)
    field = lp.Lens(lp.CircAperture(field, RADIUS), FOCAL)
    # The return travels at minus the tilt; turned back, its plane is foreshortened by the cosine, which is left out.
    field.field = field.field * tilt
    # The probe's focal plane is the far field; LightPipes' own lens would need a grid of its own.
    u = np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(field.field), s=None))
    far = np.abs(u * (SIZE / SAMPLES) ** 2 / (WAVELENGTH * PROBE_FOCAL)) ** 2
    middle = SAMPLES // 2
    return far[middle - HALF : middle + HALF, middle - HALF : middle + HALF]


def main() -> None:
    """Compute all cases and store them beside this script."""
    images = np.stack([retro_reflection(*case) for case in CASES])
    np.savez_compressed(
        Path(__file__).parent / "lightpipes.npz",
        images=images.astype(np.float32),
        cases=np.array(CASES),
        # An FFT's own sampling of the probe's focal plane, in metres.
        pitch=WAVELENGTH * PROBE_FOCAL / SIZE,
        samples=SAMPLES,
        lightpipes=lp.__version__ if hasattr(lp, "__version__") else lp.LPversion,
    )


if __name__ == "__main__":
    main()
