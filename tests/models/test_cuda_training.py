"""Training on a GPU, whose steps are recorded and replayed, against plain steps. Skipped where there is no GPU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tapetum.models.augmentation import Augmentation
from tapetum.models.steps import RecordedStep, Step
from tapetum.models.training import EpochReport, TrainingSettings, train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")

# 61 images make steps of 8 and of 9.
SETTINGS = TrainingSettings(epochs=4, batch=8, learning_rate=1e-2, augmentation=Augmentation())


def network() -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        layers = [nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Conv2d(4, 6, 3), nn.BatchNorm2d(6)]
        return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(6, 2)).double()


@pytest.fixture(scope="module")
def data() -> tuple[Tensor, Tensor]:
    """In double precision: sums in another order then change nothing that can be seen."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(61, 1, 12, 12, generator=generator).double()
    return images, torch.stack([images.mean((1, 2, 3)), images.amax((1, 2, 3))], dim=1)


def trained(data: tuple[Tensor, Tensor], settings: TrainingSettings = SETTINGS, **options) -> dict[str, Tensor]:
    one = network()
    train(one, *data, settings, device="cuda", **options)
    return {name: value.cpu() for name, value in one.state_dict().items()}


def close(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> bool:
    return all(
        torch.allclose(ours[name].double(), value.double(), rtol=1e-7, atol=1e-9) for name, value in theirs.items()
    )


def test_recorded_steps_do_what_plain_ones_do(data, monkeypatch):
    recorded: list[int] = []
    as_it_is = RecordedStep._recorded

    def counted(self: RecordedStep, chosen: Tensor, share: float):
        recorded.append(len(chosen))
        return as_it_is(self, chosen, share)

    monkeypatch.setattr(RecordedStep, "_recorded", counted)
    ours = trained(data)
    assert sorted(recorded) == [8, 9]
    monkeypatch.setattr("tapetum.models.training.RecordedStep", Step)
    plain = trained(data)
    assert close(ours, plain)
    assert not close(ours, trained(data, replace(SETTINGS, learning_rate=0.99e-2)))
    assert not close(ours, trained(data, replace(SETTINGS, seed=1)))


def test_a_stopped_training_goes_on_as_if_it_had_not_been(data, tmp_path: Path):
    class KilledError(Exception):
        pass

    def kill(report: EpochReport) -> None:
        if report.epoch == 2:
            raise KilledError

    with pytest.raises(KilledError):
        trained(data, checkpoint=tmp_path, on_epoch=kill)
    resumed = trained(data, checkpoint=tmp_path, resume=True)
    assert close(resumed, trained(data))
