"""Sets, models and predictions for the paper's section 5: made once, kept in a folder, resumed if interrupted."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xarray as xr

from tapetum.data import open_dataset
from tapetum.data.synth import Plan, make_plan, synthesise
from tapetum.data.synth.plan import SEED
from tapetum.errors import InputError
from tapetum.experiments.recordings import development_plan, varied_plan
from tapetum.experiments.sizes import DEFAULT
from tapetum.models import EpochReport, NetworkEstimator, ResNet18, ZernikeRidge, load_model, model_card, save_model
from tapetum.models.base import json_safe
from tapetum.models.training import remove_checkpoint
from tapetum.progress import Progress, quiet
from tapetum.report.evaluation import Outcome, gather

__all__ = ["RECIPES", "SET_SEED", "Recipe", "Workshop", "plan_of"]

SET_SEED = SEED
"""Seed of the sets; like the networks' seeds, 0, fixed before any measurement."""

Model = ZernikeRidge | NetworkEstimator


@dataclass(frozen=True)
class Recipe:
    """A model that the paper's section 5, or an experiment beyond it, needs.

    Parameters
    ----------
    name, title
        Of its folder, and in figures and tables.
    set, without
        The training set, and devices whose frames are left out of it.
    make
        Returns the unfitted model for a size of the sets.
    reason
        How its settings were chosen, for its card: by training recordings alone, or by which other data. By size where
        that differs.
    """

    name: str
    set: str
    title: str
    make: Callable[[str], Model]
    without: tuple[str, ...] = ()
    reason: str | Mapping[str, str] = "the paper's settings: nothing was chosen"

    def reason_at(self, size: str) -> str:
        """Reason for its settings at a size of the sets."""
        return self.reason if isinstance(self.reason, str) else self.reason[size]


_ASIDE = "by the error on frames kept aside of the training part"
_SMOKE = "to take little time: a smoke test"
_GAZE = {
    "paper": f"epochs, crop and size {_ASIDE}; gain and centring after looking at the development recordings",
    "laptop": "size for two cores; epochs and the videos' length after a training of 20 epochs on videos of 20 s: its "
    "error on frames kept aside still fell (0.021 of the field at last), and its test error, 0.033, had been seen as "
    "well; crop, gain and centring as at size paper",
    "small": _SMOKE,
}
_VARIED = {**_GAZE, "laptop": "epochs and size for two cores, before anything was trained at this size"}
_FOCUS = {
    "paper": f"epochs and size {_ASIDE}; the crop by the RR's width",
    "laptop": "epochs, batch and size for two cores, before anything was trained at this size; the crop by the RR's "
    "width",
    "small": _SMOKE,
}
_PHONE = {
    "paper": f"epochs and size {_ASIDE}, the same that set the intervals: their coverage is a best case",
    "laptop": f"epochs, batch and size for two cores, tried on four of the phones, {_ASIDE}",
    "small": _SMOKE,
}
_CV = "the penalty by cross-validation on the training part; standardised beforehand"


@dataclass(frozen=True)
class Effort:
    """Side of the input images in pixels, epochs, and batch size of a network."""

    edge: int
    epochs: int
    batch: int = 32


# Few frames need small batches for enough steps.
EFFORTS: dict[str, dict[str, Effort]] = {
    "gaze": {"paper": Effort(72, 60), "laptop": Effort(48, 30), "small": Effort(72, 4)},
    "varied": {"paper": Effort(80, 40), "laptop": Effort(64, 20), "small": Effort(80, 4)},
    "focus": {"paper": Effort(80, 20), "laptop": Effort(64, 10, 16), "small": Effort(80, 4)},
    "phone": {"paper": Effort(200, 48), "laptop": Effort(80, 20, 16), "small": Effort(100, 4)},
    "device": {"paper": Effort(200, 24), "laptop": Effort(80, 10, 16), "small": Effort(100, 4)},
}
"""Training settings of the networks, by target and by size."""


