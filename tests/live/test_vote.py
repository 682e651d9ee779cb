"""The vote: one voice a camera, after a dwell; tally, log and replay."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.live.test_pointer import SCREEN, fixes, gaze_of

from tapetum.errors import InputError
from tapetum.live.events import Event, Region
from tapetum.live.pointer import fit
from tapetum.live.state import CameraState, Health, State
from tapetum.live.vote import Ballot, Voice, VoteFile, Votes, read_votes, replay

YES, NO = Region("yes", -0.4, -0.4, -0.05, 0.4), Region("no", 0.05, -0.4, 0.4, 0.4)
BALLOT = Ballot("Shall we?", (YES, NO), dwell=1.0)
STEP = 0.125


def state(k: int, gazes: dict[str, float | None]) -> State:
    cameras = tuple(
        CameraState(
            one, 1, 0, 0, 5, x is not None, 0, 0,
            gaze_x=None if x is None else (x, x, x), gaze_y=(0.0, 0.0, 0.0),
        )
        for one, x in gazes.items()
    )  # fmt: skip
    return State("", k, round(k * STEP * 1e9), (640, 480), cameras, Health())


def test_a_voice_counts_after_its_dwell_and_moves_with_the_camera() -> None:
    votes = Votes(BALLOT)
    # Camera a points at yes for 2 s, unseen for a moment; b sweeps over it; then a turns to no.
    said: list[tuple[int, Voice]] = []
    for k in range(40):
        a = None if k == 5 else (-0.2 if k < 16 else 0.2)
        gazes = {"a": a, "b": -0.2 if k % 6 < 3 else 0.0}
        said += [(k, one) for one in votes.update(state(k, gazes))]
    assert [(k, one.camera, one.zone) for k, one in said] == [(8, "a", "yes"), (24, "a", "no")]
    assert votes.tally().voices == {"yes": 0, "no": 1} and votes.tally().count == 1


def test_a_camera_that_goes_takes_its_voice_along_unless_voices_are_kept() -> None:
    for keep, left in ((False, 0), (True, 1)):
        votes = Votes(Ballot("?", (YES, NO), dwell=0.0, keep=keep))
        assert [one.zone for one in votes.update(state(0, {"a": 0.2}))] == ["no"]
        gone = votes.update(state(1, {}), [Event("a", "end", "gone", 0)])
        assert [one.zone for one in gone] == ([] if keep else [""])
        assert votes.tally().count == left


def test_zones_of_a_screen_go_by_the_pointer_s_calibration() -> None:
    import numpy as np

    halves = (Region("left", 0, 0, 0.5, 1), Region("right", 0.5, 0, 1, 1))
    ballot = Ballot("?", halves, "screen", 0.0)
    votes = Votes(ballot, fit(SCREEN, fixes(9, np.random.default_rng(1))))
    x, y = gaze_of(1500, 500)
    one = CameraState("a", 1, 0, 0, 5, True, 0, 0, gaze_x=(x, x, x), gaze_y=(y, y, y))
    assert votes.update(State("", 0, 0, (1, 1), (one,), Health()))[0].zone == "right"
    with pytest.raises(InputError, match="need a calibration"):
        Votes(ballot)


def test_a_stored_vote_is_read_and_replayed_even_with_a_torn_end(tmp_path: Path) -> None:
    path = tmp_path / "vote.jsonl"
    kept = VoteFile(path, BALLOT, 3)
    given = [Voice(10, "a", "yes"), Voice(20, "b", "yes"), Voice(30, "a", "no"), Voice(40, "b", "")]
    kept.add(given)
    kept.close()
    with path.open("a") as file:
        file.write('{"utc_ns": 50, "cam')
    ballot, voices = read_votes(path)
    assert ballot == BALLOT and list(voices) == given
    assert [list(one.voices.values()) for one in replay(ballot, voices)] == [[1, 0], [2, 0], [1, 1], [0, 1]]
    with pytest.raises(InputError, match="exists"):
        VoteFile(path, BALLOT)
    path.write_text(path.read_text().split("\n")[0] + '\n{"utc_ns": 1, "camera": "a", "zone": "maybe"}\n')
    with pytest.raises(InputError, match=r"line 2: zone: 'maybe' is none of the ballot's"):
        read_votes(path)
    path.write_text("what\n")
    with pytest.raises(InputError, match="line 1: is no JSON"):
        read_votes(path)


@pytest.mark.parametrize(
    ("zones", "said"),
    [
        ((YES,), "has 1 zones"),
        ((YES, YES), "names must differ"),
        ((YES, Region("more", -0.1, 0, 0.1, 1)), "yes and more overlap"),
    ],
)
def test_a_ballot_that_is_none_is_refused(zones: tuple[Region, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Ballot("?", zones)
