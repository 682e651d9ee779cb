"""The whole chain on the virtual bench: film, label, train, track, report."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
import xarray as xr
from numpy.typing import NDArray

from tapetum.bench import Scene, load_scene
from tapetum.data import build_dataset, crop_batch, find_centre, open_dataset
from tapetum.defaults import SEED
from tapetum.errors import InputError
from tapetum.experiments import pretrain
from tapetum.models import Estimator, ResNet18, ZernikeRidge, load_model, pretrained, save_model
from tapetum.progress import Progress, quiet
from tapetum.record import Recording, Session, join, open_recording
from tapetum.record.film import probe_frames, without_second_beam
from tapetum.report.demo_report import (
    DemoReport,
    DemoScores,
    ModelResult,
    SignEvidence,
    Tracking,
    write_demo_report,
)
from tapetum.report.evaluation import Outcome, Subject, gather
from tapetum.report.evaluation.write import samples, subject_of
from tapetum.report.figures import SignRate, fig_gaze_path, save_figure
from tapetum.report.metrics import SIGN_THRESHOLD, sign_right
from tapetum.simulate import sign_dprime
from tapetum.track import read_tracks, track_to_file

__all__ = ["DEMO_SEED", "DemoOutcome", "run_demo"]

DEMO_SEED = SEED
SCENE = pretrain.SCENE
# Columns and rows of gazes, both odd, of the maps of d'.
_MAP = (7, 5)
_SIGN_FRAMES = 120
_SAMPLES = 12
Array = NDArray[np.float64]


@dataclass(frozen=True)
class DemoOutcome:
    """A demo's folder, the report in it, the report's numbers, and the duration of each step."""

    folder: Path
    report: Path
    scores: DemoScores
    seconds: float


@dataclass
class _Stopwatch:
    """Durations of the steps, in order; announces each step as it begins."""

    say: Callable[[str], None]
    rows: list[tuple[str, float]] = field(default_factory=list[tuple[str, float]])

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        self.say(what)
        start = time.monotonic()
        yield
        self.rows.append((what, time.monotonic() - start))


def run_demo(
    out: Path,
    *,
    seconds: float = 60.0,
    seed: int = DEMO_SEED,
    train: bool = False,
    device: str = "auto",
    progress: Progress = quiet,
    say: Callable[[str], None] = lambda _: None,
) -> DemoOutcome:
    """Film, label, train and track on a new recording of the virtual bench, and write the report into the folder `out`.

    A finished recording of the same `seed` and length in `out` is used again. The bundled ResNet-18 predicts the gaze,
    and the seeds it was trained on are refused; with `train`, another is trained on `device` ("auto", "cpu", "cuda" or
    "cuda:1"), and resumes after an interruption. Raises an InputError for a recording too short to split or a full
    disk.
    """
    if seed in (*pretrain.recorded_seeds(), pretrain.FRESH_SEED):
        raise InputError(f"{seed} is one of the bundled model's own", where="seed", remedy="choose another")
    watch = _Stopwatch(say)
    begun = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(SCENE)
    session = Session(seconds, seed=seed)
    with watch.step("Filming and labelling"):
        pretrain.labelled_recording(out / "demo.rec", session, progress=progress)
    recording = open_recording(out / "demo.rec")
    with watch.step("Cutting out the retro-reflections"):
        build_dataset([recording.path], out / "demo.zarr", progress=progress, overwrite=True)
    dataset = open_dataset(out / "demo.zarr")
    with watch.step("Training Zernike + ridge"):
        ridge = ZernikeRidge(target="gaze").fit(dataset.tp.train, progress=progress)
        save_model(ridge, out / "zernike", overwrite=True)
    recipe = pretrain.QUICK if train else pretrain.BUNDLED
    if train:
        with watch.step("Training ResNet-18 (this takes a while; interrupt it as you like, it resumes)"):
            work = out / "training"
            if not pretrain.is_made(work / "model", recipe):
                pretrain.make_pretrained(
                    work,
                    work / "model",
                    recipe=recipe,
                    device=device,
                    progress=progress,
                    on_epoch=lambda e: say(f"  {e}"),
                )
            resnet = load_model(work / "model")
        origin = "trained by this demo on recordings of other seeds"
    else:
        resnet = pretrained(pretrain.NAME)
        origin = "bundled; trained on recordings of other seeds"
    assert isinstance(resnet, ResNet18)
    # The demo films the copy that both were trained on.
    resnet.whose = "own"
    resnet.device = device
    with watch.step("Reading the held-out gaze"):
        models: dict[str, Estimator] = {"ResNet-18": resnet, "Zernike + ridge": ridge}
        outcomes = {name: gather(model, dataset, progress=progress) for name, model in models.items()}
    with watch.step("Tracking the held-out part from whole frames"):
        tracking = _track(recording, resnet, out / "tracks.parquet", progress)
    with watch.step("Asking what the sign rests on"):
        sign = _sign(scene, dataset, models, outcomes, seed)
    seeds_used = ", ".join(map(str, pretrain.recorded_seeds()))
    trained = {
        "ResNet-18": f"{origin} ({seeds_used}) and beside {recipe.copies} copies of the camera",
        "Zernike + ridge": "the paper's protocol, fitted here to the first 80 % "
        f"({dataset.tp.train.sizes['frame']} frames)",
    }
    results = [ModelResult(name, outcome, trained[name]) for name, outcome in outcomes.items()]
    subject = subject_of(resnet, dataset, model_name=pretrain.NAME)
    say("Writing the report")
    content = _content(scene, session, recording, dataset, results, subject, tracking, sign, watch.rows, train)
    scores = write_demo_report(out / "report.html", content)
    _save_picture(out / "gaze-path.png", content)
    return DemoOutcome(out, out / "report.html", scores, time.monotonic() - begun)


def _track(recording: Recording, model: Estimator, file: Path, progress: Progress) -> Tracking:
    source = recording.source("probe")
    first = round(0.8 * len(source))
    held_out = [
        frame for frame in progress(source, "opening the held-out part", total=len(source)) if frame.index >= first
    ]
    track_to_file(held_out, file, model=model, progress=progress)
    rows = read_tracks(file)
    frame, track = (rows[name].to_numpy(zero_copy_only=False).astype(int) for name in ("frame", "track"))
    x, y, seconds, snr = _stacked(rows, "x", "y", "time", "snr").T
    predicted = _stacked(rows, "gaze_x", "gaze_y")
    truth = _stacked(_labelled(recording)[0], "gaze_x", "gaze_y")[frame]
    both = np.isfinite(truth).all(axis=1) & np.isfinite(predicted[:, 0])
    return Tracking(
        frame=held_out[len(held_out) // 2].image,
        track=track,
        x=x,
        y=y,
        time=seconds,
        snr=snr,
        frames=len(held_out),
        truth=truth[both],
        predicted=predicted[both],
        file=file.name,
    )


def _stacked(table: pa.Table, *names: str) -> Array:
    """Return some columns, [N, len(names)]."""
    return np.stack([table[name].to_numpy(zero_copy_only=False) for name in names], -1).astype(float)


def _labelled(recording: Recording) -> tuple[pa.Table, pa.Table]:
    """Return the labels of a recording, and the virtual bench's truth."""
    labels, truth = recording.labels(), recording.truth()
    if labels is None or truth is None:
        raise InputError("lacks labels or truth", where=recording.path, remedy="run the demo again")
    return labels, truth


