"""Read a camera from one noisy picture of its retro-reflection, by descending the simulator's own gradient.

    .venv/bin/python examples/gradient.py

A thin lens is turned by 0.4° and focused at 2.5 m; the probe takes one frame of it. From a guess that is off in both,
gradient descent through `tp.retroreflect` finds tilt and focus again. No training, and no data: physics alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch

import tapetum as tp

# A small aperture and few pixels, so that a step takes a fraction of a second.
BENCH = (
    "target.lens.aperture_radius=2 mm",
    "probe.sensor.pixels=[96, 96]",
    "probe.sensor.exposure=200 us",
    "sampling.accuracy=0.01",
)


def main(arguments: Sequence[str] | None = None) -> tuple[float, float]:
    """Return the tilt (degrees) and the object distance (metres) that were found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tilt", type=float, default=0.4, help="true rotation about x, degrees")
    parser.add_argument("--distance", type=float, default=2.5, help="true object distance, metres")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1, help="of the frame's noise")
    options = parser.parse_args(arguments)

    scene = tp.load_scene("thin-lens", BENCH)
    truth = tp.retroreflect(scene, options.tilt, object_distance=options.distance)
    frame = torch.from_numpy(tp.expose(truth, scene.probe, seed=options.seed)).double()

    # The root of the counts, for shot noise then weighs the same in every pixel, and what the frame holds in all as
    # the unit of both, for nobody knows how well this target reflects.
    measured = (frame / frame.sum()).sqrt()
    # Rays bend by 1/x_d, so that is what to descend in; both unknowns of order one.
    tilt = torch.tensor(0.75 * options.tilt, dtype=torch.float64, requires_grad=True)
    vergence = torch.tensor(0.8 / options.distance, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([tilt, vergence], lr=0.04, betas=(0.8, 0.95))
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, options.steps, eta_min=1e-4)
    for step in range(options.steps):
        optimiser.zero_grad()
        image = tp.retroreflect(scene, tilt, object_distance=1 / vergence).irradiance[0].double()
        # The root of nothing has no slope: a floor far below a photon.
        loss = ((image / image.sum() + 1e-9).sqrt() - measured).square().sum()
        loss.backward()
        if step % 10 == 0:
            print(f"step {step:3d}: tilt {tilt.item():.3f}°, x_d {1 / vergence.item():.3f} m, loss {loss.item():.4f}")
        optimiser.step()
        decay.step()
    # A tilt and its opposite give the same picture with this bench: its sign is open.
    found = abs(tilt.item()), 1 / vergence.item()
    print(f"found:    tilt {found[0]:.3f}°, x_d {found[1]:.3f} m (the tilt up to its sign)")
    print(f"truth:    tilt {options.tilt:.3f}°, x_d {options.distance:.3f} m")
    return found


if __name__ == "__main__":
    main()