# Side of the crop, in pixels. The RR of the Rotation set is 124 pixels wide, its second image 43 pixels beside it, and
# at 3 m it is half as wide again. At 135 mm and 3 m the RR fills the crop for the focus. A phone's RRs are spread over
# the crop; a ring of one is 6 pixels wide, and its fine structure identifies the phone.
_CROPS = {"gaze": 144, "varied": 200, "focus": 400, "phone": 400, "device": 400}


def _network(kind: str, **settings: Any) -> Callable[[str], Model]:
    """Return a function that makes a network for a size of the sets."""
    target = "gaze" if kind == "varied" else kind
    if target == "gaze":
        settings["gain"] = 0.3

    def make(size: str) -> Model:
        effort = EFFORTS[kind][size]
        image = {"crop": _CROPS[kind], "size": effort.edge}
        return ResNet18(target, epochs=effort.epochs, batch=effort.batch, **image, **settings)

    return make


def _ridge(target: str, *, tuned: bool = False) -> Callable[[str], Model]:
    chosen: dict[str, Any] = {"alpha": "cv", "standardise": True, "calibration_fraction": 0.1} if tuned else {}
    return lambda _: ZernikeRidge(target, **chosen)


PAPER, TUNED, RESNET = "Zernike + ridge", "Zernike + ridge, tuned", "ResNet-18"
HIDDEN, VARIED = "ResNet-18 without its brightest spot", "ResNet-18, varied recordings"
HELD_OUT = "ResNet-18, devices held out"
UNSEEN = ("phone-03", "phone-07", "phone-10")
"""Devices withheld from the model that is tested for "none of these"."""

_ALL = (
    Recipe("rotation-zernike", "rotation", PAPER, _ridge("gaze")),
    Recipe("rotation-zernike-tuned", "rotation", TUNED, _ridge("gaze", tuned=True), reason=_CV),
    Recipe("rotation-resnet18", "rotation", RESNET, _network("gaze"), reason=_GAZE),
    Recipe("rotation-resnet18-hidden", "rotation", HIDDEN, _network("gaze", hide=16), reason=_GAZE),
    Recipe("rotation-resnet18-varied", "varied", VARIED, _network("varied"), reason=_VARIED),
    Recipe("focusing-zernike", "focusing", PAPER, _ridge("focus")),
    Recipe("focusing-zernike-tuned", "focusing", TUNED, _ridge("focus", tuned=True), reason=_CV),
    Recipe("focusing-resnet18", "focusing", RESNET, _network("focus"), reason=_FOCUS),
    Recipe("phones-resnet18", "phones", RESNET, _network("phone"), reason=_PHONE),
    Recipe("phones-resnet18-unseen", "phones", HELD_OUT, _network("device"), UNSEEN, _PHONE),
)
RECIPES = {recipe.name: recipe for recipe in _ALL}


