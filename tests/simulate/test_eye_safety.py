"""Eye safety against published numbers, another package, and integrals and roots found another way."""

from __future__ import annotations

import math
from collections.abc import Callable

import lasercalc
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lasercalc.ael import ael_class1_cw_w
from lasercalc.sources import EmissionMode
from scipy.integrate import quad
from scipy.optimize import brentq

from tapetum.bench import Illumination, Probe, Scene, Target, ThinLens
from tapetum.errors import InputError
from tapetum.simulate.eye_limits import PUPIL, ael, c3, c4, c6, c7, mpe, t2
from tapetum.simulate.eye_safety import NOT_A_CERTIFICATE, Beam, beam_of, eye_safety, irradiance_at

Validated = Callable[..., None]
SECTION = "Eye safety"
EXPOSURES = (0.25, 10.0, 100.0, 3e4)
ORDER = ("1", "1M", "2", "2M", "3R", "3B", "4")


# Published examples. Each states its inputs and its result; the tolerance is that of its rounding.


def test_published_mpe(validated: Validated) -> None:
    """Argon laser, 488 nm, 0.25 s: 2.55 mW/cm² ("Appendix X - Sample Calculations", Faculty of Science, 2 September
    2015, after AS/NZS 2211.1:2004). 651 nm, 0.25 s: 6.36e-4 J/cm² (Rawls, RadSafe list, 23 June 2000, after ANSI
    Z136.1). Helium-neon laser, 633 nm, long exposure: 1 mW/cm² (handbook after BS EN 60825-1:2014, its page 104)."""
    for nm, seconds, published, rounding in (
        (488, 0.25, 25.5, 5e-3),
        (651, 0.25, 6.36 / 0.25, 3e-3),
        (633, 100, 10, 1e-12),
    ):
        what = f"MPE, {nm} nm, {seconds:g} s"
        error = abs(mpe(nm * 1e-9, seconds) / published - 1)
        validated(SECTION, what, error, rounding, "published example", measure="relative")


def test_published_nohd(validated: Validated) -> None:
    """1 W and 5 W, visible, 1 mrad, 0.25 s: 225 m and 500 m (laserpointersafety.com, safety calculations and class 4
    tables, exit width neglected)."""
    for watts, published in ((1.0, 225.0), (5.0, 500.0)):
        nohd = eye_safety(Beam(532e-9, watts, 0.0, 1e-3)).nohd
        what = f"NOHD, {watts:g} W, 1 mrad, visible, 0.25 s"
        validated(SECTION, what, abs(nohd / published - 1), 0.01, "published example", measure="relative")


def test_published_irradiance() -> None:
    """2 mW from a 5 mm exit, over a 7 mm pupil: 5.19e-3 W/cm² (Rawls, as above), twice the limit."""
    found = eye_safety(Beam(651e-9, 2e-3, 5e-3))
    assert found.nearest.irradiance == pytest.approx(51.9, rel=2e-3)
    assert not found.nearest.safe


def test_published_class_limits() -> None:
    """Round numbers that introductions to the standard give: 0.39 and (blue, Class 1) 0.039, 1, 5 and 500 mW."""
    assert ael("1", 640e-9) == pytest.approx(0.39e-3)
    assert ael("1", 405e-9) == pytest.approx(0.039e-3)
    assert [ael(name, 640e-9) for name in ("2", "3R", "3B")] == pytest.approx([1e-3, 5e-3, 0.5])


def test_published_factors() -> None:
    """Values of ICNIRP's expressions (Health Phys. 105:271, 2013; the factors below 1200 nm also in the Norwegian
    regulation on limit values, annex 4, table 4.5), worked by hand."""
    assert c3(500e-9) == pytest.approx(10)
    assert [c4(nm * 1e-9) for nm in (640, 700, 850, 1050, 1300)] == pytest.approx([1, 1, 10**0.3, 5, 5], rel=3e-3)
    assert [c7(nm * 1e-9) for nm in (1100, 1175, 1200, 1250, 1300)] == pytest.approx([1, 10**0.45, 8.01, 9, 108])
    assert [c6(a) for a in (0, 1.5e-3, 15e-3, 0.1, 1)] == pytest.approx([1, 1, 10, 100 / 1.5, 100 / 1.5])
    assert [t2(a) for a in (0, 1.5e-3, 50.75e-3, 0.1, 1)] == pytest.approx([10, 10, 10**1.5, 100, 100])


