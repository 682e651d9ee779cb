"""`tapetum serve`: what it refuses. Runs as a person makes them: `live/test_tutorials.py` and `live/test_rtsp.py`."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from tapetum.cli.serve import _bound, _hosts
from tapetum.durable import sole_writer


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["nothing.mkv"], "nothing.mkv"),
        (["demo", "--detector", "eyes"], "--detector"),
        (["demo", "--token", "short"], "--token: has 5 characters; give 16 or more, or leave it out"),
        (["demo", "--log", "none/events.db"], "make the folder none first"),
        (["demo", "--model", "no-such-model"], "no-such-model"),
        (["demo", "--address", "no.such.host.invalid"], "no.such.host.invalid"),
        (["demo", "--to", "pigeon://roof"], "unknown kind of output 'pigeon://roof'"),
        (["demo", "--rules", "none.yaml"], "none.yaml"),
    ],
)
def test_bad_input_is_one_line(
    run: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = run("serve", *arguments, "--port", 0)
    assert ran.code == 2 and complaint in ran.complaint  # pyright: ignore[reportAttributeAccessIssue]


def test_rules_that_tell_an_output_that_is_none_are_refused(run: Callable[..., object], tmp_path: Path) -> None:
    rules = tmp_path / "guard.yaml"
    rules.write_text("schema: tapetum/rules/1\nrules: [{name: here, tell: [pager]}]\n")
    ran = run("serve", "demo", "--rules", rules, "--to", tmp_path / "tracks.csv", "--port", 0)
    assert ran.code == 2 and "there is no output 'pager'" in ran.complaint  # pyright: ignore[reportAttributeAccessIssue]


def test_a_port_in_use_is_refused_before_anything_takes_time(
    run: Callable[..., object], monkeypatch: pytest.MonkeyPatch
) -> None:
    # What would take seconds to import is not to be had.
    monkeypatch.setitem(sys.modules, "tapetum.live.app", None)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        ran = run("serve", "demo", "--port", taken.getsockname()[1])
    assert ran.code == 2 and "cannot be used" in ran.complaint  # pyright: ignore[reportAttributeAccessIssue]
    assert "give another port, or 0 for a free one" in ran.complaint  # pyright: ignore[reportAttributeAccessIssue]


def test_a_log_belongs_to_one_watch(run: Callable[..., object], tmp_path: Path) -> None:
    log = tmp_path / "watch.db"
    with ThreadPoolExecutor(1) as other, ExitStack() as held:
        other.submit(held.enter_context, sole_writer(log)).result()
        ran = run("serve", "demo", "--port", 0, "--log", log)
    assert ran.code == 2 and "watch.db: is being written by" in ran.complaint  # pyright: ignore[reportAttributeAccessIssue]
    assert not log.exists()


def test_the_names_that_are_let_in() -> None:
    assert _hosts("0.0.0.0", ["Watch.Example"]) == ("127.0.0.1", "localhost", "::1", "watch.example")
    assert _hosts("192.168.1.2", None)[-1] == "192.168.1.2"
    with _bound("127.0.0.1", 0) as bound:
        assert bound.getsockname()[1] > 0
