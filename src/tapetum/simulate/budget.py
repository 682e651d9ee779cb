"""The link budget: the laser's power on its way to the probe's sensor, in closed forms, before any simulation.

Rays give the share of the returning beam that leaves the target's aperture; rays and diffraction give the share of that
which enters the probe's aperture. No image is computed.
"""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene, as_scene, at_wavelength
from tapetum.optics.glass import focal_length_at
from tapetum.optics.grid import lens_numbers
from tapetum.optics.sampling import DoublePassGeometry, disc_overlap
from tapetum.simulate.exposure import most_electrons, readout_variance
from tapetum.simulate.gaze import spot_places
from tapetum.simulate.plan_parts import in_si
from tapetum.simulate.radiometry import (
    beam_radius,
    dark_electrons,
    illumination_curvature,
    irradiance_at_target,
    layer_transmittance,
    line_of,
    photon_energy,
    return_radius_by_rays,
    share_in_disc,
    specular_reflectance,
)
from tapetum.simulate.reflections import glinting
from tapetum.simulate.sensor_edge import SensorEdge
from tapetum.simulate.unknowns import has_photosites

__all__ = ["LinkBudget", "Reflection", "link_budget"]


@dataclass(frozen=True)
class Reflection:
    """The return of one reflecting plane of the target.

    Parameters
    ----------
    name
        `sensor`, or `layers.0` and so on, as in the scene.
    reflectance
        Specular power reflectance; of a pixel array that of the order 0.
    transmittance
        Of the layers before the plane, there and back.
    returning
        Share of the light on the sensor, within its edges, that leaves the target's aperture again, by rays.
    return_radius
        Of the beam at the probe, by rays and diffraction, in metres.
    inside_probe
        Share of the returning light that enters the probe's aperture.
    watts
        On the probe's sensor.
    radius_on_sensor
        Of the RR on the probe's sensor, to the first dark ring, in metres.
    peak_irradiance
        On the probe's sensor, in W/m².
    """

    name: str
    reflectance: float
    transmittance: float
    returning: float
    return_radius: float
    inside_probe: float
    watts: float
    radius_on_sensor: float
    peak_irradiance: float