def _sign(
    scene: Scene, dataset: xr.Dataset, models: dict[str, Estimator], outcomes: dict[str, Outcome], seed: int
) -> SignEvidence:
    """d' over the field with and without the second beam, and the models' predictions without it."""
    ideal = without_second_beam(scene)
    x, y = (np.linspace(-0.45, 0.45, count) for count in _MAP)
    # d' is equal for a gaze and its opposite, so half the field suffices; the centre has no opposite.
    grid = torch.tensor([[a, b] for b in y for a in x], dtype=torch.float64)
    half = len(grid) // 2

    def mapped(one: Scene) -> Array:
        values = sign_dprime(one, grid[:half]).numpy()
        return np.concatenate([values, [0.0], values[::-1]]).reshape(len(y), len(x))

    truth = dataset.tp.test.tp.values(("gaze_x", "gaze_y"))
    rates = [_rate(name, True, *outcome.pair()) for name, outcome in outcomes.items()]
    step = max(1, len(truth) // _SIGN_FRAMES)
    some = truth[::step]
    frames = list(probe_frames(ideal, some, np.zeros_like(some), seed))
    crops = crop_batch(np.stack(frames), np.array([find_centre(frame) for frame in frames]), dataset.tp.side)
    for name, model in models.items():
        told = model.predict(crops, full_scale=dataset.tp.full_scale, anyway=True)
        rates.append(_rate(name, False, some, told.value))
    beam = scene.illumination.second_beam
    words = f"{beam.ratio:.0%} of the first, {1e3 * np.hypot(*beam.angle):.2g} mrad beside it" if beam else ""
    return SignEvidence(x, y, mapped(scene), mapped(ideal), rates, words)


def _rate(name: str, second_beam: bool, truth: Array, predicted: Array) -> SignRate:
    pairs = [sign_right(truth[:, k], predicted[:, k], SIGN_THRESHOLD) for k in range(2)]
    return SignRate(name, second_beam, (pairs[0][0], pairs[1][0]), (pairs[0][1], pairs[1][1]))


def _spots(recording: Recording) -> tuple[Array, Array, Array]:
    """Laser spots at the probe's frames, in target pixels: found, true, and as joined from a perfect detector's."""
    labels, truth = _labelled(recording)
    info = recording.stream("target")
    size = np.array([info.width, info.height], dtype=float)

    def true(stream: str) -> Array:
        rows = truth.filter(np.asarray(truth["stream"]) == stream)
        return (size - 1) / 2 + size * _stacked(rows, "gaze_x", "gaze_y")

    return _stacked(labels, "spot_x", "spot_y"), true("probe"), join(recording).interpolate(true("target"))


def _content(
    scene: Scene,
    session: Session,
    recording: Recording,
    dataset: xr.Dataset,
    results: list[ModelResult],
    subject: Subject,
    tracking: Tracking,
    sign: SignEvidence,
    timings: list[tuple[str, float]],
    train: bool,
) -> DemoReport:
    test, lens = dataset.tp.test, scene.target.lens
    truth = test.tp.values(("gaze_x", "gaze_y"))
    times = np.asarray(test["time"], dtype=float)
    found, true, joined = _spots(recording)
    middle = _nearest_to_centre(truth)
    picture = next(f.image for f in recording.source("target") if f.index >= _target_index(recording, times[middle]))
    chosen = _spread(truth, _SAMPLES)
    rrs, rrs_at = samples(results[0].outcome, dataset)
    sensor = scene.probe.sensor
    counted = dataset.tp.recordings[0]
    stored = sum(file.stat().st_size for file in recording.path.rglob("*") if file.is_file())
    return DemoReport(
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        recording=[
            ("scene", f"{SCENE} (bundled): `tapetum simulate {SCENE} -o rr.png` shows its RR"),
            (
                "target",
                f"thin lens, f = {lens.focal_length * 1e3:g} mm, aperture radius {lens.aperture_radius * 1e3:g} mm, "
                f"focused at {scene.target.object_distance:g} m, held by hand {scene.distance:g} m from the probe",
            ),
            (
                "light",
                f"{scene.illumination.wavelength * 1e9:.0f} nm, {scene.illumination.mode}, "
                f"{scene.illumination.power * 1e6:g} µW, second beam {sign.beam}",
            ),
            (
                "probe",
                f"f = {scene.probe.lens.focal_length * 1e3:g} mm, {sensor.pixels[0]} x {sensor.pixels[1]} pixels of "
                f"{sensor.pitch * 1e6:g} µm, {sensor.bits} bit, {sensor.exposure * 1e6:g} µs",
            ),
            (
                "noise",
                f"shot noise, {sensor.read_noise:g} electrons read noise, {sensor.background:g} electrons of stray "
                "light a pixel",
            ),
            (
                "motion",
                f"gaze over ±{session.motion.extent:g} of the field at {_band(session.motion.sweep_band)}, tremor at "
                f"{_band(session.motion.tremor_band)}, {session.motion.sway * 1e3:g} mm RMS sway",
            ),
            (
                "clocks",
                f"two cameras at {session.rate:g} frames a second, {session.probe_clock.jitter * 1e3:g} ms jitter, "
                f"{session.probe_clock.loss:.1%} of frames lost, "
                f"the target's frames late by {_lag(session)}",
            ),
        ],
        picture=picture,
        models=results,
        subject=subject,
        samples=np.asarray(test["image"][chosen]),
        sample_gaze=truth[chosen],
        path_rrs=rrs,
        path_rrs_at=rrs_at,
        spots_found=found,
        spots_true=true,
        spots_joined=joined,
        sign=sign,
        tracking=tracking,
        timings=timings,
        seeds=[("this recording", session.seed), *[("training recording", s) for s in pretrain.recorded_seeds()]],
        sizes=[
            ("frames filmed", str(counted.get("frames", ""))),
            (
                "frames used",
                f"{dataset.sizes['frame']} ({dataset.tp.train.sizes['frame']} train, {test.sizes['frame']} test)",
            ),
            ("frames left out", ", ".join(f"{v} {k}" for k, v in counted.get("left_out", {}).items())),
            ("recording", f"{stored / 1e6:.1f} MB"),
        ],
        versions=[
            ("tapetum", version("tapetum")),
            ("torch", torch.__version__),
            ("Python", platform.python_version()),
        ],
        limits=[
            "The second beam's strength and angle, the stray light and the exposure are assumptions; the paper gives "
            "none of them.",
            "The bundled ResNet-18 knows this scene only: another lens, distance or probe needs its own training.",
        ],
        files=[
            ("demo.rec", "the recording: two videos, frame times, labels, and the bench's truth"),
            ("demo.zarr", "the dataset: centred crops, labels and split"),
            ("zernike", "the ridge model fitted here"),
            ("tracks.parquet", "a row for each frame and track, with the gaze and its 90 % interval"),
        ],
        next_steps=[
            (
                "tapetum simulate thin-lens --sweep rotation=0,0.5,1 --sweep object_distance=1,2.5,5 -o fig4.png",
                "the paper's Fig. 4",
            ),
            ("tapetum track FOLDER -o tracks.csv", "find the spots in photographs of your own"),
            (
                "tapetum demo --seed 7 -o demo-7" if train else "tapetum demo --train --overwrite",
                "another recording" if train else "train the ResNet-18 before your eyes (about half an hour)",
            ),
        ],
    )


def _lag(session: Session) -> str:
    offset = session.target_clock.offset
    return "a random part of a frame" if offset is None else f"{offset * 1e3:g} ms"


def _band(band: tuple[float, float]) -> str:
    return f"{band[0]:g} to {band[1]:g} Hz"


def _nearest_to_centre(gaze: Array) -> int:
    return int(np.argmin(np.hypot(*gaze.T)))


def _target_index(recording: Recording, seconds: float) -> int:
    utc = recording.utc_ns("target")
    probe = recording.utc_ns("probe")
    return int(np.argmin(np.abs((utc - probe[0]) * 1e-9 - seconds)))


def _spread(gaze: Array, count: int) -> NDArray[np.int_]:
    """Frames with gazes far from each other, from the centre of the field outwards."""
    chosen = [_nearest_to_centre(gaze)]
    while len(chosen) < min(count, len(gaze)):
        away = np.min(np.linalg.norm(gaze[:, None] - gaze[chosen][None], axis=-1), axis=1)
        chosen.append(int(np.argmax(away)))
    return np.array(sorted(chosen, key=lambda i: float(np.hypot(*gaze[i]))))


def _save_picture(path: Path, content: DemoReport) -> None:
    first = content.models[0]
    save_figure(
        fig_gaze_path(
            content.picture,
            *first.outcome.pair(),
            first.outcome.time,
            name=first.name,
            rrs=content.path_rrs,
            rrs_at=content.path_rrs_at,
        ),
        path,
    )
