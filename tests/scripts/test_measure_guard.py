"""Films for a guard: what is said to happen is what they show."""

from __future__ import annotations

import numpy as np
import pytest

from guard_films import GuardFilm, Happening
from measure_guard import PLACES, Raised, draw_script, guarded, score


def test_a_camera_shows_while_it_is_here_and_not_else() -> None:
    film = GuardFilm("gaze", seed=3, count=6, seconds=90.0)
    stays = [one for one in film.happenings if one.rule == "here"]
    looks = [one for one in film.happenings if one.rule == "looks"]
    assert len(stays) + len(looks) == 6 and stays and looks
    assert all(any(stay.begin < one.begin < one.end < stay.end for stay in stays) for one in looks)
    # A turn takes half a second.
    for stay in stays:
        for time, here in ((-0.6, False), (0.3, True), (stay.end - stay.begin - 0.3, True)):
            frame = film.frame(round((stay.begin + time) * film.rate))
            assert (int(frame.image.max()) > 60) == here
        assert int(film.frame(round((stay.end + 0.6) * film.rate)).image.max()) <= 60


@pytest.mark.slow  # planning a phone's camera
def test_a_phone_changes_when_it_begins_to_image() -> None:
    film = GuardFilm("phone", seed=3, count=1, seconds=40.0)
    (act,) = film.happenings
    assert act.rule == "images"
    before, after = (film.frame(round((act.begin + by) * film.rate)).image.astype(int) for by in (-0.3, 0.3))
    assert abs(after.sum() - before.sum()) > 5 * np.sqrt(before.size)


@pytest.mark.parametrize(
    ("alert", "found", "false"),
    [
        (Raised("looks", 5.4, (0.0, 0.0)), 1, 0),
        (Raised("looks", 6.2, (0.0, 0.0)), 0, 1),
        (Raised("looks", 4.9, (0.0, 0.0)), 0, 1),
        (Raised("here", 5.4, (0.0, 0.0)), 0, 1),
    ],
    ids=["within a second", "late", "too early", "another rule"],
)
def test_an_alert_counts_once_within_a_second(alert: Raised, found: int, false: int) -> None:
    told = score([Happening("looks", 0, 5.0, 9.0)], [alert])
    assert (told.found, told.false) == (found, false)
    again = score([Happening("looks", 0, 5.0, 9.0)], [alert, alert])
    assert again.false == false + 1


def test_a_guard_finds_what_is_drawn() -> None:
    script = draw_script(5, count=8, seconds=150.0)
    told = score(script.happenings, guarded(script, 5), PLACES)
    assert (told.happenings, told.found, told.false) == (8, 8, 0)
