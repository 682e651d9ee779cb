"""The probe's sensor: shot noise, read noise, hot pixels, saturation and quantisation.

Light and dark current make electrons, up to the full well; gain and offset turn them into digital numbers. `digitise`
draws such numbers. `expected_counts` and `count_variance` return their mean and variance as smooth functions of the
light, clipping included, for fits and Fisher information.
"""

# Torch types from_numpy in part only.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import functools
import math
import os

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Probe, ProbeSensor, Scene, as_scene
from tapetum.errors import InputError, of_type
from tapetum.simulate.image import Image
from tapetum.simulate.radiometry import electrons

__all__ = ["count_moments", "count_variance", "digitise", "expected_counts", "expose", "gain_of", "hot_currents"]
__all__ += ["most_electrons", "readout_variance"]

# Separates the hot pixels' draws from other streams seeded by small numbers.
_HOT_STREAM = 0x407
# Read noise, in electrons, above which clipping at zero uses a normal distribution.
_NOISY = 8.0
# Most electrons that are drawn: twice the largest full well. Generators draw whole numbers of 32 bits on a GPU, of 64
# on a processor; greater ones would turn negative, and saturated pixels black.
_MOST_DRAWN = 2e9
# Share of the peak below zero that counts as rounding.
_ROUNDING = 1e-6


def expose(
    image: Image, probe: Probe | Scene | str | os.PathLike[str], seed: int | np.random.Generator = 0
) -> npt.NDArray[np.uint8 | np.uint16]:
    """Take frames of a simulated image.

    Parameters
    ----------
    image
        Irradiance on the probe's pixels, at the one wavelength that its metadata name.
    probe
        The probe, or a scene, or a scene's name or path.
    seed
        Of the noise; the same seed gives the same frames of images on the same kind of device, where it is drawn.

    Returns
    -------
    numpy.ndarray
        Digital numbers, [B, H, W]: uint8 up to 8 bits, uint16 above.

    Raises
    ------
    InputError
        For an image that names no wavelength, has pixels of another pitch than the probe's, or holds light that is
        negative or not finite; and as `digitise`.
    """
    of_type(image, Image, "image", "give what tapetum.retroreflect returns")
    try:
        rng = np.random.default_rng(seed)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"must be a whole number from 0, is {seed!r}", where="seed", remedy="give 0 or more"
        ) from error
    probe = probe if isinstance(probe, Probe) else as_scene(probe).probe
    return digitise(_electrons(image, probe.sensor, None).detach().clamp_min(0), probe.sensor, rng)


def digitise(mean: torch.Tensor, sensor: ProbeSensor, rng: np.random.Generator) -> npt.NDArray[np.uint8 | np.uint16]:
    """Draw digital numbers (uint8 up to 8 bits, else uint16) for mean electrons a pixel and frame, of any shape.

    `mean` excludes the electrons of hot pixels, which are added here; `rng` draws the noise, where `mean` lies, while
    the places of hot pixels belong to the sensor. Raises InputError where a sensor with hot pixels gets no whole frames
    [..., H, W].
    """
    generator = torch.Generator(mean.device).manual_seed(int(rng.integers(1 << 62)))
    light = _with_hot_pixels(mean.detach().float(), sensor)
    counts = torch.poisson(light.clamp(max=_MOST_DRAWN), generator=generator)
    if sensor.read_noise:
        counts += sensor.read_noise * torch.randn(counts.shape, generator=generator, device=counts.device)
    top = 2**sensor.bits - 1
    numbers = counts.clamp_(max=sensor.full_well).mul_(gain_of(sensor)).add_(sensor.offset)
    numbers = numbers.round_().clamp_(0, top).to(torch.uint8 if sensor.bits <= 8 else torch.uint16)
    if not numbers.is_cuda:
        return numbers.numpy()
    # Into memory that the GPU can write to directly, which is several times faster.
    return torch.empty_like(numbers, device="cpu", pin_memory=True).copy_(numbers).numpy()


