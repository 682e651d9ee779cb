"""Fisher information and Cramér-Rao bounds of one frame: the best precision of any unbiased estimate."""

# Torch types autograd.grad, linalg and tolist in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from tapetum.bench import PrescriptionLens, ProbeSensor, Scene, as_scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate.camera import Camera
from tapetum.simulate.exposure import count_moments, hot_currents, most_electrons
from tapetum.simulate.gaze import field_size, gaze_of, largest_sine, tilt_of_gaze
from tapetum.simulate.radiometry import electrons
from tapetum.simulate.traced_information import TracedSlopes, sensor_part
from tapetum.simulate.unknowns import NUISANCES, PARAMETERS, check_names, checked_parameters, not_told

__all__ = ["PARAMETERS", "FisherInformation", "checked_parameters", "expected_electrons", "fisher", "information_of"]
__all__ += ["not_told", "slopes_of", "true_values"]


@dataclass(frozen=True, eq=False)
class FisherInformation:
    """Fisher information of one frame about some parameters.

    Parameters
    ----------
    parameters
        Their names.
    values
        At which it was taken, in SI units and fractions of the field.
    information
        Fisher matrix, [P, P], in inverse products of the parameters' units.
    """

    parameters: tuple[str, ...]
    values: tuple[float, ...]
    information: torch.Tensor

    def __add__(self, other: FisherInformation) -> FisherInformation:
        """Information of two independent frames together: same parameters at the same values, from any two probes."""
        if self.parameters != other.parameters or self.values != other.values:
            raise InputError(
                f"{list(other.parameters)} at {list(other.values)} are not {list(self.parameters)} at "
                f"{list(self.values)}",
                where="parameters",
                remedy="add information of one target about the same parameters in the same order",
            )
        return replace(self, information=self.information + other.information)

    @property
    def units(self) -> dict[str, str]:
        """Of each parameter."""
        return {name: (PARAMETERS | NUISANCES)[name] for name in self.parameters}

    @property
    def bounds(self) -> dict[str, float]:
        """Cramér-Rao bound of each parameter's standard deviation while all parameters are unknown.

        It is infinite where a combination of the other parameters changes the frame in the same way, to 1 part in 10⁵.
        """
        own = self.information.diagonal().clamp_min(0).sqrt()
        deviations = torch.full_like(own, torch.inf)
        told = own > 0
        # Parameters differ by many powers of ten: scale each by its bound when all others are known.
        shared = self.information[told][:, told] / (own[told, None] * own[None, told])
        deviations[told] = 1 / (own[told] * _independent_shares(shared).sqrt())
        return dict(zip(self.parameters, deviations.tolist(), strict=True))

    @property
    def alone(self) -> dict[str, float]:
        """The bound of each parameter with all the others known."""
        diagonal = self.information.diagonal().clamp_min(0)
        return dict(zip(self.parameters, (1 / diagonal.sqrt()).tolist(), strict=True))


def fisher(
    scene: Scene | str | os.PathLike[str],
    parameters: Sequence[str] = ("gaze_x", "gaze_y", "object_distance"),
    *,
    accuracy: float | None = None,
    device: torch.device | str = "auto",
) -> FisherInformation:
    """Fisher information of one frame about the scene's own values.

    Parameters
    ----------
    scene
        A scene, its name or its path.
    parameters
        The unknown values: names of `PARAMETERS`. `place_x` and `place_y`, the RR's place on the probe's sensor, belong
        among them where the target may stand anywhere.
    accuracy
        Of the simulation, in fractions of the peak, in place of the scene's.
    device
        As for `retroreflect`.

    Raises
    ------
    InputError
        For unknown or repeated parameters, an object distance at infinity among them, parameters by which the chain is
        not differentiated (scattered light by other than gaze and power, behind a traced lens and layers there, and
        glints, by focus and focal length; distance through a traced lens, or where a diverging beam underfills the
        target or meets a mask), phones, and as `retroreflect`.

    Notes
    -----
    F_ij = Σ_pixels (∂m/∂a_i)(∂m/∂a_j)/v, m and v the mean and the variance of a pixel's digital number
    (`exposure.count_moments`). Between the ends of the digital range that is (∂μ/∂a_i)(∂μ/∂a_j)/(μ + σ²), μ the mean
    electrons and σ² the variance of readout and rounding. A saturated pixel carries no information.

    Means and variances never carry more than the whole distribution (M. Stein, A. Mezghani, J. A. Nossek, IEEE Signal
    Process. Lett. 21, 796 (2014)). Where the numbers' steps are finer than the noise, the difference is below 1 % of
    the information for pixels of 10 electrons or more; for darker ones it grows to 1, 11 and 39 % for a read noise of
    6, 2 and 1 electrons. Steps coarser than the noise also count as noise: the limits are estimates then.

    The gaze is the laser's place in the target's picture, z tan θ/(pN): that place, not the angle, is kept where focus
    or focal length are varied. Derivatives come by automatic differentiation through the whole chain, on the planned
    grids; a traced lens's by differences of pictures on the same grids (`traced_information`). Varying the focal length
    keeps a thin lens's aperture. A traced prime is scaled as a whole, so its F-number stays; a zoom's stop follows its
    states, or keeps its `f_number`; the object distance stays.
    """
    scene = as_scene(scene)
    names = checked_parameters(scene, parameters)
    gaze = torch.tensor([list(true_values(scene, ("gaze_x", "gaze_y")).values())], dtype=torch.float64)
    slopes = slopes_of(scene, names, gaze, accuracy=accuracy, device=device)
    information = information_of(*slopes(0), scene.probe.sensor)
    return FisherInformation(names, tuple(true_values(scene, names).values()), information)


