"""What every test may use: `validated`, which checks a number and keeps it for docs/validation.md."""

from __future__ import annotations

import gc
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from multiprocessing.context import BaseContext
from pathlib import Path

import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine

from tapetum.memory import keep_big_blocks
from tapetum.processes import context_of

Validated = Callable[..., None]
_KEPT = pytest.StashKey[list[dict[str, object]]]()
_LOADED = tuple(
    f"tapetum.{name}" for name in ("live.recorder", "live.log", "track.pipeline", "data.synth.work", "simulate.bounds")
)
_LONGEST = (
    "test_compare.py",
    "test_twin.py",
    "test_traced_plan.py",
    "test_modes_page.py",
    "test_traced_return.py",
    "test_documents.py",
    "test_adapt.py",
    "test_find_cameras.py",
    "test_traced_mask.py",
    "test_simulation_fit.py",
    "test_phone_camera.py",
    "test_page.py",
    "test_out_of_focus.py",
    "test_round_pass.py",
    "test_camera.py",
    "test_information.py",
    "test_traced_pass.py",
    "test_demo.py",
    "test_paper.py",
    "test_rtsp.py",
    "test_following.py",
    "test_smoother.py",
    "test_play_page.py",
    "test_faults.py",
    "test_cameras.py",
    "test_streak.py",
    "test_sensor_plane.py",
    "test_synth.py",
    "test_roll.py",
    "test_domain.py",
    "test_import_videos.py",
    "test_cli_record.py",
    "test_returns.py",
    "test_pretrained.py",
    "test_track_stopped.py",
    "test_resnet.py",
    "test_tolerances.py",
    "test_spot.py",
    "test_sensor.py",
    "test_planning.py",
    "test_playground.py",
    "test_shot.py",
    "test_film.py",
    "test_copy_prior.py",
    "test_grid_sampling.py",
    "test_surroundings.py",
    "test_synth_cluster.py",
    "test_pretrain.py",
    "test_double_pass.py",
    "test_loop.py",
    "test_sampling.py",
    "test_architectures.py",
    "test_examples.py",
    "test_tutorials.py",
    "test_cli_evaluate.py",
    "test_paper_learning.py",
    "test_scan.py",
    "test_export.py",
    "test_ghost.py",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--keep-validation", metavar="FILE", help="write the numbers that `validated` checked as JSON")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_KEPT] = []
    # As in every command: a tenth of the simulator's time otherwise.
    keep_big_blocks()
    load_once()
    # No test cuts the power, so none can tell what the disk has; when files are flushed is tested all the same.
    os.fsync = lambda handle, /: None


def load_once() -> None:
    """Let what processes fork from load the libraries of all tests, whichever comes first.

    It starts once and keeps the modules of the first; those of later tests would each load theirs, for seconds.
    """
    if not sys.platform.startswith("linux"):
        return  # `context_of` starts none there
    from multiprocessing import forkserver

    chosen = forkserver.set_forkserver_preload
    forkserver.set_forkserver_preload = lambda modules_names: chosen(sorted({*modules_names, *_LOADED}))


@pytest.fixture
def validated(request: pytest.FixtureRequest) -> Validated:
    """`validated(section, what, error, tolerance, against, measure="of the peak")`.

    Asserts that `error` is finite and at most `tolerance`, and keeps the line for docs/validation.md: `section` is the
    table it belongs to, `what` the quantity with its conditions, `against` the closed form, method or package,
    `measure` what the error is in fractions or units of.
    """

    def check(
        section: str, what: str, error: float, tolerance: float, against: str, measure: str = "of the peak"
    ) -> None:
        error = float(error)
        line = {"section": section, "what": what, "error": error, "tolerance": tolerance, "against": against}
        test = request.node.nodeid.partition("[")[0]
        request.config.stash[_KEPT].append({**line, "measure": measure, "test": test})
        assert math.isfinite(error), f"{what}: {error}"
        assert error <= tolerance, f"{what}: {error:.3g} {measure}, allowed {tolerance:.3g}, against {against}"

    return check


@pytest.fixture(scope="session")
def processes() -> BaseContext:
    """For processes that a test kills or limits: they fork from one that has loaded the libraries for all tests."""
    return context_of(*_LOADED)


@pytest.fixture(scope="module", autouse=True)
def rough_figures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw figures without arranging them, which takes longer than all the rest; where they are the test, with it."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "report":
            patch.setattr(ConstrainedLayoutEngine, "execute", lambda self, fig: None)
        yield


@pytest.fixture(scope="module")
def narrow() -> Iterator[None]:
    """Ask for a ResNet-18 and get one of a 64th of its weights: for what any network does in training and in files.

    The bundled model does not fit into it.
    """
    from tapetum.models.architectures import resnet18

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resnet18, "_WIDTHS", (8, 16, 32, 64))
        patch.setattr(resnet18.ResNet18Network, "width", 64)
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first: a long one at the end would leave the other cores idle."""
    items.sort(key=lambda item: _LONGEST.index(item.path.name) if item.path.name in _LONGEST else len(_LONGEST))


def pytest_collection_finish() -> None:
    """Keep the collector off the modules and tests, half a million objects that stay: a tenth of the time otherwise."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(5000, 10, 10)


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.getoption("--keep-validation")
    if path:
        # Of several processes each writes its own.
        worker = getattr(session.config, "workerinput", {}).get("workerid", "")
        Path(f"{path}{worker}").write_text(json.dumps(session.config.stash[_KEPT], indent=1), encoding="utf-8")