@dataclass(frozen=True)
class LinkBudget:
    """Powers from the laser to the probe's sensor, and electrons a frame. SI units, for the target's sensor.

    Parameters
    ----------
    mode, wavelength, distance
        Of the illumination, and from probe to target.
    laser_watts
        Leave the probe.
    beam_radius, field_angle
        Of the lit disc at the target, in metres, and its full angle as seen from the probe, in radians.
    rayleigh_range
        π w²/λ of a collimated beam, in metres: well below it the beam keeps its size. None for other modes.
    irradiance_at_target
        In W/m².
    accepted_watts, reflected_watts, leaving_watts, probe_watts, sensor_watts
        Powers that enter the target's aperture, are reflected by its sensor (layers included), leave the target, enter
        the probe, and arrive on its sensor.
    reflections
        The target's sensor first, then each of its layers alone.
    transmission
        Of the probe.
    photons, electrons
        A frame, of the RR of the target's sensor.
    rr_pixels, peak_electrons
        Pixels that the RR covers to its first dark ring, and mean electrons of the brightest one: an estimate in closed
        form (see `link_budget`), within some percent of the picture's in focus, up to a factor of 1.6 elsewhere
        (tests).
    dark_electrons
        A pixel and frame: background and dark current.
    noise_electrons
        Standard deviation of the summed RR: shot noise, and the dark, read and rounding noise of its pixels.
    snr
        Electrons over noise electrons, of one frame.
    saturation
        Brightest pixel's mean electrons, dark ones included, over the most that the sensor can distinguish.
    notes
        What the budget leaves out of this scene.
    """

    mode: str
    wavelength: float
    distance: float
    laser_watts: float
    beam_radius: float
    field_angle: float
    rayleigh_range: float | None
    irradiance_at_target: float
    accepted_watts: float
    reflected_watts: float
    leaving_watts: float
    probe_watts: float
    sensor_watts: float
    reflections: tuple[Reflection, ...]
    transmission: float
    photons: float
    electrons: float
    rr_pixels: float
    peak_electrons: float
    dark_electrons: float
    noise_electrons: float
    snr: float
    saturation: float
    notes: tuple[str, ...]

    @property
    def field_of_view(self) -> float:
        """Diameter of the lit disc at the target, in metres."""
        return 2 * self.beam_radius

    @property
    def total_watts(self) -> float:
        """On the probe's sensor, of all reflections, added as power."""
        return sum(one.watts for one in self.reflections)

    def as_dict(self) -> dict[str, Any]:
        """All numbers by name, as plain values in SI units."""
        content = {**asdict(self), "field_of_view": self.field_of_view, "total_watts": self.total_watts}
        return {**content, "reflections": [asdict(one) for one in self.reflections], "notes": list(self.notes)}

    def lines(self) -> list[str]:
        """The budget as text, one line a step."""
        sensor, *layers = self.reflections
        reach = "" if self.rayleigh_range is None else f", Rayleigh range {in_si(self.rayleigh_range, 'm')}"
        rows = [
            ("laser", f"{in_si(self.laser_watts, 'W')} at {self.wavelength * 1e9:g} nm, {self.mode}{reach}"),
            (
                "lit at the target",
                f"{in_si(self.field_of_view, 'm')} wide, {math.degrees(self.field_angle):.4g} deg, "
                f"{in_si(self.distance, 'm')} away",
            ),
            ("irradiance there", f"{self.irradiance_at_target:.4g} W/m²"),
            ("into the aperture", in_si(self.accepted_watts, "W")),
            (
                "reflected",
                f"{in_si(self.reflected_watts, 'W')} (reflectance {sensor.reflectance:.4g}, "
                f"layers there and back {sensor.transmittance:.4g})",
            ),
            ("leaves the target", f"{in_si(self.leaving_watts, 'W')} (share {sensor.returning:.4g})"),
            (
                "enters the probe",
                f"{in_si(self.probe_watts, 'W')} (share {sensor.inside_probe:.4g} of a beam "
                f"{in_si(2 * sensor.return_radius, 'm')} wide)",
            ),
            ("on its sensor", f"{in_si(self.sensor_watts, 'W')} (transmission {self.transmission:.4g})"),
            ("a frame", f"{self.photons:.4g} photons, {self.electrons:.4g} electrons"),
            (
                "RR",
                f"{self.rr_pixels:.4g} pixels, some {self.peak_electrons:.4g} electrons in the brightest "
                "(estimated in closed form, not from a picture)",
            ),
            ("without it", f"{self.dark_electrons:.4g} electrons a pixel"),
            ("SNR of the RR", f"{self.snr:.4g} a frame, noise {self.noise_electrons:.4g} electrons"),
            ("saturation", f"{self.saturation:.4g} of the sensor's range" + (", clipped" * (self.saturation > 1))),
        ]
        rows += [(one.name, f"{in_si(one.watts, 'W')} on the probe's sensor besides") for one in layers]
        rows += [("note", note) for note in self.notes]
        return [f"{name:<18}{text}" for name, text in rows]


