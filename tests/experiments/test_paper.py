"""The paper's Figs. 4 to 6, coarser than the command makes them: what the paper says of them, and closed forms."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tapetum.bench import load_scene
from tapetum.errors import InputError
from tapetum.experiments import FIGURES, reproduce
from tapetum.experiments import write as writing
from tapetum.experiments.drawings import draw_fig4, draw_fig5, draw_fig6, draw_fig7, draw_fig8
from tapetum.experiments.fig4 import DISTANCES, ROTATIONS, Fig4, simulate_fig4
from tapetum.experiments.fig5 import Fig5, simulate_fig5
from tapetum.experiments.fig6 import Fig6, simulate_fig6
from tapetum.experiments.fig7 import Fig7, Sample, sample
from tapetum.experiments.fig8 import Fig8, simulate_fig8
from tapetum.experiments.measure import holding_diameter, mirror_error, power_law, widths
from tapetum.experiments.templating import render
from tapetum.experiments.workshop import Workshop
from tapetum.report.figures import figure_png

SECTION = "The paper's figures"
# What a traced lens is planned with: widths and peaks are looked at, to some per cent and more.
ROUGH = "sampling.accuracy=0.5"


@pytest.fixture(scope="module")
def fig4() -> Fig4:
    return simulate_fig4(focal_lengths=(0.1, 0.05), pixels=200, accuracy=1e-2)


@pytest.fixture(scope="module")
def fig5() -> Fig5:
    return simulate_fig5(distances=(0.5, 1.5, 3.0, 5.0), pixels=340, accuracy=1e-2)


@pytest.fixture(scope="module")
def fig6() -> Fig6:
    return simulate_fig6(distances=(2.0, 3.0, 5.0), pixels=150, accuracy=1e-2)


@pytest.fixture(scope="module")
def turned() -> list[Sample]:
    # The second beam's RR lies beside the first one's, and widens what is measured.
    scene = load_scene("rotation", [ROUGH, "illumination.second_beam=null"])
    return [sample(f"{gaze:g}", scene, (0.0, gaze), seed=1) for gaze in (0.0, 0.4)]


@pytest.fixture(scope="module")
def fig8() -> Fig8:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tapetum.experiments.fig8.load_scene", lambda name: load_scene(name, [ROUGH]))
        return simulate_fig8(names=("phone-02",))


def disc(radius: float, size: int = 201) -> np.ndarray:
    x = np.arange(size) - (size - 1) / 2
    return (np.hypot(x[:, None], x[None, :]) < radius).astype(float)


def test_sizes_of_an_even_disc() -> None:
    image = disc(60.0)
    for share in (0.5, 0.8):
        assert holding_diameter(image, 2e-6, share) == pytest.approx(240e-6 * math.sqrt(share), rel=5e-3)
    bar = np.zeros((50, 50))
    bar[20:30, 5:45] = 3.0
    assert widths(bar, 1e-6) == pytest.approx((32e-6, 8e-6))
    assert mirror_error(bar, 0) == mirror_error(bar, 1) == 0
    bar[:25] = 0
    assert mirror_error(bar, 0) == 1 and mirror_error(bar, 1) == 0
    for bad in (np.zeros((4, 4)), np.full((4, 4), np.nan), np.ones(4)):
        with pytest.raises(InputError, match="image"):
            holding_diameter(bad, 1e-6, 0.5)
    with pytest.raises(InputError, match="share"):
        holding_diameter(image, 1e-6, 1.0)


def test_a_power_law_with_its_error() -> None:
    x = np.geomspace(0.5, 5, 10)
    law = power_law(x, 3 * x**-2)
    assert (law.exponent, law.factor) == pytest.approx((-2, 3)) and law.error < 1e-12
    # Of 400 noisy ones, 68 % should hold the true exponent in one standard error (Student's t of 8 degrees: 65 %).
    rng = np.random.default_rng(0)
    laws = [power_law(x, 3 * x**-2 * np.exp(0.1 * rng.normal(size=10))) for _ in range(400)]
    held = np.mean([abs(one.exponent + 2) < one.error for one in laws])
    assert 0.58 < held < 0.72
    for a, b in (([1, 2], [1, 2]), ([1, 2, 3], [1, 0, 3]), ([1, 2, math.nan], [1, 2, 3]), ([2, 2, 2], [1, 2, 3])):
        with pytest.raises(InputError):
            power_law(a, b)


def test_fig4_becomes_smaller_as_the_focus_goes_away(fig4: Fig4) -> None:
    for focal_length in (0.1, 0.05):
        for rotation in ROTATIONS:
            sizes = [fig4.row(focal_length, x_d, rotation)["diameter_mm"] for x_d in DISTANCES]
            assert sizes[0] > 1.5 * sizes[1] > 2 * sizes[2]


def test_fig4_is_seen_whole(fig4: Fig4) -> None:
    assert max(row["rim_over_peak"] for row in fig4.rows) < 0.02


def test_fig4_head_on_is_round_and_in_the_middle(fig4: Fig4) -> None:
    for row, image in zip(fig4.rows, fig4.images.reshape(-1, *fig4.images.shape[3:]), strict=True):
        if row["rotation_deg"] == 0:
            np.testing.assert_allclose(image, image.T, atol=2e-3 * image.max())
            assert row["mirror_left_right"] < 1e-4 and row["mirror_up_down"] < 1e-4


def test_fig4_head_on_has_the_size_that_rays_give(fig4: Fig4, validated) -> None:
    """The returning wave has the curvature 2/(x_d + f): a disc of radius r f_p 2/(x_d + f), but for diffraction."""
    worst = 0.0
    for focal_length in (0.1, 0.05):
        even = 2 * 3.0 * 0.2 * 2 / (DISTANCES[0] + focal_length) * math.sqrt(0.8)
        worst = max(worst, abs(fig4.row(focal_length, DISTANCES[0], 0.0)["diameter_mm"] / even - 1))
    what = "Fig. 4, head-on, f = 100 and 50 mm, x_d = 1 m: diameter with 80 % of the light"
    validated(SECTION, what, worst, 0.06, "rays: even disc of radius 2 r f_p/(x_d + f)", "of the diameter")


def test_fig4_parts_along_the_rotation(fig4: Fig4, validated) -> None:
    """Two ring systems up and down, twice as far apart at twice the angle; the same left and right."""
    fringe = 640e-9 * 0.2 / 6e-3 * 1e3
    worst = 0.0
    for focal_length in (0.1, 0.05):
        for x_d in DISTANCES:
            half, whole = (fig4.row(focal_length, x_d, rotation) for rotation in (0.5, 1.0))
            assert half["mirror_left_right"] < 1e-4 and whole["mirror_left_right"] < 1e-4
            assert half["mirror_up_down"] < 0.35
            assert whole["ring_centres_apart_mm"] > 1.5 * half["ring_centres_apart_mm"] > 0
            # Longer along the axis of rotation than across it, and more so the more it is turned.
            stretch = [row["width_x_mm"] / row["width_y_mm"] for row in (half, whole)]
            assert 1 < stretch[0] < stretch[1]
            for row in (half, whole):
                worst = max(worst, abs(row["ring_centres_apart_mm"] - row["ring_centres_expected_mm"]) / fringe)
    what = "Fig. 4, f = 100 and 50 mm, 0.5° and 1°: distance of the two ring systems' centres"
    validated(SECTION, what, worst, 1.6, "rays: f_p · 2z tanθ · 2/(x_d + f)", "of λ f_p/2r")


def test_fig5_falls_as_the_beam_widens(fig5: Fig5, validated) -> None:
    np.testing.assert_allclose(fig5.beam_area, math.pi * (np.array(fig5.distances) * math.tan(math.radians(0.25))) ** 2)
    for strip in fig5.strips:
        what = f"Fig. 5, {strip.name}: exponent of all light over the distance, 0.5 to 5 m"
        validated(SECTION, what, abs(strip.without_floor.exponent + 2), 3e-3, "beam's area, −2", "absolute")
        # A floor takes from dim images more than from bright ones: steeper, never flatter.
        assert -2.3 < strip.measured.exponent < -2.0
        assert (strip.signal < strip.total * 1.005).all()
    what = "Fig. 5, focused on the probe: exponent of the sum above the noise floor"
    validated(SECTION, what, abs(fig5.strips[0].measured.exponent + 2), 0.04, "beam's area, −2", "absolute")


def test_fig5_does_not_saturate(fig5: Fig5) -> None:
    for strip in fig5.strips:
        assert strip.fill == pytest.approx(0.8)
        assert strip.frames.max() < 6000


def test_fig5_keeps_its_shape_in_a_flat_wave_only(fig5: Fig5) -> None:
    on_probe, left, flat = fig5.strips
    np.testing.assert_allclose(flat.diameter, flat.diameter[0], rtol=1e-3)
    assert on_probe.diameter[0] > 4 * on_probe.diameter[-1]
    # The disc r f_p/d of a focus on the probe, where rays rule.
    even = 2 * 3.8e-3 / 2.8 * 0.2 / 0.5 * math.sqrt(0.8)
    assert on_probe.diameter[0] == pytest.approx(even, rel=0.1)
    # Parallel light leaves at half the distance it is focused at: smallest near 2.5 m.
    assert left.diameter.argmin() == list(fig5.distances).index(3.0)


def test_fig6_diffuse_shows_the_probes_aperture(fig6: Fig6, validated) -> None:
    for name in ("white cardboard", "filter 0.2 mm before the focus"):
        surface = fig6.named(name)
        error = float(np.abs(surface.diameter / fig6.aperture_image - 1).max())
        validated(SECTION, f"Fig. 6, {name}: diameter, 2 to 5 m", error, 0.025, "D_p f_p/d", "of the diameter")
        assert surface.size.exponent == pytest.approx(-1, abs=0.02)


def test_fig6_specular_keeps_its_size_and_is_brighter(fig6: Fig6) -> None:
    mirror, flat, card = (fig6.named(name) for name in ("mirror", "mirror, flat wave", "white cardboard"))
    np.testing.assert_allclose(flat.diameter, flat.diameter[0], rtol=1e-3)
    assert np.ptp(mirror.diameter) < 0.03 * np.ptp(card.diameter)
    assert (mirror.diameter < 0.2 * card.diameter).all()
    assert (mirror.peak > 100 * card.peak).all() and (mirror.power > 100 * card.power).all()
    # Without spread the scattered light comes back to the probe as a mirror's does.
    assert (fig6.named("white, no spread").diameter < 0.2 * card.diameter).all()


def test_figures_and_pages(fig4: Fig4, fig5: Fig5, fig6: Fig6) -> None:
    figures = (draw_fig4(fig4), draw_fig5(fig5), draw_fig6(fig6))
    for figure in figures:
        with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as picture:
            assert np.asarray(picture.convert("L")).std() > 20
    pages = [render(name, one.numbers()) for name, one in zip(FIGURES, (fig4, fig5, fig6), strict=False)]
    for name, page, found in zip(FIGURES[:3], pages, (fig4, fig5, fig6), strict=True):
        assert f"({name}.png)" in page and "**The paper**" in page and "**What differs**" in page
        assert " nan" not in page.lower() and max(len(line) for line in page.splitlines() if line[:1] != "|") <= 120
        json.dumps(found.numbers(), allow_nan=False)
    # The tables hold what was measured.
    assert f"{fig4.row(0.1, 1.0, 0.5)['diameter_mm']:.2f}" in pages[0]
    assert f"{fig5.strips[2].measured.exponent:.3f}".replace("-", "−") in pages[1]
    assert f"{1e3 * fig6.named('mirror').diameter[-1]:.3f}" in pages[2]


def test_samples_are_neither_black_nor_saturated(turned: list[Sample], fig8: Fig8) -> None:
    for one in (*turned, *fig8.opened, *fig8.shut):
        assert one.counts.shape == (400, 400) and one.counts.dtype == np.uint8
        assert one.row["peak_over_full_scale"] > 0.03 and one.row["saturated_pixels"] < 200
        assert one.counts.std() > 0.5


def test_fig7_turns_from_rings_into_a_line(turned: list[Sample]) -> None:
    middle, edge = (one.row for one in turned)
    assert middle["width_y_um"] == pytest.approx(middle["width_x_um"], rel=0.02)
    assert edge["width_y_um"] > 1.25 * edge["width_x_um"]


def test_fig8_filters_show_the_probes_aperture(fig8: Fig8, validated) -> None:
    """Without the second beam's disc at its side, which is a tenth as bright."""
    single = fig8.opened[0]
    assert single.row["seen"] == single.row["cameras"] == 1
    what = "Fig. 8, a filter before the focus: diameter with half of the light, second beam included"
    error = abs(single.row["disc_um"] / (1e6 * fig8.disc) - 1)
    validated(SECTION, what, error, 0.25, "D_p f_p/d", "of the diameter")
    # Shutting the app takes light away and adds none.
    assert [one.name for one in fig8.shut] == ["phone-02"] and single.row["flash_electrons"] > 0