def gain_of(sensor: ProbeSensor) -> float:
    """Digital numbers an electron: the sensor's own gain, or the one at which the digital range spans the full well."""
    return (2**sensor.bits - 1) / sensor.full_well if sensor.gain is None else sensor.gain


def most_electrons(sensor: ProbeSensor) -> float:
    """Electrons of a pixel at which the full well or the largest digital number clips."""
    return min(sensor.full_well, (2**sensor.bits - 1 - sensor.offset) / gain_of(sensor))


def readout_variance(sensor: ProbeSensor) -> float:
    """Variance of readout and of rounding to digital numbers, in electrons squared, a pixel."""
    return sensor.read_noise**2 + 1 / (12 * gain_of(sensor) ** 2)


def hot_currents(sensor: ProbeSensor) -> torch.Tensor:
    """Dark current of the hot pixels, in electrons a second, [H, W]; 0 for all others.

    The sensor's serial number alone decides their places and exponentially distributed currents: a larger share of hot
    pixels contains those of a smaller one.
    """
    columns, rows = sensor.pixels
    return _hot_currents(rows, columns, sensor.hot_pixels, sensor.hot_current, sensor.serial).clone()


def expected_counts(light: Image | torch.Tensor, sensor: ProbeSensor, wavelength: float | None = None) -> torch.Tensor:
    """Mean digital numbers of frames, before rounding; differentiable.

    Parameters
    ----------
    light
        An image, or irradiance in W/m² of any shape; whole frames [..., H, W] for a sensor with hot pixels.
    sensor
        Its noise, full well, gain, offset and bits.
    wavelength
        In metres; default: that of the image's metadata. For several wavelengths, sum their electrons first.

    Returns
    -------
    torch.Tensor
        Digital numbers, of the shape and type of the irradiance; see `count_moments`.

    Raises
    ------
    InputError
        When the wavelength is not known, for an image whose pixels have another pitch than the sensor's, for light that
        is negative or not finite, and as `digitise`.
    """
    return count_moments(_electrons(light, sensor, wavelength), sensor)[0]


def count_variance(light: Image | torch.Tensor, sensor: ProbeSensor, wavelength: float | None = None) -> torch.Tensor:
    """Variance of the digital numbers of frames, in their squares, rounding included; differentiable.

    Parameters, errors and shape as for `expected_counts`.
    """
    return count_moments(_electrons(light, sensor, wavelength), sensor)[1]