@pytest.mark.parametrize(
    ("nm", "seconds", "mrad", "want"),
    [
        (640, 100, 15, 18 * 10 * (10 * 10 ** (13.5 / 98.5)) ** -0.25),  # beyond T2
        (640, 10, 15, 18 * 10 * 10**-0.25),  # before T2
        (850, 100, 0, 10 * 10**0.3),
        (1064, 100, 0, 50),
        (1175, 3e4, 0, 50 * 10**0.45),
        (1300, 100, 0, 2500),  # the skin's 10 kW/m² over 3.5 mm, a quarter over 7 mm; the retina alone would take 5400
        (405, 50, 0, 2),  # 100 J/m²
        (405, 3e4, 0, 1),
        (470, 10, 0, 10),  # heat before blue light ...
        (470, 100, 0, 10**0.4),  # ... and after
        (405, 5, 15, 20),  # blue light from 1 s on for extended sources
        (530, 100, 50, 10**1.6),
    ],
)
def test_mpe_by_hand(nm: float, seconds: float, mrad: float, want: float) -> None:
    assert mpe(nm * 1e-9, seconds, mrad * 1e-3) == pytest.approx(want, rel=1e-12)


# The package lasercalc.


def _theirs(nm: float, seconds: float, mrad: float) -> float:
    return lasercalc.mpe_eye(nm, seconds, max(mrad, 1.5)).irradiance_w_m2


def test_mpe_as_lasercalc_where_it_follows_the_edition_of_2014(validated: Validated) -> None:
    worst = 0.0
    for nm in np.arange(400, 1200, 7.0):
        for seconds in EXPOSURES:
            for mrad in (0, 1.5, 5, 20, 60, 100):
                extended = mrad > 1.5
                if seconds >= t2(mrad * 1e-3) and extended:
                    continue  # it drops 18 T2^-0.25 for 10
                if nm < 600 and seconds > 100:
                    continue  # it goes on with 100 C3 J/m²
                skin = (2000 if seconds >= 10 else 1.1e4 * seconds**-0.75) * c4(nm * 1e-9) / 4
                ours = mpe(nm * 1e-9, seconds, mrad * 1e-3)
                worst = max(worst, abs(ours / min(_theirs(nm, seconds, mrad), skin) - 1))
    what = "MPE, 400 to 1193 nm, 0.25 to 30000 s, sources to 100 mrad, where both take the 2014 limits"
    validated(SECTION, what, worst, 1e-12, "lasercalc 0.1.1", measure="relative")


def test_why_lasercalc_differs_elsewhere() -> None:
    # Extended sources beyond T2: 10 C6 instead of 18 C6 T2^-0.25, too high by up to 1.76.
    for mrad in (5, 20, 60):
        angle = mrad * 1e-3
        assert _theirs(640, 100, mrad) / mpe(640e-9, 100, angle) == pytest.approx(10 / 18 * t2(angle) ** 0.25)
    # Blue light beyond 100 s: it keeps dividing 100 C3 J/m² by the time, and from 10 000 s on is low by 100.
    assert mpe(450e-9, 1000) / _theirs(450, 1000, 0) == pytest.approx(10)
    assert mpe(450e-9, 3e4) / _theirs(450, 3e4, 0) == pytest.approx(100)
    # Beyond 1200 nm: C7 stays at 8 there, as in the edition of 2007.
    assert mpe(1260e-9, 100) / _theirs(1260, 100, 0) == pytest.approx(c7(1260e-9) / 8)


def test_class_1_limit_as_lasercalc_up_to_the_tables_rounding(validated: Validated) -> None:
    worst = 0.0
    for nm in np.arange(400, 1200, 7.0):
        worst = max(worst, abs(ael("1", nm * 1e-9) / ael_class1_cw_w(nm).ael_w - 1))
    what = "Class 1 AEL, 400 to 1193 nm, 100 s, small sources (the standard's tables have two digits)"
    validated(SECTION, what, worst, 0.014, "lasercalc 0.1.1: MPE × 7 mm", measure="relative")


