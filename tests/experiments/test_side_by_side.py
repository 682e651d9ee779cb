"""Tasks in processes of their own: what one raises arrives, and ends the others."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import pytest

from tapetum.errors import InputError
from tapetum.experiments.side_by_side import side_by_side


def write_process(path: Path) -> None:
    path.write_text(str(os.getpid()), encoding="utf-8")


def refuse() -> None:
    raise InputError("cannot be filmed", where="target.lens", remedy="choose another")


def sleep_and_write(path: Path) -> None:
    time.sleep(45)
    path.touch()


def test_every_task_runs_once_elsewhere_and_the_environment_stays(tmp_path: Path) -> None:
    before = dict(os.environ)
    tasks = [partial(write_process, tmp_path / str(k)) for k in range(5)]
    assert sorted(side_by_side(tasks, 2)) == list(range(5))
    ran = {(tmp_path / str(k)).read_text() for k in range(5)}
    assert 1 <= len(ran) <= 2 and str(os.getpid()) not in ran
    assert dict(os.environ) == before


def test_an_error_arrives_whole_and_ends_the_others_at_once(tmp_path: Path) -> None:
    start = time.monotonic()
    with pytest.raises(InputError, match=r"target\.lens: cannot be filmed; choose another"):
        list(side_by_side([partial(sleep_and_write, tmp_path / "late"), refuse], 2))
    assert time.monotonic() - start < 40 and not (tmp_path / "late").exists()


def test_a_process_that_is_lost_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="processes: a process ended before its time"):
        list(side_by_side([partial(os._exit, 9), partial(write_process, tmp_path / "a")], 2))
