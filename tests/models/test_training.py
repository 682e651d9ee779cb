"""The training loop: resumed, stopped early, over several processes, and what it refuses."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F

from tapetum.errors import InputError
from tapetum.models import devices
from tapetum.models.augmentation import Augmentation
from tapetum.models.busy import BusySample, busy_share, covered
from tapetum.models.checkpoint import CHECKPOINT, HISTORY, KeptEpoch
from tapetum.models.training import EpochReport, TrainingSettings, kept_epoch, train

PLAIN = TrainingSettings(epochs=2, batch=8, learning_rate=1e-2, augmentation=Augmentation.none())
VARIED = replace(PLAIN, epochs=4, augmentation=Augmentation())


def tiny(*, normalised: bool = True) -> nn.Module:
    """A network of a few hundred weights, some of them convolutions, whose memory training rearranges."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        middle = [nn.BatchNorm2d(6)] if normalised else []
        layers = [nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Conv2d(4, 6, 3), *middle]
        return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(6, 2))


@pytest.fixture(scope="module")
def data() -> tuple[Tensor, Tensor]:
    """37 images, which no batch divides, and where their brightest place lies."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(37, 1, 12, 12, generator=generator)
    return images, torch.stack([images.mean((1, 2, 3)), images.amax((1, 2, 3))], dim=1)


def weights(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


def assert_equal(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    for name, value in theirs.items():
        assert torch.equal(ours[name], value), name


class KilledError(Exception):
    pass


def kill_after(epoch: int):
    def on_epoch(report: EpochReport) -> None:
        if report.epoch == epoch:
            raise KilledError

    return on_epoch


@dataclass
class Scripted:
    """A held-out error that follows a script, and remembers what was judged."""

    errors: list[float]

    def __post_init__(self) -> None:
        self.seen: list[dict[str, Tensor]] = []

    def __call__(self, network: nn.Module) -> float:
        assert not network.training
        self.seen.append(weights(network))
        return self.errors[len(self.seen) - 1]


def test_a_killed_run_ends_with_the_bits_of_an_unbroken_one(data, tmp_path: Path):
    unbroken, broken, resumed = tiny(), tiny(), tiny()
    train(unbroken, *data, VARIED, device="cpu")
    with pytest.raises(KilledError):
        train(broken, *data, VARIED, device="cpu", checkpoint=tmp_path, on_epoch=kill_after(2))
    history = train(resumed, *data, VARIED, device="cpu", checkpoint=tmp_path, resume=True)
    assert [report.epoch for report in history] == [1, 2, 3, 4]
    assert_equal(weights(resumed), weights(unbroken))
    assert sorted(path.name for path in tmp_path.iterdir()) == [CHECKPOINT, HISTORY]


def test_seeds_decide(data):
    runs = []
    for seed in (0, 0, 1):
        network = tiny()
        train(network, *data, replace(VARIED, seed=seed), device="cpu")
        runs.append(weights(network)["0.weight"])
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_patience_keeps_the_best_epoch(data):
    network, held_out = tiny(), Scripted([3.0, 1.0, 2.0, 1.0, 0.0])
    history = train(network, *data, replace(VARIED, epochs=5, patience=2), validate=held_out, device="cpu")
    # The fourth is no better than the second; two without a better one end it, before the fifth.
    assert [report.best for report in history] == [True, True, False, False]
    assert kept_epoch(history, 2) == 2
    assert kept_epoch(history, None) == 4
    assert_equal(weights(network), held_out.seen[1])
    assert not network.training


def test_without_patience_the_last_epoch_is_kept(data):
    network, held_out = tiny(), Scripted([1.0, 2.0, 3.0, 4.0])
    history = train(network, *data, VARIED, validate=held_out, device="cpu")
    assert len(history) == 4
    assert_equal(weights(network), held_out.seen[3])


@pytest.mark.parametrize("killed", [3, 4])
def test_patience_outlives_a_kill(data, tmp_path: Path, killed: int):
    settings = replace(VARIED, epochs=6, patience=2)
    script = [3.0, 1.0, 2.0, 1.5, 0.0, 0.0]
    unbroken, resumed = tiny(), tiny()
    train(unbroken, *data, settings, validate=Scripted(script), device="cpu")
    with pytest.raises(KilledError):
        train(
            tiny(), *data, settings, validate=Scripted(script), device="cpu", checkpoint=tmp_path,
            on_epoch=kill_after(killed),
        )  # fmt: skip
    rest = Scripted(script[killed:])
    history = train(resumed, *data, settings, validate=rest, device="cpu", checkpoint=tmp_path, resume=True)
    assert (len(history), len(rest.seen), kept_epoch(history, 2)) == (4, 4 - killed, 2)
    assert_equal(weights(resumed), weights(unbroken))


def test_two_processes_train_as_one(data, tmp_path: Path):
    one, two, resumed = (tiny(normalised=False) for _ in range(3))
    seen: list[EpochReport] = []
    before = (dict(os.environ), torch.get_num_threads())
    train(one, *data, PLAIN, device="cpu")
    # Callbacks stay in this process, so they need not travel.
    held_out = Scripted([1.0, 0.5])
    history = train(
        two, *data, PLAIN, validate=held_out, device="cpu", processes=2, checkpoint=tmp_path, on_epoch=seen.append
    )
    assert history == seen
    for name, value in weights(one).items():
        torch.testing.assert_close(weights(two)[name], value, rtol=0, atol=1e-5)
    # By then the two networks are not the one they began with.
    assert float((weights(one)["0.weight"] - weights(tiny(normalised=False))["0.weight"]).abs().max()) > 1e-2
    assert_equal(held_out.seen[1], weights(two))
    assert (dict(os.environ), torch.get_num_threads()) == before
    assert not torch.distributed.is_initialized()
    # What two processes left, one can take up.
    train(resumed, *data, PLAIN, device="cpu", checkpoint=tmp_path, resume=True)
    assert_equal(weights(resumed), weights(two))


@dataclass(frozen=True)
class FailsElsewhere:
    """A loss that only the process of this id can compute."""

    process: int

    def __call__(self, output: Tensor, target: Tensor) -> Tensor:
        if os.getpid() != self.process:
            raise ValueError("no loss here")
        return F.mse_loss(output, target)


@pytest.mark.slow
def test_a_process_that_fails_ends_the_training_with_a_line(data):
    with pytest.raises(InputError, match=r"processes: a training process failed \(ValueError: no loss here\)"):
        train(tiny(), *data, PLAIN, loss=FailsElsewhere(os.getpid()), device="cpu", processes=2)
    assert not torch.distributed.is_initialized()


def test_reports_tell_the_rate(data):
    history = train(tiny(), *data, PLAIN, device="cpu")
    for report in history:
        assert report.images_per_second * report.seconds == pytest.approx(37, rel=0.5)
        assert report.busy is None
        assert report.validation_mae is None


@pytest.mark.parametrize("there", [True, False])
def test_bf16_is_near_float32_and_is_float32_where_it_would_be_emulated(data, monkeypatch, there):
    monkeypatch.setattr(devices, "has_bfloat16", lambda _: there)
    exact, short = (train(tiny(), *data, replace(PLAIN, precision=p), device="cpu") for p in ("float32", "bf16"))
    assert short[-1].loss == pytest.approx(exact[-1].loss, rel=0.05)
    assert (short[-1].loss == exact[-1].loss) != there


def test_busy_time_counts_overlaps_once():
    assert covered([(0, 2), (1, 3), (5, 6), (5.5, 5.6)]) == pytest.approx(4)
    assert covered([]) == 0


def test_the_busy_share_is_of_the_later_half():
    assert busy_share([(0, 0.1), (5, 6), (8, 10)]) == pytest.approx(3 / 5)
    assert busy_share([(4, 6), (9, 10)]) == pytest.approx(1 / 3)
    assert busy_share([(3, 3)]) == 0


def test_a_sample_of_busy_time():
    sample = BusySample(torch.device("cpu"), 1, 2)
    a = torch.randn(200, 200)
    for k in range(5):
        sample.before(k)
        for _ in range(10):
            a = (a @ a).clamp(-1, 1)
    sample.end()
    assert sample.share is not None
    assert 0.3 < sample.share <= 1
    idle = BusySample(torch.device("cpu"), -1)
    idle.before(-1)
    idle.end()
    assert idle.share is None


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("left")
    train(tiny(), *data, PLAIN, device="cpu", checkpoint=folder, identity={"data": "a"})
    return folder


def resume(data, folder: Path, settings: TrainingSettings = PLAIN, network: nn.Module | None = None) -> None:
    train(
        network or tiny(), *data, settings, device="cpu", checkpoint=folder, resume=True, identity={"data": "a"}
    )  # fmt: skip


def with_metadata(folder: Path, into: Path, **changes: str) -> None:
    with safe_open(folder / CHECKPOINT, framework="pt") as stored:
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        told = stored.metadata()
    save_file(tensors, into / CHECKPOINT, metadata=told | changes)


def test_a_checkpoint_of_another_version_is_refused(data, checkpoint, tmp_path: Path):
    with_metadata(checkpoint, tmp_path, format="tapetum-checkpoint/1")
    with pytest.raises(InputError, match=r"checkpoint.*another version.*tapetum-checkpoint/1.*remove the folder"):
        resume(data, tmp_path)


def test_a_checkpoint_of_another_training_is_refused(data, checkpoint):
    with pytest.raises(InputError, match="other settings or other data"):
        resume(data, checkpoint, replace(PLAIN, seed=1))
    with pytest.raises(InputError, match="does not fit the network"):
        resume(data, checkpoint, network=tiny(normalised=False))


@pytest.mark.parametrize("history", ["{", '[{"epoch": 1}]'])
def test_a_checkpoint_with_a_spoilt_history_is_told(data, checkpoint, tmp_path: Path, history: str):
    with_metadata(checkpoint, tmp_path, history=history)
    with pytest.raises(InputError, match="does not fit"):
        resume(data, tmp_path)


def test_half_a_checkpoint_is_told(data, checkpoint, tmp_path: Path):
    whole = (checkpoint / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged checkpoint"):
        resume(data, tmp_path)


def test_quick_epochs_are_written_when_the_training_is_stopped(data, tmp_path: Path, monkeypatch):
    """Not each of them, and none is lost, whether they end in the middle of an epoch or between two."""
    written: list[int] = []
    write = KeptEpoch.__init__.__globals__["_write"]

    def counted(folder: Path, tensors, metadata) -> None:
        write(folder, tensors, metadata)
        written.append(len(json.loads(metadata["history"])))

    monkeypatch.setattr("tapetum.models.checkpoint._write", counted)
    validated: list[nn.Module] = []

    def stopping(network: nn.Module) -> float:
        validated.append(network)
        if len(validated) == 4:
            raise KeyboardInterrupt
        return 1.0

    with pytest.raises(KeyboardInterrupt):
        train(tiny(), *data, VARIED, device="cpu", checkpoint=tmp_path, validate=stopping)
    assert written == [1, 3]
    resumed, whole = tiny(), tiny()
    train(resumed, *data, VARIED, device="cpu", checkpoint=tmp_path, resume=True)
    assert written == [1, 3, 4]
    train(whole, *data, VARIED, device="cpu")
    assert_equal(weights(resumed), weights(whole))


def test_slow_epochs_are_all_written(data, tmp_path: Path, monkeypatch):
    seconds = iter(range(0, 10_000, 11))
    monkeypatch.setattr("tapetum.models.checkpoint.time.monotonic", lambda: next(seconds))
    seen: list[int] = []

    def look(report: EpochReport) -> None:
        seen.append(len(json.loads((tmp_path / HISTORY).read_text(encoding="utf-8"))["epochs"]))

    train(tiny(), *data, VARIED, device="cpu", checkpoint=tmp_path, on_epoch=look)
    assert seen == [1, 2, 3, 4]


def test_the_history_can_be_read(checkpoint):
    told = json.loads((checkpoint / HISTORY).read_text(encoding="utf-8"))
    assert [epoch["epoch"] for epoch in told["epochs"]] == [1, 2]
    assert told["settings"]["batch"] == 8


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"patience": 0}, "patience"),
        ({"precision": "float8"}, "precision"),
        ({"seed": -1}, "seed"),
        ({"batch": 1}, "batch"),
    ],
)
def test_bad_settings_are_told(change, word: str):
    with pytest.raises(InputError, match=word):
        replace(PLAIN, **change)


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ({"device": "moon"}, "no device is called 'moon'"),
        ({"device": "cuda:99"}, "CUDA devices"),
        ({"device": "cpu", "processes": 0}, "processes"),
        ({"device": "cpu", "processes": "many"}, "processes"),
        ({"device": "cpu", "processes": 5}, "fewer than 2 to each of 5"),
    ],
)
def test_what_cannot_compute_is_told(data, how, word: str):
    with pytest.raises(InputError, match=word):
        train(tiny(), *data, PLAIN, **how)


def test_a_training_that_cannot_be_is_told(data):
    with pytest.raises(InputError, match=r"patience: .*frames to watch"):
        train(tiny(), *data, replace(PLAIN, patience=1), device="cpu")
    with pytest.raises(InputError, match="diverged"):
        train(tiny(), data[0] * torch.inf, data[1], PLAIN, device="cpu")
    with pytest.raises(InputError, match="diverged"):
        train(tiny(), *data, PLAIN, validate=lambda network: float("nan"), device="cpu")