def test_nohd_as_lasercalc(validated: Validated) -> None:
    worst = 0.0
    for nm in (450, 532, 640, 785, 850, 1064):
        for watts in (5e-3, 0.1, 2.0):
            for divergence in (2e-4, 1e-3, 2e-2):
                for seconds in EXPOSURES[: 2 if nm < 600 else 4]:
                    theirs = lasercalc.nohd(
                        lasercalc.LaserSource(
                            nm, EmissionMode.CW, watts, beam_diameter_m=2e-3, divergence_rad=divergence
                        ),
                        seconds,
                    )
                    ours = eye_safety(Beam(nm * 1e-9, watts, 2e-3, divergence), exposure=seconds).nohd
                    worst = max(worst, abs(ours / theirs.nohd_m - 1))
    what = "NOHD, 450 to 1064 nm, 5 mW to 2 W, 0.2 to 20 mrad"
    validated(SECTION, what, worst, 1e-4, "lasercalc 0.1.1", measure="relative")


def test_lasercalc_classes_agree_for_narrow_beams() -> None:
    """It takes the whole power for condition 3, so that it can only be compared where all of it passes 7 mm. Powers
    within the tables' rounding of a limit are left out."""
    compared = 0
    for nm in (405, 450, 520, 640, 785, 850, 1064):
        for watts in np.geomspace(1e-5, 2, 60):
            if any(0.95 < watts / ael(name, nm * 1e-9) < 1.05 for name in ("1", "3R")):
                continue
            theirs = lasercalc.classify(lasercalc.LaserSource(nm, EmissionMode.CW, watts)).laser_class
            assert eye_safety(Beam(nm * 1e-9, watts, 2e-3)).laser_class == theirs, (nm, watts)
            compared += 1
    assert compared > 300


# Apertures and distances.


@pytest.mark.parametrize("diameter", [1e-3, 7e-3, 30e-3])
def test_gaussian_through_an_aperture(diameter: float, validated: Validated) -> None:
    peak = 4 / (math.pi * diameter**2)  # 1 W of exp(-(2r/d63)²)
    want = quad(lambda r: 2 * math.pi * r * peak * math.exp(-((2 * r / diameter) ** 2)), 0, PUPIL / 2)[0]
    error = abs(Beam(640e-9, 1.0, diameter, profile="gaussian").through(PUPIL, 5) / want - 1)
    what = f"Gaussian beam of d63 = {diameter * 1e3:g} mm through 7 mm"
    validated(SECTION, what, error, 1e-9, "numerical integration", measure="relative")


@pytest.mark.parametrize("profile", ["tophat", "gaussian"])
def test_nohd_is_where_the_irradiance_meets_the_mpe(profile: str, validated: Validated) -> None:
    beam = Beam(640e-9, 0.05, 4e-3, 2e-3, profile=profile)  # type: ignore[arg-type]
    want = float(brentq(lambda z: irradiance_at(beam, z) - mpe(640e-9, 0.25), 0.1, 1e4, xtol=1e-12))  # type: ignore[arg-type]
    error = abs(eye_safety(beam).nohd / want - 1)
    validated(SECTION, f"NOHD, {profile}, 50 mW, 2 mrad", error, 1e-9, "root of the irradiance", measure="relative")


@pytest.mark.parametrize(("power", "diameter"), [(30e-3, 2e-3), (0.1, 20e-3)])
def test_nohd_of_an_extended_source_is_the_last_crossing(power: float, diameter: float, validated: Validated) -> None:
    beam = Beam(640e-9, power, diameter, 5e-2, source_angle=40e-3)

    def margin(z: float) -> float:
        return irradiance_at(beam, z) - mpe(640e-9, 100, beam.source_angle * 0.1 / z)

    found = eye_safety(beam, exposure=100).nohd
    small = eye_safety(Beam(640e-9, power, diameter, 5e-2), exposure=100).nohd
    assert 0.1 < found < small
    assert margin(0.95 * found) > 0
    assert all(margin(z) <= 0 for z in np.geomspace(found * (1 + 1e-9), 100, 500))
    want = float(brentq(margin, 0.95 * found, small, xtol=1e-12))  # type: ignore[arg-type]
    what = f"NOHD, extended source of 40 mrad at 100 mm, {power * 1e3:g} mW, 50 mrad, 100 s"
    validated(SECTION, what, abs(found / want - 1), 1e-9, "root of the irradiance", measure="relative")