@dataclass
class Workshop:
    """Sets and models of the paper's section 5, made on first use.

    Parameters
    ----------
    folder
        Keeps sets and models: complete ones are used again, interrupted ones resumed.
    size
        Of the sets and networks: `laptop`, `paper`, or `small`, a smoke test.
    workers, cluster
        Number of processes that film (None for this one alone), or the address of a Dask scheduler to film instead.
    device
        Where networks are trained and run: "auto", "cpu", "cuda" or "cuda:1".
    sets
        Datasets to use in place of synthesised ones, by the name of the set.
    progress, on_epoch
        Progress callbacks.
    """

    folder: Path
    size: str = DEFAULT
    workers: int | None = None
    sets: Mapping[str, xr.Dataset] = field(default_factory=dict)
    progress: Progress = quiet
    on_epoch: Callable[[EpochReport], None] | None = None
    cluster: str | None = None
    device: str = "auto"
    _outcomes: dict[str, Outcome] = field(default_factory=dict, init=False)

    def dataset(self, name: str) -> xr.Dataset:
        """Return a set, filming it first where it is not there."""
        if name in self.sets:
            return self.sets[name]
        plan = plan_of(name, self.size)
        # A set of another plan (scene, recipe or version) is neither used nor removed.
        path = self.folder / f"{name}-{self.size}-{plan.digest[:8]}.zarr"
        plain = self.folder / f"{name}-{self.size}.zarr"
        if not path.exists() and plain.exists() and _planned(plain) == plan.digest:
            return open_dataset(plain)
        if not path.exists():
            synthesise(plan, path, processes=self.workers, cluster=self.cluster, progress=self.progress)
        dataset = open_dataset(path)
        if _planned(path) != plan.digest:
            remedy = "remove it, or give another folder"
            raise InputError("is a set of another plan than its name says", where=path, remedy=remedy)
        return dataset

    def model(self, name: str) -> Model:
        """Return a fitted model, trained first if needed; refuses a name that is none of `RECIPES`."""
        if name not in RECIPES:
            raise InputError(f"no model is called {name!r}", remedy=f"there are: {', '.join(RECIPES)}")
        recipe = RECIPES[name]
        dataset = self._without(self.dataset(recipe.set), recipe.without)
        wanted = recipe.make(self.size)
        # Named by recipe and content, so a model of other data or parameters is neither used nor overwritten.
        folder = self.folder / f"{name}-{self.size}-{_key(wanted, dataset)[:8]}"
        if folder.exists():
            if not _is(folder, wanted, dataset):
                remedy = "remove it, or give another folder"
                raise InputError("is another model than its name says", where=folder, remedy=remedy)
            found = load_model(folder)
            if isinstance(found, NetworkEstimator):
                found.device = self.device
            return found
        checkpoint = folder.with_name(f"{folder.name}.checkpoint")
        start = time.monotonic()
        if isinstance(wanted, NetworkEstimator):
            wanted.device = self.device
            wanted.fit(dataset, progress=self.progress, checkpoint=checkpoint, resume=True, on_epoch=self.on_epoch)
        else:
            wanted.fit(dataset, progress=self.progress)
        notes = {"made for": "tapetum paper", "seconds": round(time.monotonic() - start), "without": recipe.without}
        assert wanted.training_ is not None
        wanted.training_["chosen"]["settings"] = recipe.reason_at(self.size)
        save_model(wanted, folder, notes=notes)
        remove_checkpoint(checkpoint)
        return wanted

    def outcome(self, name: str) -> Outcome:
        """Return a model's predictions for its set's test part, withheld devices included."""
        if name not in self._outcomes:
            model = self.model(name)
            self._outcomes[name] = gather(model, self.dataset(RECIPES[name].set), progress=self.progress)
        return self._outcomes[name]

    @staticmethod
    def _without(dataset: xr.Dataset, devices: tuple[str, ...]) -> xr.Dataset:
        if not devices:
            return dataset
        left = [k for k, name in enumerate(dataset.tp.classes) if name not in devices]
        return dataset.isel(frame=dataset["device"].isin(left).values.nonzero()[0])


def plan_of(name: str, size: str) -> Plan:
    """Return the plan of one of the paper's sets or of the further recordings."""
    beside = {"development": development_plan, "varied": varied_plan}
    return beside[name](size) if name in beside else make_plan(name, size, SET_SEED)


def _planned(path: Path) -> str | None:
    """Return the digest of the plan that a stored set was filmed by."""
    synth = open_dataset(path).attrs.get("synth")
    return synth.get("plan") if isinstance(synth, Mapping) else None


def _key(wanted: Model, dataset: xr.Dataset) -> str:
    """Return a model's name: a hash of its kind, its parameters and its training data."""
    about = [wanted.kind, json_safe(wanted.parameters(), "parameters"), dataset.tp.train.tp.hash]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def _is(folder: Path, wanted: Model, dataset: xr.Dataset) -> bool:
    """Whether the model in a folder has this recipe and these training frames."""
    card = model_card(folder)
    parameters, learned = json_safe(wanted.parameters(), "parameters"), dataset.tp.train.tp.hash
    return card["kind"] == wanted.kind and card["parameters"] == parameters and card["training_data"] == learned