def link_budget(scene: Scene | str | os.PathLike[str], wavelength: float | None = None) -> LinkBudget:
    """Follow the light of one wavelength through a scene, at the scene's rotation.

    Parameters
    ----------
    scene
        A scene, its name or its path.
    wavelength
        One of the illumination's lines, in metres; default: the first.

    Raises
    ------
    InputError
        For a wavelength that the scene does not have, or at which a lens's glass has no index.

    Notes
    -----
    A beam that overfills the probe loses what `radiometry.share_in_disc` says of a round beam of the area that leaves.
    The brightest pixel gets the power over the sum of these areas: of diffraction, (λ f_p)²/A for an exit pupil of area
    A, of a quarter of the geometric disc (on the axis a defocused round pupil reaches four times its disc's mean: Born
    and Wolf, section 8.8), of the source, and of the pixel.

    A traced lens counts as a thin one of its focal length and aperture, a phone as the camera whose field holds the
    gaze; the notes say so.
    """
    scene = as_scene(scene)
    notes: list[str] = []
    if isinstance(scene.target, PhoneTarget):
        phone = scene.target
        count = len(phone.phone.cameras)
        if count > 1:
            notes.append(f"the camera {phone.unit.name!r} alone is counted, of {count}")
        if not phone.imaging:
            notes.append("its sensor returns nothing while its app is closed")
        scene = replace(scene, target=next(target for target, place in phone.cameras() if place == (0.0, 0.0)))
    if isinstance(scene.target.lens, PrescriptionLens):
        notes.append(
            f"{scene.target.lens.name} is counted as a thin lens of its focal length and aperture: "
            "its aberrations and what its rims cut off are left out"
        )
    light, target, probe = scene.illumination, scene.target, scene.probe
    wavelength, watts = line_of(scene, wavelength)
    f = focal_length_at(target.lens.focal_length, target.lens.glass, target.lens.design_wavelength, wavelength)
    # The sensor is in focus at the design wavelength.
    z, _ = lens_numbers(target.lens.focal_length, target.object_distance)
    lit = beam_radius(scene)
    irradiance = irradiance_at_target(scene) * watts / light.power
    sine = math.hypot(*(math.sin(angle) for angle in target.rotation))
    # The tilted aperture takes less of the beam, but all of a beam narrower than itself.
    cosine = math.sqrt(1 - sine**2)
    accepted = min(irradiance * math.pi * target.lens.aperture_radius**2 * cosine, watts)

    tilt = torch.sin(torch.tensor([target.rotation], dtype=torch.float64))
    place = spot_places(scene, torch.tensor(z, dtype=torch.float64), tilt)

    def reflection(name: str, depth: float, reflectance: float, transmittance: float) -> Reflection:
        geometry = DoublePassGeometry(
            wavelength,
            target.lens.aperture_radius,
            f,
            z - depth,
            probe.lens.focal_length,
            0.0,
            sine,
            illumination_curvature(scene),
        )
        held = 1.0
        if name == "sensor":
            # Nothing returns from beside the sensor's edge.
            spot = geometry.spot_radius + geometry.airy_step
            held = float(SensorEdge.of(target.sensor).share(place, spot))
        return _returned(name, scene, geometry, accepted, reflectance, transmittance, held)

    before = [layer_transmittance(layer, wavelength) ** 2 for layer in target.sensor.layers]
    depths = [layer.depth for layer in target.sensor.layers]
    reflections = [reflection("sensor", 0.0, specular_reflectance(target.sensor, wavelength), math.prod(before))]
    for i, layer in enumerate(target.sensor.layers):
        above = math.prod(t for t, depth in zip(before, depths, strict=True) if depth > layer.depth)
        share = at_wavelength(layer.reflectance, wavelength)
        reflections.append(reflection(f"layers.{i}", layer.depth / layer.index, share, above))

    one, sensor = reflections[0], probe.sensor
    if float(SensorEdge.of(target.sensor).depths(place).min()) < 0:
        notes.append("the spot lies beside the target's sensor")
    reflected = accepted * one.reflectance * one.transmittance
    photons = one.watts * sensor.exposure / photon_energy(wavelength)
    electrons = photons * sensor.quantum_efficiency
    pixels = max(math.pi * one.radius_on_sensor**2 / sensor.pitch**2, 1.0)
    # Adding the pixel's area keeps a spot smaller than it from giving more electrons than there are.
    spot = one.watts / one.peak_irradiance if one.watts > 0 else math.inf
    peak = electrons * sensor.pitch**2 / (spot + sensor.pitch**2)
    dark = dark_electrons(sensor)
    noise = math.sqrt(electrons + pixels * (dark + readout_variance(sensor)))
    most = most_electrons(sensor)
    return LinkBudget(
        mode=light.mode,
        wavelength=wavelength,
        distance=scene.distance,
        laser_watts=watts,
        beam_radius=lit,
        field_angle=2 * math.atan(lit / scene.distance),
        rayleigh_range=math.pi * lit**2 / wavelength if not light.wave.spherical else None,
        irradiance_at_target=irradiance,
        accepted_watts=accepted,
        reflected_watts=reflected,
        leaving_watts=reflected * one.returning,
        probe_watts=reflected * one.returning * one.inside_probe,
        sensor_watts=one.watts,
        reflections=tuple(reflections),
        transmission=probe.transmission,
        photons=photons,
        electrons=electrons,
        rr_pixels=pixels,
        peak_electrons=peak,
        dark_electrons=dark,
        noise_electrons=noise,
        snr=electrons / noise,
        saturation=(peak + dark) / most if most > 0 else math.inf,
        notes=(*notes, *_notes(scene, lit, wavelength, one.radius_on_sensor)),
    )