def test_figures_and_pages_of_samples(turned: list[Sample], fig8: Fig8) -> None:
    lost = Sample("3 m", np.zeros((400, 400), np.uint8), {}, "target: too far out of focus")
    fig7 = Fig7(turned, [lost, *turned], turned, 255, 2.2e-6)
    for name, figure, found in (("fig7", draw_fig7(fig7), fig7), ("fig8", draw_fig8(fig8), fig8)):
        page = render(name, found.numbers())
        with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as picture:
            assert np.asarray(picture.convert("L")).std() > 20
        assert f"({name}.png)" in page and "**The paper**" in page and "**What differs**" in page
        assert " nan" not in page.lower() and "imulat" in page
        assert max(len(line) for line in page.splitlines() if line[:1] != "|") <= 120
        json.dumps(found.numbers(), allow_nan=False)
    assert "too far out of focus" in " ".join(render("fig7", fig7.numbers()).split())


def test_files_of_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fig6: Fig6) -> None:
    made: list[str] = []

    def small(work: object) -> tuple[object, dict[str, object]]:
        made.append("fig6")
        return draw_fig6(fig6), fig6.numbers()

    monkeypatch.setitem(writing._MAKERS, "fig6", small)
    (one,) = reproduce(["fig6", "fig6"], tmp_path / "new" / "folder")
    assert made == ["fig6"] and one.name == "fig6"
    assert [file.name for file in one.files] == ["fig6.png", "fig6.md", "fig6.json"]
    assert json.loads(one.files[2].read_text()) == json.loads(json.dumps(fig6.numbers()))
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == ["fig6.json", "fig6.md", "fig6.png"]


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fig3"):
        reproduce(["fig3"], tmp_path)
    with pytest.raises(InputError, match="large"):
        reproduce(["fig7"], tmp_path, size="large")
    with pytest.raises(InputError, match="none"):
        reproduce([], tmp_path)
    taken = tmp_path / "taken"
    taken.write_text("")
    with pytest.raises(InputError, match="is a file"):
        reproduce(["fig4"], taken)
    with pytest.raises(InputError, match="taken"):
        reproduce(["fig4"], taken / "below")
    with pytest.raises(InputError, match="taken: is a file, not a folder"):
        reproduce(["fit"], tmp_path / "out", work=Workshop(taken))
    assert not (tmp_path / "out").exists()
