"""Which planes of the target reflect, how strongly, and which of them interfere."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Diffuse, PrescriptionLens, Scene, at_wavelength
from tapetum.simulate.light import degree_of_coherence, reach_of_interference
from tapetum.simulate.radiometry import layer_transmittance
from tapetum.simulate.round_pass import Order, Surface
from tapetum.simulate.sensor_plane import orders_of

__all__ = [
    "Scatterer",
    "glinting",
    "longest_path",
    "mirrors",
    "only_sensor",
    "reaching_sensor",
    "scatterers",
    "specular_groups",
]


# Share of a plane's power that is neglected.
_DARK = 1e-6


@dataclass(frozen=True)
class Scatterer:
    """A scattering plane: its reduced distance from the lens in metres, the power on both ways, and how it scatters."""

    image_distance: float
    transmittance: float
    diffuse: Diffuse


@dataclass(frozen=True)
class _Plane:
    """A reflecting plane: reduced image distance, one-way optical path to the sensor, power reaching it and back."""

    image_distance: torch.Tensor
    nearer: float
    transmittance: float
    orders: tuple[Order, ...]
    diffuse: Diffuse | None
    depth: float = 0.0
    index: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)


def specular_groups(
    scene: Scene, wavelength: float, image_distance: torch.Tensor, widest: float
) -> list[tuple[Surface, ...]]:
    """Sets of reflecting planes: within a set fields add, between sets irradiances.

    `image_distance` is the sensor's, in metres; `widest` is the largest direction sine of an order that can return
    through the lens. A plane at the depth t, index n, acts as if it lay t/n before the sensor, on a path shorter by
    2nt.

    Partially coherent light gives I = Σ_ij γ_ij U_i U_j* with the degree of coherence γ_ij of the two paths. The
    Cholesky factor, γ = L Lᵀ, turns that into Σ_k |Σ_i L_ik U_i|²: one set for each column k, its planes weighted by
    L_ik. A plane may be in several sets. Fully coherent light has one set; planes that interfere with no other have
    their own.
    """
    planes = sorted(_planes(scene, wavelength, image_distance, widest), key=lambda plane: plane.nearer)
    planes = [plane for plane in planes if plane.orders]
    parts = _chains([plane.nearer for plane in planes], reach_of_interference(scene.illumination, wavelength))
    chains = [planes[part] for part in parts]
    k = 2 * math.pi / wavelength
    return [
        tuple(
            Surface(
                plane.image_distance,
                tuple(order.scaled(share * math.sqrt(plane.transmittance)) for order in plane.orders),
                -2 * k * plane.nearer,
                plane.depth,
                plane.index,
                plane.tilt,
            )
            for plane, share in zip(chain, column, strict=True)
            if share != 0
        )
        for chain in chains
        for column in _coherent_sets(chain, scene)
    ]


def longest_path(scene: Scene) -> float:
    """The largest difference of paths between planes that are summed as fields, in metres."""
    nearer = [0.0, *sorted(layer.index * layer.depth for layer in scene.target.sensor.layers)]
    light = scene.illumination
    lines = (light.wavelength, *(line.wavelength for line in light.lines))
    reach = max(reach_of_interference(light, wavelength) for wavelength in lines)
    return max(2 * (nearer[part][-1] - nearer[part][0]) for part in _chains(nearer, reach))


def _chains(nearer: Sequence[float], reach: float) -> list[slice]:
    """Runs of planes, by ascending path, in which neighbours lie within the reach of interference.

    The ends of a run may be farther apart: their degree of coherence, or the sum over the line's wavelengths, then
    removes their interference.
    """
    apart = {i for i in range(1, len(nearer)) if 2 * (nearer[i] - nearer[i - 1]) >= reach}
    return [slice(first, end) for first, end in itertools.pairwise(sorted({0, *apart, len(nearer)}))]


def _coherent_sets(chain: list[_Plane], scene: Scene) -> list[list[float]]:
    """Columns of the Cholesky factor of the planes' mutual coherence; shares below 1e-6 are left out."""
    paths = [2 * plane.nearer for plane in chain]
    gamma = [[degree_of_coherence(scene.illumination, one - other) for other in paths] for one in paths]
    rest: npt.NDArray[np.float64] = np.array(gamma)
    columns: list[list[float]] = []
    for k in range(len(paths)):
        if rest[k, k] > _DARK:
            column = rest[:, k] / math.sqrt(rest[k, k])
            rest = rest - np.outer(column, column)
            columns.append([float(share) if abs(share) > _DARK else 0.0 for share in column])
    return columns


