"""What a GPU computes against the CPU: every kind of lens, of way and of light. Skipped where there is no GPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import tapetum as tp
from tapetum.simulate import fisher
from tapetum.simulate.exposure import digitise

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")

PIXELS = "probe.sensor.pixels=[160, 160]"
GAZES = torch.tensor([[0.3, 0.2], [-0.2, 0.4]], dtype=torch.float64)
CASES = {
    "thin lens": ("thin-lens", []),
    "thin lens, through the aperture": ("thin-lens", ["sampling.propagation=finite"]),
    "traced lens": ("rotation", []),
    "traced zoom": ("focusing", []),
    "hand-held": ("hand-held", []),
    "phone, filters, scatter and glints": ("phones", []),
}


@pytest.mark.parametrize("case", CASES)
def test_a_gpu_returns_what_the_cpu_returns(case):
    name, changes = CASES[case]
    scene = tp.load_scene(name, [PIXELS, *changes])
    one, other = (tp.retroreflect(scene, GAZES, device=device).irradiance for device in ("cuda", "cpu"))
    assert one.device.type == "cuda"
    assert (one.cpu() - other).abs().max() < 1e-4 * other.max()


def test_gradients_flow_on_a_gpu():
    scene = tp.load_scene("thin-lens", [PIXELS])
    slopes = []
    for device in ("cuda", "cpu"):
        rotation = GAZES[:1].clone().requires_grad_()
        image = tp.retroreflect(scene, rotation, device=device).irradiance
        weighed = (image * torch.linspace(0, 1, image.shape[-1], device=image.device)).sum() / image.detach().sum()
        slopes += torch.autograd.grad(weighed, rotation)
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-3)


@pytest.mark.parametrize("name", ["thin-lens", "rotation"])
def test_the_limit_is_the_same_on_a_gpu(name):
    scene = tp.load_scene(name, [PIXELS, "target.rotation=0.3 deg"])
    one, other = (fisher(scene, ("gaze_x", "gaze_y", "object_distance"), device=device) for device in ("cuda", "cpu"))
    assert one.bounds == pytest.approx(other.bounds, rel=1e-2)


def test_a_gaze_looks_the_same_in_any_batch():
    camera = tp.Camera(tp.load_scene("rotation", [PIXELS]), 0.01, device="cuda")
    tilts = 0.014 * (torch.rand(70, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5)
    together, alone = camera(tilts), torch.cat([camera(one) for one in tilts[::23].split(1)])
    assert (together[::23] - alone).abs().max() < 1e-5 * alone.max()


def test_a_gpu_draws_the_same_noise():
    """Other numbers than the CPU's, of the same mean and variance; hot pixels are where they belong."""
    sensor = replace(
        tp.load_scene("rotation").probe.sensor, pixels=(200, 100), bits=12, hot_pixels=0.01, hot_current=1e6
    )
    mean = torch.linspace(5, 900, 200).expand(400, 100, 200)
    here, there = (digitise(mean.to(device), sensor, np.random.default_rng(1)) for device in ("cpu", "cuda"))
    assert there.dtype == here.dtype == np.uint16
    assert there.shape == here.shape
    for of in (np.mean, np.var):
        one, other = of(there.astype(float), axis=0), of(here.astype(float), axis=0)
        assert one.mean() == pytest.approx(other.mean(), rel=2e-3)
        assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.98
    assert (there != here).mean() > 0.5
    assert (digitise(mean.to("cuda"), sensor, np.random.default_rng(1)) == there).all()
