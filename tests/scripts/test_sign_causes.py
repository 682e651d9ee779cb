"""What tells the sign of a gaze: each cause by its own test, and a table and a picture of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sign_causes import (
    Cause,
    Row,
    by_direction,
    direction_table,
    fig_sign_causes,
    markdown,
    sign_causes,
    sloped_scene,
    thin_target,
)
from tapetum.bench import with_values


def small(*names: str, about_symmetry: bool = False):
    """The thin lens in parallel light, focused far away and dim, with some of its causes, at one gaze."""
    made = thin_target()
    far = {
        "target.object_distance": "inf",
        "illumination": {"mode": "collimated", "power": 2e-7},
        "target.lens.aperture_radius": "2 mm",
    }
    causes = tuple(one for one in made.causes if one.name in names and one.about_symmetry == about_symmetry)
    return replace(made, scene=with_values(made.scene, far), gazes=made.gazes[:1], causes=causes, accuracy=1e-2)


def test_a_second_beam_tells_and_a_diffuse_return_does_not():
    nothing, beam, diffuse = sign_causes(small("nothing", "second beam", "diffuse return"))
    assert beam.median > 1.2 * nothing.median
    assert diffuse.median < 1.05 * nothing.median


def test_a_decentred_lens_tells_nothing_about_its_point_of_symmetry():
    target = small("nothing", "lens decentre")
    (plain, axis) = sign_causes(target)
    moved = replace(target, causes=(replace(target.causes[1], about_symmetry=True),))
    (about,) = sign_causes(moved)
    assert axis.median > 1.2 * plain.median
    assert abs(about.median - plain.median) < 0.05 * plain.median + 0.05


def test_a_tilted_sensor_shows_the_sign_along_its_slope_far_more_than_across_it():
    scene = sloped_scene()
    along, across = by_direction(scene, scene.target.sensor.tilt, 5e-2, (0, 90))
    assert along > 3 * across


def test_the_table_of_directions_has_a_row_an_angle():
    table = direction_table({"tilted": torch.arange(5.0), "not": 10 * torch.arange(5.0)}).splitlines()
    assert table[0] == "| angle to the slope | tilted | not |" and table[3] == "| 22.5° | 1 | 10 |" and len(table) == 7


def test_the_table_counts():
    row = Row(Cause("a beam", "10 %", "assumed"), torch.tensor([1.0, 4.0, 5.0, 2.0], dtype=torch.float64))
    assert (row.median, row.telling) == (3.0, 0.5)
    assert markdown([row]).splitlines()[-1] == "| a beam | 10 % | assumed | 3 | 50 % |"


def test_the_picture_shows_both_gazes_and_their_difference():
    figure = fig_sign_causes(small("nothing"), ["nothing"], gaze=0, half=20)
    plus, minus, turned, part = (np.asarray(ax.images[0].get_array()) for ax in figure.axes)
    assert plus.shape == (41, 41)
    # Without anything to break it a picture turned is that of the opposite gaze.
    assert np.allclose(turned, plus, atol=0.02) and np.allclose(minus[::-1, ::-1], turned)
    assert np.allclose(part, plus**2 - minus**2, atol=1e-6)