def scatterers(scene: Scene, wavelength: float, image_distance: float) -> list[Scatterer]:
    """The planes that scatter light back."""
    at = torch.tensor(image_distance, dtype=torch.float64)
    return [
        Scatterer(float(plane.image_distance), plane.transmittance, plane.diffuse)
        for plane in _planes(scene, wavelength, at, 0.0)
        if plane.diffuse is not None and plane.diffuse.albedo > 0
    ]


def mirrors(scene: Scene, wavelength: float, image_distance: float) -> list[tuple[float, tuple[float, float]]]:
    """Mirroring planes' reduced distances from the lens, in metres, and tilts; the sensor's own where there is none."""
    sensor = scene.target.sensor
    found = [
        (image_distance - layer.depth / layer.index, layer.tilt)
        for layer in sensor.layers
        if at_wavelength(layer.reflectance, wavelength) > 0
    ]
    return [(image_distance, sensor.tilt), *found] if sensor.reflectance > 0 or not found else found


def glinting(scene: Scene, wavelength: float | None = None) -> float:
    """Largest power reflectance of the lens's surfaces over the given wavelength or all of the scene's; 0 for none."""
    lens, light = scene.target.lens, scene.illumination
    if not isinstance(lens, PrescriptionLens):
        return 0.0
    asked = (light.wavelength, *(line.wavelength for line in light.lines)) if wavelength is None else (wavelength,)
    return max(at_wavelength(lens.coating, one) for one in asked)


def only_sensor(scene: Scene) -> bool:
    """Whether only the sensor's mirror returns light: no layer, no scattering, no glint."""
    sensor = scene.target.sensor
    return not sensor.layers and sensor.diffuse is None and not glinting(scene)


def reaching_sensor(scene: Scene, wavelength: float) -> float:
    """Share of the power that passes the layers to the sensor and back."""
    return math.prod(layer_transmittance(layer, wavelength) ** 2 for layer in scene.target.sensor.layers)


def _planes(scene: Scene, wavelength: float, image_distance: torch.Tensor, widest: float) -> list[_Plane]:
    sensor = scene.target.sensor
    through, planes = 1.0, list[_Plane]()
    # From the lens inwards: each layer attenuates the light behind it twice.
    for layer in sorted(sensor.layers, key=lambda layer: -layer.depth):
        reflectance = at_wavelength(layer.reflectance, wavelength)
        orders = (_turned(Order(amplitude=math.sqrt(reflectance)), layer.tilt),) if reflectance > 0 else ()
        reached = image_distance - layer.depth / layer.index
        nearer = layer.index * layer.depth
        planes.append(_Plane(reached, nearer, through, orders, layer.diffuse, layer.depth, layer.index, layer.tilt))
        through *= layer_transmittance(layer, wavelength) ** 2
    orders: tuple[Order, ...] = ()
    if sensor.array is not None or sensor.microlens is not None:
        # A tilted plane turns orders into the aperture that an untilted one sends past it.
        orders = orders_of(sensor, wavelength, widest + 2 * math.hypot(*sensor.tilt))
    elif sensor.reflectance > 0 and sensor.mask is None:
        orders = (Order(amplitude=math.sqrt(sensor.reflectance)),)
    orders = tuple(_turned(order, sensor.tilt) for order in orders)
    planes.append(_Plane(image_distance, 0.0, through, orders, sensor.diffuse, tilt=sensor.tilt))
    return planes


def _turned(order: Order, tilt: tuple[float, float]) -> Order:
    """An order of a plane that lies a·u farther at the place u: its reflection gains exp(2ik a·u)."""
    if tilt == (0.0, 0.0):
        return order
    across, down = order.direction
    return replace(order, direction=(across + 2 * tilt[0], down + 2 * tilt[1]))