def count_moments(mean: torch.Tensor, sensor: ProbeSensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean (before rounding) and variance of the digital numbers that `digitise` draws for mean electrons.

    Both have the shape and type of `mean`. Electrons are Poisson distributed with normal read noise. Clipping at the
    full well or the largest number is that of a normal distribution of the same mean and variance, so it sets in
    smoothly and the gradient fades only as the information does; the range should hold some tens of electrons. Clipping
    at 0 is summed over the electron counts that can reach it (for a read noise above 8 electrons, again a normal
    distribution). Moments of clipped normal variables: N. L. Johnson, S. Kotz, N. Balakrishnan, Continuous Univariate
    Distributions 1 (1994), chapter 13.

    The variance includes 1/12 for rounding. This assumes noise of at least some digital numbers; with less, rounding
    hides or doubles the noise and shifts the mean by up to one half.
    """
    light = _with_hot_pixels(mean, sensor).to(torch.float64)
    gain = gain_of(sensor)
    low = -sensor.offset / gain
    high = most_electrons(sensor)
    # Smaller read noise counts as this: its square or inverse would not be finite.
    read_noise = sensor.read_noise if sensor.read_noise > 1e-9 else 0.0
    noise = read_noise**2
    # From 40 deviations above the range on all numbers are the largest, and only rounding would grow.
    light = light.clamp(max=max(high, 0.0) + 40 * math.sqrt(max(high, 0.0) + noise) + 1600)
    # A floor far below any noise keeps the root's gradient finite without light and read noise.
    variance = light + noise
    scale = variance.clamp_min(1e-6).sqrt()
    over, over2 = _beyond((light - high) / scale, scale)
    under, under2 = _below(light, scale, low, read_noise)
    expected = light - over + under
    spread = variance - over2 - under2 - 2 * (high - light) * over + 2 * (low - light) * under - (under - over) ** 2
    numbers = gain * expected + sensor.offset
    return numbers.to(mean.dtype), (gain**2 * spread.clamp_min(0) + 1 / 12).to(mean.dtype)


def _beyond(excess: torch.Tensor, scale: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """First two moments of max(0, X) for a normal X of mean `excess`·`scale` and standard deviation `scale`."""
    density = torch.exp(-(excess**2) / 2) / math.sqrt(2 * math.pi)
    share = torch.erfc(-excess / math.sqrt(2)) / 2
    first = scale * (excess * share + density)
    return first, scale**2 * ((excess**2 + 1) * share + excess * density)


def _below(
    light: torch.Tensor, scale: torch.Tensor, low: float, read_noise: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """First two moments of max(0, low - X): how far X falls short of the number 0."""
    if read_noise > _NOISY:
        return _beyond((low - light) / scale, scale)
    first = second = torch.zeros_like(light)
    if read_noise == 0:
        return first, second
    deviation = torch.tensor(read_noise, dtype=light.dtype, device=light.device)
    chance = torch.exp(-light)
    for count in range(max(0, math.ceil(low + 8 * read_noise))):
        part, part2 = _beyond((low - count) / deviation, deviation)
        first, second = first + chance * part, second + chance * part2
        chance = chance * light / (count + 1)
    return first, second


def _with_hot_pixels(mean: torch.Tensor, sensor: ProbeSensor) -> torch.Tensor:
    if sensor.hot_pixels == 0 or sensor.hot_current == 0:
        return mean
    columns, rows = sensor.pixels
    if tuple(mean.shape[-2:]) != (rows, columns):
        raise InputError(
            f"has shape {tuple(mean.shape)}, which is no frame of {columns} x {rows} pixels, so the hot pixels "
            "have no places in it",
            where="image",
            remedy="give whole frames, or set probe.sensor.hot_pixels to 0",
        )
    currents = _hot_currents(rows, columns, sensor.hot_pixels, sensor.hot_current, sensor.serial)
    return mean + (currents * sensor.exposure).to(mean)


@functools.lru_cache(maxsize=4)
def _hot_currents(rows: int, columns: int, share: float, current: float, serial: int) -> torch.Tensor:
    rng = np.random.default_rng([serial, _HOT_STREAM])
    chosen = torch.from_numpy(rng.random((rows, columns))) < share
    # The logarithm of a uniform number, because NumPy's exponential draw may change between versions.
    return torch.from_numpy(-np.log1p(-rng.random((rows, columns)))) * current * chosen


def _wavelength(light: Image | torch.Tensor, wavelength: float | None) -> float:
    found = light.metadata.get("wavelength") if wavelength is None and isinstance(light, Image) else wavelength
    if found is None:
        remedy = "give it in metres, or take an image whose metadata hold it"
        raise InputError("is not known", where="wavelength", remedy=remedy)
    return float(found)


def _electrons(light: Image | torch.Tensor, sensor: ProbeSensor, wavelength: float | None) -> torch.Tensor:
    """Mean electrons of an image, or of irradiance; an InputError where it is not this sensor's, or no light."""
    if isinstance(light, Image) and not math.isclose(light.pitch, sensor.pitch, rel_tol=1e-6):
        what = f"has pixels of {light.pitch * 1e6:.6g} µm, the probe's sensor of {sensor.pitch * 1e6:.6g} µm"
        raise InputError(what, where="image", remedy="simulate it with this probe")
    irradiance = light.light if isinstance(light, Image) else light
    if irradiance.numel():
        least, most = (float(one) for one in irradiance.detach().aminmax())
        if not (-_ROUNDING * most <= least and most < math.inf):
            wrong = least if math.isfinite(most) else most
            what = f"holds {wrong:.3g} W/m², and light is neither negative nor without end"
            raise InputError(what, where="image", remedy="give finite irradiances from 0")
    return electrons(irradiance, sensor, _wavelength(light, wavelength))