def test_distances_at_the_ends() -> None:
    assert eye_safety(Beam(640e-9, 1e-4, 1e-3)).nohd == 0
    assert eye_safety(Beam(640e-9, 1e-2, 1e-3)).nohd == math.inf
    assert eye_safety(Beam(640e-9, 20e-3, 50e-3)).nohd == 0
    assert eye_safety(Beam(640e-9, 20e-3, 50e-3)).aided_nohd == math.inf
    found = eye_safety(Beam(640e-9, 20e-3, 0.0, 20e-3), (1, 5))
    assert [place.safe for place in found.at] == [False, True]
    assert found.aided_nohd == pytest.approx(found.nohd * 50 / 7)


# Classes.


@pytest.mark.parametrize(
    ("nm", "milliwatts", "mm", "divergence", "want"),
    [
        (640, 0.39, 1, 0, "1"),
        (640, 0.40, 1, 0, "2"),
        (640, 1, 1, 0, "2"),
        (640, 1.01, 1, 0, "3R"),
        (640, 5, 1, 0, "3R"),
        (640, 5.1, 1, 0, "3B"),
        (640, 500, 1, 0, "3B"),
        (640, 501, 1, 0, "4"),
        (405, 0.03, 1, 0, "1"),
        (405, 0.05, 1, 0, "2"),
        (850, 0.77, 1, 0, "1"),
        (850, 0.80, 1, 0, "3R"),
        (850, 4.1, 1, 0, "3B"),
        (640, 15, 50, 0, "1M"),  # 7 mm take 0.29 mW
        (640, 20, 50, 0, "2M"),  # 7 mm take 0.392 mW of 20
        (640, 51, 50, 0, "2M"),  # 1.000 mW
        (640, 52, 50, 0, "3B"),  # 1.02 mW: above Class 2 for the eye, above 3R in the telescope
        (850, 20, 50, 0, "1M"),
        (640, 1000, 400, 0, "1M"),  # a watt, of which a pupil takes 0.31 mW and a telescope 16 mW
        (640, 20, 0, 0.5, "1"),  # a cone so wide that neither gathers much
        (640, 20, 0, 0.02, "3B"),  # a narrow one: all passes 7 mm at 100 mm
    ],
)
def test_classes_by_hand(nm: float, milliwatts: float, mm: float, divergence: float, want: str) -> None:
    assert eye_safety(Beam(nm * 1e-9, milliwatts * 1e-3, mm * 1e-3, divergence)).laser_class == want


def test_more_than_half_a_watt_in_a_telescope_is_class_4() -> None:
    # By the naked eye alone it would be Class 3B: 7 mm take 22 mW of it.
    found = eye_safety(Beam(1064e-9, 0.9, 45e-3))
    assert found.emission["3"] < found.limits["3B"]
    assert found.laser_class == "4"


def test_an_extended_source_is_classed_where_it_is_worst() -> None:
    # 5 mW of nearly parallel light: harmless from a blurred source at 100 mm, not from the point it is farther away.
    found = eye_safety(Beam(520e-9, 5e-3, 5e-3, 1e-3, source_angle=20e-3))
    assert found.nearest.safe
    assert found.laser_class == "3R"
    assert found.naked_distance == pytest.approx(20e-3 / 1.5e-3 * 0.1)
    # Where the light thins out faster than the source shrinks, 100 mm is the worst.
    assert eye_safety(Beam(520e-9, 5e-3, 5e-3, 1.0, source_angle=20e-3)).naked_distance == 0.1


def test_exposures_assumed() -> None:
    red = eye_safety(Beam(640e-9, 1e-4, 1e-3), looked_into=True)
    assert (red.exposure, red.class_exposure) == (3e4, 3e4)
    assert eye_safety(Beam(850e-9, 1e-4, 1e-3)).exposure == 100
    assert eye_safety(Beam(640e-9, 1e-4, 1e-3)).exposure == 0.25


