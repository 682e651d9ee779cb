"""The report of an evaluation: a folder with a self-contained page, the numbers, and the figures."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.crop import crop
from tapetum.files import atomic_folder
from tapetum.models import Predictor
from tapetum.models.architectures import ARCHITECTURES
from tapetum.progress import Progress, quiet
from tapetum.report import html
from tapetum.report.evaluation.outcome import Outcome
from tapetum.report.evaluation.pictures import Picture, path_section, pictures
from tapetum.report.evaluation.scores import score, score_classes
from tapetum.report.evaluation.sections import devices, parts
from tapetum.report.figures import figure_png

__all__ = ["FORMAT", "NUMBERS", "PAGE", "More", "Subject", "page_body", "samples", "subject_of", "write_evaluation"]

FORMAT, VERSION = "tapetum-evaluation", 1
PAGE, NUMBERS = "report.html", "numbers.json"
_NAMES = {"zernike": "Zernike + ridge", "simulation": "Fit by simulation"}
_NAMES |= {name: network.title for name, network in ARCHITECTURES.items()}
_SAMPLE_SIDE = 200


@dataclass(frozen=True)
class Subject:
    """What was evaluated.

    Parameters
    ----------
    name
        The model's usual name.
    model, data
        (name, value) rows on the model and the dataset.
    command
        Command that reproduces the report.
    """

    name: str
    model: Sequence[tuple[str, str]] = ()
    data: Sequence[tuple[str, str]] = ()
    command: str = ""
    card: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class More:
    """What a page shows beyond the evaluation of one model.

    Parameters
    ----------
    others
        Outcomes of other models on the same frames, by the models' usual names.
    training
        (name, what it was trained on) of each model.
    numbers
        (value, what it is): further main numbers.
    pictures
        Further figures; one of the same name replaces the evaluation's own.
    sections
        Further sections, after the figures.
    limits
        Further limitations, one sentence each.
    """

    others: Mapping[str, Outcome] = field(default_factory=dict)
    training: Sequence[tuple[str, str]] = ()
    numbers: Sequence[tuple[str, str]] = ()
    pictures: Sequence[Picture] = ()
    sections: html.Html = field(default_factory=html.Html)
    limits: Sequence[str] = ()


_NOTHING = More()


def subject_of(
    model: Predictor, dataset: xr.Dataset, *, model_name: str = "", card: Mapping[str, Any] | None = None
) -> Subject:
    """Describe model and dataset; `model_name` is the folder or name the model was loaded by."""
    kind = _NAMES.get(model.kind, model.kind)
    # Models of earlier versions name the former hash of the whole set, which its store still holds.
    own = {dataset.tp.train.tp.hash, dataset.attrs.get("sha256")}
    if model.data_hash_ is None:
        learned = "not known"
    elif model.data_hash_ in own:
        learned = "the training part of this dataset"
    else:
        learned = f"another dataset, SHA-256 {model.data_hash_[:16]}…"
    settings = ", ".join(f"{key} {value}" for key, value in model.parameters().items() if key != "target")
    facts = [
        ("kind", kind),
        *([("name", model_name)] if model_name else []),
        ("estimates", ", ".join(model.target_names)),
        ("learned from", learned),
        ("settings", settings),
    ]
    told = dict(card or {})
    notes = told.get("notes")
    if notes:
        words = notes if isinstance(notes, str) else ", ".join(f"{key}: {value}" for key, value in notes.items())
        facts.append(("notes", words))
    chosen = (told.get("training") or {}).get("chosen") or {}
    if chosen:
        facts.append(("chosen", "; ".join(f"{key}: {why}" for key, why in chosen.items())))
    versions = told.get("versions")
    if isinstance(versions, Mapping):
        facts.append(("made with", ", ".join(f"{key} {value}" for key, value in versions.items())))
    return Subject(kind, facts, _data_facts(dataset), card=told)


def _data_facts(dataset: xr.Dataset) -> list[tuple[str, str]]:
    test, train = (int(one.sizes["frame"]) for one in (dataset.tp.test, dataset.tp.train))
    facts = [
        ("dataset", str(dataset.encoding.get("source", "in memory"))),
        ("frames", f"{test} to test, {train} to train"),
        ("recordings", str(len(np.unique(dataset["recording"].values)))),
        ("crops", f"{dataset.tp.side} × {dataset.tp.side} pixels, full scale {dataset.tp.full_scale:g}"),
        ("labels", ", ".join(dataset.tp.targets) or "not named"),
    ]
    synth = dataset.attrs.get("synth")
    if isinstance(synth, Mapping):
        made = f"tapetum dataset synth {synth.get('kind')} --size {synth.get('size')} --seed {synth.get('seed')}"
        facts.append(("filmed by", f"the virtual bench: `{made}`"))
    facts.append(("SHA-256", dataset.tp.hash))
    return facts


def samples(outcome: Outcome, dataset: xr.Dataset, count: int = 3) -> tuple[list[NDArray[np.generic]], list[int]]:
    """Return some RRs of the path's section, from the highest gaze to the lowest, and their places in the outcome."""
    if not outcome.has_gaze:
        return [], []
    begin, end = path_section(outcome)
    order = begin + np.argsort(outcome.truth["gaze_y"][begin:end], kind="stable")
    chosen = sorted({int(order[k]) for k in np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int)})
    chosen.sort(key=lambda frame: outcome.truth["gaze_y"][frame])
    test = dataset.tp.test
    side = min(_SAMPLE_SIDE, test.tp.side)
    middle = ((test.tp.side - 1) / 2, (test.tp.side - 1) / 2)
    return [crop(np.asarray(test["image"].isel(frame=frame).values), middle, side) for frame in chosen], chosen