def slopes_of(
    scene: Scene,
    names: Sequence[str],
    gazes: torch.Tensor,
    *,
    accuracy: float | None = None,
    dtype: torch.dtype = torch.complex128,
    device: torch.device | str = "auto",
) -> Callable[[int], tuple[torch.Tensor, torch.Tensor]]:
    """How a frame changes at any of many gazes: by automatic differentiation, or for a traced lens by differences.

    Arguments as for `TracedSlopes`, errors as of `fisher`. The function returned takes a gaze's number and gives the
    mean electrons [H, W] without hot pixels' and their slopes [P, H W]. Fields of a thin lens are complex128 whatever
    `dtype`.
    """
    if isinstance(scene.target.lens, PrescriptionLens):
        return TracedSlopes(scene, names, gazes, accuracy=accuracy, dtype=dtype, device=device)
    names = checked_parameters(scene, names)

    # Derivatives are taken here whatever the caller's mode is.
    @torch.inference_mode(False)
    @torch.enable_grad()
    def at(number: int) -> tuple[torch.Tensor, torch.Tensor]:
        gaze = gazes[number].to(torch.float64)
        start = true_values(scene, names) | dict(zip(("gaze_x", "gaze_y"), gaze.tolist(), strict=True))
        scales = {name: _FREE.get(name, abs(value) or 1.0) for name, value in start.items()}
        steps = torch.zeros(len(names), dtype=torch.float64, requires_grad=True)
        given: dict[str, torch.Tensor | float] = {**start}
        given |= {name: start[name] + step * scales[name] for name, step in zip(names, steps, strict=True)}
        window = _where_it_matters(scene, tilt_of_gaze(scene, gaze))
        mean = expected_electrons(scene, given, output=window, accuracy=accuracy, device=device)
        units = torch.tensor([[scales[name]] for name in names], dtype=torch.float64, device=mean.device)
        return mean.detach(), _jacobian(mean.flatten(), steps) / units

    return at


@torch.inference_mode(False)
@torch.enable_grad()
def information_of(mean: torch.Tensor, jacobian: torch.Tensor, sensor: ProbeSensor) -> torch.Tensor:
    """Fisher matrix [P, P] of a frame of mean electrons [H, W], without hot pixels', with slopes [P, H W]."""
    weight = _information_of_pixels(mean, sensor).flatten()
    return ((jacobian * weight[None, :]) @ jacobian.T).cpu()


def expected_electrons(
    scene: Scene,
    values: Mapping[str, torch.Tensor | float],
    *,
    output: Grid | None = None,
    accuracy: float | None = None,
    device: torch.device | str = "auto",
) -> torch.Tensor:
    """Mean electrons [H, W], float64, of one frame without those of hot pixels, for given values; differentiable.

    Parameters
    ----------
    scene
        What is simulated.
    values
        Replace the scene's, by names of `PARAMETERS`, in their units. The gaze stays where focus or focal length
        change.
    output
        Pixels in place of the probe's whole sensor.
    accuracy, device
        As for `fisher`.

    Raises
    ------
    InputError
        For an unknown name, and as `retroreflect`.
    """
    check_names(values, "values")
    given = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in values.items()}
    own = {name: torch.tensor(value, dtype=torch.float64) for name, value in true_values(scene, PARAMETERS).items()}
    at = own | given
    sensor = scene.target.sensor
    gaze = torch.stack([at["gaze_x"], at["gaze_y"]])
    if isinstance(scene.target.lens, PrescriptionLens):
        sines = tilt_of_gaze(scene, gaze)[None, :]
    else:
        axis = torch.tensor(sensor.decentre, dtype=torch.float64)
        tangents = (gaze * field_size(scene) - axis) * (1 / at["focal_length"] - 1 / at["object_distance"])
        sines = (tangents / torch.sqrt(1 + tangents.square().sum()))[None, :]
    places = torch.stack([at["place_x"], at["place_y"]])[None, :]
    camera = Camera(
        scene,
        largest_sine(sines),
        output=output,
        object_distance=given.get("object_distance"),
        focal_length=given.get("focal_length"),
        distance=given.get("distance"),
        power=given.get("power"),
        accuracy=accuracy,
        dtype=torch.complex128,
        device=device,
    )
    irradiance = camera(sines, places if places.requires_grad or bool(places.any()) else None, equivalent=True)
    return electrons(irradiance[0].to(torch.float64), scene.probe.sensor, scene.illumination.wavelength)