@settings(max_examples=60, deadline=None)
@given(
    nm=st.floats(400, 1399.9),
    power=st.floats(1e-6, 2),
    diameter=st.floats(0, 0.2),
    divergence=st.floats(1e-4, 1),
    angle=st.sampled_from([0.0, 5e-3, 0.05]),
)
def test_more_light_is_never_safer(nm: float, power: float, diameter: float, divergence: float, angle: float) -> None:
    less = eye_safety(Beam(nm * 1e-9, power, diameter, divergence, angle))
    more = eye_safety(Beam(nm * 1e-9, 1.7 * power, diameter, divergence, angle))
    point = eye_safety(Beam(nm * 1e-9, power, diameter, divergence))
    assert ORDER.index(more.laser_class) >= ORDER.index(less.laser_class)
    assert more.nohd >= less.nohd
    assert less.nohd <= less.aided_nohd * (1 + 1e-9) or less.aided_nohd == 0
    assert ORDER.index(point.laser_class) >= ORDER.index(less.laser_class)
    assert point.nohd >= less.nohd * (1 - 1e-9)
    assert mpe(nm * 1e-9, 0.25, angle) >= mpe(nm * 1e-9, 10, angle) >= mpe(nm * 1e-9, 3e4, angle)


def test_limits_of_extended_sources_by_hand() -> None:
    """Tables 4, 5 and 7 at 15 mrad: C6 = 10, T2 = 13.7 s."""
    heat = 10 * (10 * 10 ** (13.5 / 98.5)) ** -0.25
    assert ael("1", 640e-9, source_angle=15e-3) == pytest.approx(7e-4 * heat)
    assert ael("2", 640e-9, source_angle=15e-3) == pytest.approx(10e-3)
    assert ael("3R", 640e-9, source_angle=15e-3) == pytest.approx(50e-3)
    assert ael("3R", 850e-9, source_angle=15e-3) == pytest.approx(3.5e-3 * heat * 10**0.3)
    assert ael("3R", 850e-9) == pytest.approx(2e-3 * 10**0.3)
    assert ael("1", 1350e-9) == pytest.approx(1e4 * math.pi * 3.5e-3**2 / 4)  # the skin's


def test_where_power_and_angle_are_taken() -> None:
    beam = Beam(640e-9, 1e-3, 10e-3, 2 * math.atan(0.05), source_angle=20e-3)  # widens by 0.1 m a metre
    found = eye_safety(beam, looked_into=True)
    assert found.emission["1"] == pytest.approx(1e-3 * (50 / 210) ** 2)
    assert found.emission["3"] == pytest.approx(1e-3 * (7 / (10 + 100 * found.naked_distance)) ** 2)
    assert [beam.angle_at(z) for z in (0.02, 0.1, 0.4)] == pytest.approx([20e-3, 20e-3, 5e-3])


def test_class_1_limits_are_the_mpe_through_7_mm(validated: Validated) -> None:
    worst = 0.0
    for nm in np.arange(400, 1400, 3.0):
        for angle in (0, 5e-3, 30e-3, 0.1):
            for seconds in (100, 3e4):
                through = mpe(nm * 1e-9, seconds, angle) * math.pi * PUPIL**2 / 4
                worst = max(worst, abs(ael("1", nm * 1e-9, seconds, angle) / through - 1))
    what = "Class 1 AEL, 400 to 1399 nm, sources to 100 mrad (the standard's tables have two digits)"
    validated(SECTION, what, worst, 0.015, "MPE × area of 7 mm", measure="relative")


# From scenes, in words, and refused.


def _scene(**light: object) -> Scene:
    lens = ThinLens(focal_length=0.05, aperture_radius=5e-3)
    return Scene(
        distance=2.0,
        target=Target(lens, 5.0),
        probe=Probe(lens),
        illumination=Illumination(**light),  # type: ignore[arg-type]
    )