def _returned(
    name: str,
    scene: Scene,
    g: DoublePassGeometry,
    accepted: float,
    reflectance: float,
    transmittance: float,
    held: float,
) -> Reflection:
    probe, distance = scene.probe, scene.distance
    share, aperture = g.returning * held, probe.lens.aperture_radius
    rays = return_radius_by_rays(g.radius, g.focal_length, g.image_distance, g.curvature, distance)
    # A disc of the same area. Light focused into the target's own lens has the width of its diffraction there.
    lit = disc_overlap(g.radius, g.return_radius, 2 * g.image_distance * g.tangent)
    out = max(g.radius * math.sqrt(lit), min(g.radius, g.wavelength * g.image_distance / g.radius)) if share else 0.0
    leaving = math.pi * out**2
    rays_out = rays * out / max(min(g.radius, g.return_radius), out)
    inside = share_in_disc(aperture, out, rays_out, g.wavelength, distance) if out else 0.0
    airy = 1.22 * g.wavelength / (2 * out) if out else 0.0
    watts = accepted * reflectance * transmittance * share * inside * probe.transmission
    blur = scene.illumination.source_size / 2
    diffracted = (g.wavelength * g.probe_focal_length) ** 2 / leaving if leaving > 0 else math.inf
    area = diffracted + math.pi * g.probe_focal_length**2 * (g.exit_angle**2 / 4 + blur**2)
    return Reflection(
        name=name,
        reflectance=reflectance,
        transmittance=transmittance,
        returning=share,
        return_radius=rays + airy * distance,
        inside_probe=inside,
        watts=watts,
        radius_on_sensor=g.probe_focal_length * (g.exit_angle + blur + airy),
        peak_irradiance=watts / area,
    )


def _notes(scene: Scene, lit: float, wavelength: float, radius: float) -> tuple[str, ...]:
    light, sensor, probe = scene.illumination, scene.target.sensor, scene.probe.sensor
    diffuse = any(plane.diffuse is not None for plane in (sensor, *sensor.layers))
    thinned = not light.wave.spherical and scene.distance > math.pi * lit**2 / wavelength
    larger = radius > min(probe.pixels) * probe.pitch / 2
    notes = (
        (light.second_beam is not None, "the second beam is not counted"),
        (bool(light.lines), f"one wavelength of {1 + len(light.lines)} is counted"),
        (sensor.mask is not None, "the sensor's mask is not counted: a mirror stands in for it"),
        (has_photosites(scene), "the higher orders of the sensor's array and microlenses are not counted"),
        (diffuse, "the diffuse return is not counted"),
        (glinting(scene, wavelength) > 0, "the glints of the lens's surfaces are not counted"),
        (lit < scene.target.lens.aperture_radius, "the beam is narrower than the target's aperture"),
        (thinned, "the target stands beyond the Rayleigh range: the beam is wider there than counted"),
        (larger, "the RR is larger than the probe's sensor: all of its light is counted"),
        (probe.hot_pixels > 0 and probe.hot_current > 0, "hot pixels are not counted"),
    )
    return tuple(note for holds, note in notes if holds)