def true_values(scene: Scene, names: Iterable[str]) -> dict[str, float]:
    """The scene's own values of some of `PARAMETERS`."""
    target = scene.target
    tilt = torch.sin(torch.tensor(target.rotation, dtype=torch.float64))
    gaze_x, gaze_y = gaze_of(scene, tilt).tolist()
    own = {
        "gaze_x": gaze_x,
        "gaze_y": gaze_y,
        "object_distance": target.object_distance,
        "focal_length": target.lens.focal_length,
        "distance": scene.distance,
        "power": scene.illumination.power,
        "place_x": 0.0,
        "place_y": 0.0,
    }
    return {name: own[name] for name in names}


def _independent_shares(shared: torch.Tensor) -> torch.Tensor:
    """Share of each parameter's information that is independent of the others', from a matrix of unit diagonal.

    1/(F⁻¹)_ii for an invertible F, else the residual of each derivative's projection on the others'.
    """
    left = torch.ones(len(shared), dtype=shared.dtype, device=shared.device)
    for i in range(len(shared)):
        rest = [j for j in range(len(shared)) if j != i]
        values, vectors = torch.linalg.eigh(shared[rest][:, rest])
        along = (shared[i, rest] @ vectors).square()
        # Zero eigenvalues belong to combinations of the others without effect: only rounding is left of them.
        kept = values > _ROUNDING
        left[i] -= (along[kept] / values[kept]).sum()
    return torch.where(left > _ROUNDING, left, torch.zeros_like(left))


def _information_of_pixels(mean: torch.Tensor, sensor: ProbeSensor) -> torch.Tensor:
    """Information of each pixel about its own mean electrons, [H, W], in inverse electrons squared."""
    if sensor.hot_pixels:
        columns, rows = sensor.pixels
        top, left = (rows - mean.shape[-2]) // 2, (columns - mean.shape[-1]) // 2
        hot = hot_currents(sensor)[top : top + mean.shape[-2], left : left + mean.shape[-1]]
        mean = mean + (hot * sensor.exposure).to(mean)
    # It depends on the mean alone, so a table serves millions of pixels. Unclipped moments are linear.
    most = _clipped_from(sensor)
    nodes = (torch.arange(2 + int(most**0.5 / _STEP), dtype=torch.float64) * _STEP).square().requires_grad_()
    numbers, variance = count_moments(nodes, replace(sensor, hot_pixels=0.0))
    (slope,) = torch.autograd.grad(numbers.sum(), nodes)
    # In saturation the slope is only rounding: set it to zero.
    slope = torch.where(slope > 1e-9, slope, torch.zeros_like(slope))
    table = torch.stack([nodes, slope, variance]).detach().to(mean.device)
    light = mean.clamp(0, most)
    place = (light.sqrt() / _STEP).long()
    low, high = table[:, place], table[:, place + 1]
    _, slope, variance = low + (high - low) * ((light - low[0]) / (high[0] - low[0]))
    return slope.square() / variance


def _clipped_from(sensor: ProbeSensor) -> float:
    """Mean electrons beyond which every frame is saturated."""
    top = max(most_electrons(sensor), 0.0)
    return top + 20 * (top + sensor.read_noise**2) ** 0.5 + 400


def _where_it_matters(scene: Scene, sines: torch.Tensor) -> Grid | None:
    """Window of the pixels that hold a mirror's RR at a tilt [2], if not all: dark ones carry no information."""
    sensor = scene.target.sensor
    if sensor.layers or any(one is not None for one in (sensor.array, sensor.microlens, sensor.mask, sensor.diffuse)):
        return None
    window = Camera(scene, largest_sine(sines[None]), accuracy=1e-2, device="cpu").window(margin=True)
    return sensor_part(scene, 2 * window.rows, window.pitch)


# Spacing of the table of a pixel's moments, in roots of electrons: a 25th of the shot noise's standard deviation.
_STEP = 0.02
# Information below which an inverse, or a parameter's independent share, is rounding.
_ROUNDING = 1e-10
# Units of parameters whose values may be zero.
_FREE = {"gaze_x": 1.0, "gaze_y": 1.0, "place_x": 1e-6, "place_y": 1e-6}


def _jacobian(outputs: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
    """∂outputs/∂inputs, [P, N], by one backward pass more than there are inputs: outputs are many."""
    if not outputs.requires_grad:
        # Nothing returns, whatever the inputs are.
        return outputs.new_zeros(len(inputs), len(outputs))
    # Jᵀu is linear in u: its own derivative along each input is a row of J.
    u = torch.zeros_like(outputs, requires_grad=True)
    (pulled,) = torch.autograd.grad(outputs, inputs, u, create_graph=True)
    rows = [torch.autograd.grad(one, u, retain_graph=True, materialize_grads=True)[0] for one in pulled]
    return torch.stack(rows).detach()