def test_beam_of_scenes() -> None:
    assert beam_of(_scene(power=2e-3)) == Beam(640e-9, 2e-3, 10e-3)
    assert beam_of(_scene(power=2e-3, diameter=50e-3)) == Beam(640e-9, 2e-3, 50e-3)
    wide = beam_of(_scene(mode="diverging", divergence=0.02))
    assert (wide.diameter, wide.divergence) == (0, pytest.approx(0.02))
    filled = beam_of(_scene(mode="fixed_area", diameter=50e-3))
    assert filled.width(2.0) == pytest.approx(50e-3)
    assert beam_of(_scene(power=2e-3, second_beam={"ratio": 0.25, "angle": [0, 0.01]})).power == pytest.approx(2.5e-3)
    assert beam_of(_scene(bandwidth=10e-9)).wavelength == pytest.approx(630e-9)
    assert beam_of(_scene(wavelength=705e-9, bandwidth=20e-9)).wavelength == 700e-9
    focused = eye_safety(beam_of(_scene(power=20e-3, diameter=50e-3, vergence=-1.0)))
    assert (focused.laser_class, focused.nohd, focused.emission["3"]) == ("3B", math.inf, 20e-3)
    assert beam_of(_scene(mode="fixed_area", diameter=50e-3, vergence=0.0)).divergence == 0
    with pytest.raises(InputError, match="2 wavelengths at once"):
        beam_of(_scene(lines=[{"wavelength": 850e-9, "power": 1e-3}]))
    with pytest.raises(InputError, match="wavelength: 1550 nm"):
        beam_of(_scene(wavelength=1550e-9))


def test_lines_explain_and_never_certify() -> None:
    wide = eye_safety(Beam(640e-9, 20e-3, 50e-3), (5,)).lines()
    text = " ".join(wide)
    assert wide[-1] == NOT_A_CERTIFICATE
    assert "would be Class 3B; but the beam is wide" in text
    assert "Class 2M by calculation" in text
    assert "binoculars" in text
    narrow = " ".join(eye_safety(Beam(640e-9, 20e-3, 0.0, 0.02), (5,)).lines())
    assert "From 1.58 m on the irradiance is within the limit" in narrow
    assert "TOO MUCH" in narrow
    assert "rounds its class limits" in " ".join(eye_safety(Beam(640e-9, 1e-3, 1e-3)).lines())


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"wavelength": 399e-9}, "wavelength"),
        ({"wavelength": 1400e-9}, "wavelength"),
        ({"wavelength": 640}, "wavelength"),
        ({"wavelength": math.nan}, "wavelength"),
        ({"power": 0}, "power"),
        ({"power": math.inf}, "power"),
        ({"power": math.nan}, "power"),
        ({"diameter": -1e-3}, "diameter"),
        ({"diameter": math.nan}, "diameter"),
        ({"divergence": -1e-3}, "divergence"),
        ({"divergence": 4.0}, "divergence"),
        ({"source_angle": -1e-3}, "source_angle"),
        ({"source_angle": math.nan}, "source_angle"),
        ({"profile": "square"}, "profile"),
        ({"continuous": False}, "continuous"),
        ({"pulse_duration": 1e-9}, "pulse_duration"),
        ({"repetition_rate": 1e3}, "repetition_rate"),
    ],
)
def test_beams_refused(change: dict[str, object], where: str) -> None:
    values: dict[str, object] = {"wavelength": 640e-9, "power": 1e-3, "diameter": 1e-3}
    with pytest.raises(InputError) as caught:
        Beam(**(values | change))  # type: ignore[arg-type]
    assert caught.value.where == where
    assert caught.value.remedy
    if where in ("continuous", "pulse_duration", "repetition_rate"):
        assert "laser safety officer" in str(caught.value)


def test_other_values_refused() -> None:
    beam = Beam(640e-9, 1e-3, 1e-3)
    for arguments in (
        {"exposure": 0.1},
        {"exposure": 1e5},
        {"exposure": math.nan},
        {"nearest": 0.01},
        {"distances": [0]},
    ):
        with pytest.raises(InputError):
            eye_safety(beam, **arguments)  # type: ignore[arg-type]
    for name, nm, seconds in (("2", 850, 100), ("1C", 640, 100), ("1", 640, 10)):
        with pytest.raises(InputError):
            ael(name, nm * 1e-9, seconds)


def test_distances_of_a_generator_are_kept() -> None:
    beam = Beam(640e-9, 1e-3, 1e-3)
    assert [one.distance for one in eye_safety(beam, (d for d in (1.0, 2.0))).at] == [1.0, 2.0]