def write_evaluation(
    out: Path,
    outcome: Outcome,
    subject: Subject,
    *,
    rrs: Sequence[NDArray[np.generic]] = (),
    rrs_at: Sequence[int] = (),
    overwrite: bool = False,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Write the report of an evaluation into a folder, whole or not at all, and return its numbers.

    Parameters
    ----------
    out
        The folder: report.html, numbers.json, and every figure as a PNG.
    outcome, subject
        What is reported.
    rrs, rrs_at
        RRs [h, w] beside the path of the gaze, and their frames.
    overwrite
        Replace a folder that holds an evaluation.
    progress
        Shown over the figures.

    Raises
    ------
    InputError
        When the folder exists and may not be replaced, or cannot be written.
    """
    numbers = {"format": FORMAT, "version": VERSION, **_heading(outcome, subject), **score(outcome)}
    drawn: list[tuple[Picture, bytes]] = []
    with atomic_folder(out, FORMAT, overwrite=overwrite) as folder:
        for picture in progress(pictures(outcome, subject.name, rrs, rrs_at), "drawing the figures"):
            data = figure_png(picture.figure)
            (folder / f"{picture.name}.png").write_bytes(data)
            drawn.append((picture, data))
        text = json.dumps(numbers, indent=1, allow_nan=False) + "\n"
        (folder / NUMBERS).write_text(text, encoding="utf-8")
        (folder / PAGE).write_text(_page(outcome, subject, numbers, drawn), encoding="utf-8")
    return numbers


def _heading(outcome: Outcome, subject: Subject) -> dict[str, Any]:
    return {"model": dict(subject.model), "dataset": {"name": outcome.dataset, **dict(subject.data)}}


def _page(outcome: Outcome, subject: Subject, numbers: dict[str, Any], drawn: list[tuple[Picture, bytes]]) -> str:
    body = page_body(outcome, subject, numbers, drawn)
    kind = "Simulation: the virtual bench filmed these frames. " if outcome.simulated else ""
    made = f"Made by `{subject.command}`. " if subject.command else ""
    return html.page(
        f"{subject.name} on {outcome.dataset}",
        body,
        subtitle=f"{kind}The model's predictions for {len(outcome)} frames that were not used in training.",
        contents=html.headings(body),
        footer=f"{made}The numbers are in `{NUMBERS}`, the figures beside this page as PNG. This file is "
        "self-contained and makes no network requests.",
    )


def page_body(
    outcome: Outcome,
    subject: Subject,
    numbers: Mapping[str, Any],
    drawn: Sequence[tuple[Picture, bytes]],
    more: More = _NOTHING,
) -> html.Html:
    """Return the body of an evaluation's page, from its numbers (`score`) and its figures as PNG."""
    shown: defaultdict[str, list[html.Html]] = defaultdict(list)
    for one, data in drawn:
        # The figures are rendered already; show them at their design size.
        width = round(one.figure.get_figwidth() * 96)
        shown[one.section].append(html.figure(data, alt=one.alt, caption=one.caption, width=width))
    return html.render(
        "evaluation.html",
        outcome=outcome,
        subject=subject,
        scores=numbers,
        name=subject.name,
        pictures=shown,
        classes=score_classes(outcome),
        devices=devices(outcome),
        parts=parts(outcome),
        more=more,
        others={name: score(other) for name, other in more.others.items()},
    )
