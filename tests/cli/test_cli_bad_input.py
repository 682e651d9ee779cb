"""Input that cannot be used: one line that says what, where and what to do; exit code 2; nothing written."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tapetum.bench import load_scene
from tapetum.record import Session, film, label_recording
from tapetum.record.recording import open_recording
from tapetum.record.video import VideoWriter
from tapetum.track.tables import detections_schema, read_table

SCENE = """\
schema: tapetum/scene/1
distance: 5 m
target:
  lens: {focal_length: 100 mm, aperture_radius: 3 mm}
  object_distance: 5 m
probe:
  lens: {focal_length: 200 mm, aperture_radius: 25 mm}
  sensor: {pixels: [32, 32]}
"""


def files(folder: Path) -> dict[str, bytes]:
    """Everything in a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("command", ["simulate", "record"])
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("distance: 5 m\nt", "distanse: 5 m\nt", "distanse: unknown key; did you mean distance?"),
        ("aperture_radius: 3", "aperture: 3", "target.lens.aperture: unknown key; did you mean target.lens."),
        ("radius: 3 mm", "radius: 3 kg", "target.lens.aperture_radius: '3 kg' has the wrong dimension; give it in m"),
        ("radius: 3 mm", "radius: -3 mm", "aperture_radius: '-3 mm' is out of range; give more than 0"),
        (
            "object_distance: 5 m",
            "object_distance: 5 cm",
            "object_distance 0.05 m is not beyond the focal length 0.1 m",
        ),
        ("distance: 5 m\nt", "distance: 5 m\ndistance: 6 m\nt", "key 'distance' twice"),
        ("scene/1", "scene/9", "has schema 'tapetum/scene/9'; begin it with"),
        ("probe:", "probe", "is no YAML"),
    ],
    ids=[
        "unknown key",
        "unknown key inside",
        "wrong unit",
        "negative aperture",
        "too near",
        "twice",
        "newer",
        "no YAML",
    ],
)
def test_scene(run, tmp_path: Path, command: str, old: str, new: str, words: str) -> None:
    assert old in SCENE
    scene = tmp_path / "bench.yaml"
    scene.write_text(SCENE.replace(old, new))
    ran = run(command, scene, "-o", tmp_path / ("x.npy" if command == "simulate" else "x.rec"))
    assert ran.code == 2
    assert ran.complaint.startswith(f"error: {scene}: ") and words in ran.complaint
    assert ran.out == "" and list(tmp_path.iterdir()) == [scene]


def test_the_scene_of_these_tests_is_good(run, tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text(SCENE)
    assert run("simulate", tmp_path / "bench.yaml", "-o", tmp_path / "x.npy").code == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("sampling.pupil=16", "sampling.pupil: 16 samples over the pupil would alias; use at least"),
        ("sampling.sensor=8", "sampling.sensor: 8 samples have no meaning without a mask"),
        ("sampling.pupil=8", "sampling.pupil: 8 samples over the pupil would alias"),
        ("target.lens.aperture_radius=-3 mm", "aperture_radius: '-3 mm' is out of range"),
        ("apperture=3", "apperture: a scene has no such field"),
        ("distance", "--set: 'distance' is no change; write KEY=VALUE"),
    ],
)
@pytest.mark.parametrize("command", ["simulate", "record"])
def test_a_change_by_hand(run, tmp_path: Path, command: str, change: str, words: str) -> None:
    out = tmp_path / ("x.npy" if command == "simulate" else "x.rec")
    ran = run(command, "thin-lens", "--set", change, "-o", out)
    assert ran.code == 2 and words in ran.complaint
    assert not list(tmp_path.iterdir())


def test_no_such_scene(run, tmp_path: Path) -> None:
    ran = run("simulate", "thick-lens", "-o", tmp_path / "x.npy")
    assert ran.code == 2 and "focusing, hand-held, phones, rotation, thin-lens" in ran.complaint


def test_a_length_that_is_no_number(run, tmp_path: Path) -> None:
    ran = run("record", "hand-held", "-o", tmp_path / "x.rec", "--seconds", "inf")
    assert ran.code == 2 and "--seconds" in ran.complaint


def test_track_an_empty_folder(run, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    ran = run("track", tmp_path / "empty", "-o", tmp_path / "t.csv")
    assert ran.code == 2 and f"{tmp_path / 'empty'}: the folder holds no images; put" in ran.complaint
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_track_nothing(run, tmp_path: Path) -> None:
    ran = run("track", tmp_path / "gone.mkv", "-o", tmp_path / "t.csv")
    assert ran.code == 2 and "gone.mkv" in ran.complaint
    ran = run("track", tmp_path, "-o", tmp_path / "t.txt")
    assert ran.code == 2 and ".parquet, .csv, .jsonl" in ran.complaint
    ran = run("track", tmp_path, "-o", tmp_path / "t.csv", "--detections", tmp_path / "t.csv")
    assert ran.code == 2 and "--detections" in ran.complaint
    assert not list(tmp_path.iterdir())


def test_detections_take_no_options_of_frames(run, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    image = np.zeros((48, 64), np.uint8)
    image[20:25, 30:35] = 200
    for n in range(3):
        cv2.imwrite(str(frames / f"{n}.png"), image)
    kept = tmp_path / "d.csv"
    assert run("track", frames, "-o", tmp_path / "t.csv", "--detections", kept).code == 0
    out = tmp_path / "again.csv"
    for extra in (["--min-snr", "1000"], ["--seconds", "0.1"], ["--ghost", "none.yaml"], ["--device", "bogus"]):
        ran = run("track", kept, "-o", out, *extra)
        assert ran.code == 2 and f"{kept}: holds detections, not frames: {extra[0]}" in ran.complaint
    ran = run("track", kept, "-o", out, "--json")
    assert ran.code == 0 and json.loads(ran.out)["rows"] == 3


def test_a_video_of_an_unknown_kind(run, tmp_path: Path) -> None:
    import av

    video = tmp_path / "probe.avi"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("mpeg4", rate=15)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode(None))
    video.write_bytes(video.read_bytes().replace(b"FMP4", b"zzz1"))
    ran = run("track", video, "-o", tmp_path / "t.csv")
    assert ran.code == 2 and str(video) in ran.complaint and "cannot be decoded" in ran.complaint


def test_an_address_is_no_path(run, tmp_path: Path) -> None:
    """Its slashes were joined, so that no camera of a network could be tracked, and its password was printed."""
    ran = run("track", "rtsp://user:secret@127.0.0.1:9/x", "-o", tmp_path / "t.csv")
    assert ran.code == 2 and "rtsp://127.0.0.1:9/x: cannot be watched" in ran.complaint
    assert "secret" not in ran.complaint


def test_track_a_truncated_video(run, tmp_path: Path) -> None:
    video, rng = tmp_path / "probe.mkv", np.random.default_rng(0)
    with VideoWriter(video, (60, 80)) as writer:
        for _ in range(20):
            writer.write(rng.integers(0, 60, (60, 80), dtype=np.uint8))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    ran = run("track", video, "-o", tmp_path / "t.parquet", "--detections", tmp_path / "d.csv")
    assert ran.code == 2 and str(video) in ran.complaint
    # Every readable frame was used: what was written of it is kept, and the message says where.
    left = tmp_path / "d.unfinished.csv"
    assert sorted(tmp_path.iterdir()) == [left, video] and str(left) in ran.complaint
    assert 5 <= len(read_table(left, detections_schema())) < 20


def test_a_dataset_of_a_truncated_video(run, chain, tmp_path: Path) -> None:
    recording = tmp_path / "cut.rec"
    shutil.copytree(chain.recording, recording)
    video = recording / "probe.mkv"
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    ran = run("dataset", "build", recording, "-o", tmp_path / "s.zarr")
    assert ran.code == 2 and "probe.mkv" in ran.complaint
    assert list(tmp_path.iterdir()) == [recording]


def little_scene():
    changes = ("probe.sensor.pixels=[160, 120]", "target.sensor.pixels=[162, 122]", "target.sensor.pitch=35.2um")
    return load_scene("hand-held", changes)


def test_a_target_video_without_the_laser(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command films the laser always: here somebody covers it."""

    def covered(scene, out, session, **how):
        return film(scene, out, Session(session.seconds, session.rate, session.seed, laser=False), **how)

    monkeypatch.setattr("tapetum.record.film", covered)
    scene = tmp_path / "bench.yaml"
    from tapetum.bench import scene_yaml

    scene.write_text(scene_yaml(little_scene()))
    ran = run("record", scene, "-o", tmp_path / "a.rec", "--seconds", 1)
    # Progress of what went well stands above the complaint.
    assert ran.code == 2
    complaint = ran.err.splitlines()[-1]
    assert "target.mkv: no laser spot found" in complaint and "aim the laser" in complaint
    recording = open_recording(tmp_path / "a.rec")
    assert recording.finished and recording.labels() is None
    assert "Traceback" not in ran.err and not list(tmp_path.rglob("*.part*"))
    ran = run("dataset", "build", tmp_path / "a.rec", "-o", tmp_path / "s.zarr")
    # The dataset wants labels, looks for them once more, and says why there are none.
    assert ran.code == 2 and "no laser spot found" in ran.err and not (tmp_path / "s.zarr").exists()


def test_clocks_that_do_not_overlap(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bench's own clocks do always: here the target's is set an hour late before the labels are made."""

    def late(recording, progress):
        import pyarrow as pa
        import pyarrow.compute as pc
        import pyarrow.parquet as pq

        path = recording.path / "frames.parquet"
        table = pq.read_table(path)
        hour = pc.add(table["utc"], pa.scalar(3600 * 10**9, pa.duration("ns")))
        utc = pc.if_else(pc.equal(table["stream"], "target"), hour, table["utc"])
        pq.write_table(table.set_column(table.schema.get_field_index("utc"), "utc", utc), path)
        return label_recording(open_recording(recording.path), progress)

    monkeypatch.setattr("tapetum.record.label_recording", late)
    arguments = ["--set", "probe.sensor.pixels=[64, 48]", "--set", "target.sensor.pixels=[162, 122]"]
    ran = run("record", "hand-held", "-o", tmp_path / "a.rec", "--seconds", 0.5, *arguments)
    assert ran.code == 2
    complaint = ran.err.splitlines()[-1]
    assert "the clocks of probe and target do not overlap" in complaint and "one clock" in complaint
    assert open_recording(tmp_path / "a.rec").labels() is None


@pytest.mark.parametrize("lost", ["model.json", "weights.safetensors"])
@pytest.mark.parametrize("command", ["track", "evaluate"])
def test_a_model_that_lacks_a_file(run, chain, tmp_path: Path, command: str, lost: str) -> None:
    model, out = tmp_path / "m", tmp_path / "out"
    shutil.copytree(chain.model, model)
    (model / lost).unlink()
    before = files(tmp_path)
    arguments = {
        "track": ("track", chain.recording, "--model", model, "-o", out.with_suffix(".csv")),
        "evaluate": ("evaluate", model, chain.dataset, "-o", out.with_suffix(".json")),
    }[command]
    ran = run(*arguments)
    assert ran.code == 2 and f"{model}: the model lacks {lost}" in ran.complaint
    assert files(tmp_path) == before


@pytest.mark.parametrize("command", ["track", "evaluate"])
@pytest.mark.parametrize("change", ["weights", "card", "newer", "foreign"])
def test_a_model_that_was_altered(run, chain, tmp_path: Path, command: str, change: str) -> None:
    model, out = tmp_path / "m", tmp_path / "out"
    shutil.copytree(chain.model, model)
    card, weights = model / "model.json", model / "weights.safetensors"
    if change == "weights":
        data = bytearray(weights.read_bytes())
        data[-5] ^= 1
        weights.write_bytes(data)
        words = "weights.safetensors: has been altered"
    elif change == "card":
        card.write_text(card.read_text()[:-20])
        words = "model.json: cannot be read"
    else:
        told = json.loads(card.read_text())
        told |= {"version": 99} if change == "newer" else {"format": "other"}
        card.write_text(json.dumps(told))
        words = "update Tapetum" if change == "newer" else "is not the card of a model"
    before = files(tmp_path)
    arguments = {
        "track": ("track", chain.recording, "--model", model, "-o", out.with_suffix(".csv")),
        "evaluate": ("evaluate", model, chain.dataset, "-o", out.with_suffix(".json")),
    }[command]
    ran = run(*arguments)
    assert ran.code == 2 and words in ran.complaint
    assert files(tmp_path) == before


def test_no_such_model(run, chain, tmp_path: Path) -> None:
    ran = run("track", chain.recording, "--model", "my-model", "-o", tmp_path / "t.csv")
    assert ran.code == 2 and "my-model: is neither a model's folder or .onnx file nor" in ran.complaint
    ran = run("track", chain.recording, "--model", tmp_path / "m", "-o", tmp_path / "t.csv")
    assert ran.code == 2 and "tapetum train" in ran.complaint


@pytest.mark.parametrize("command", ["info", "train", "evaluate"])
def test_no_such_dataset(run, chain, tmp_path: Path, command: str) -> None:
    gone = tmp_path / "gone.zarr"
    arguments = {
        "info": ("dataset", "info", gone),
        "train": ("train", gone, "-o", tmp_path / "m"),
        "evaluate": ("evaluate", chain.model, gone),
    }[command]
    ran = run(*arguments)
    assert ran.code == 2 and str(gone) in ran.complaint
    assert not list(tmp_path.iterdir())


def test_training_that_makes_no_sense(run, chain, tmp_path: Path) -> None:
    for arguments, words in (
        (("--model", "forest"), "use one of zernike, resnet18"),
        (("--target", "weather"), "weather"),
        (("--resume",), "--resume: has no meaning for zernike"),
        (("--epochs", 3), "--epochs: has no meaning for zernike"),
        (("--interpolate",), "--interpolate: has no meaning for zernike"),
        (("--model", "resnet18", "--no-intervals", "--interpolate"), "--interpolate: needs frames kept aside"),
        (("--tuned", "--model", "resnet18"), "--tuned: has no meaning for resnet18"),
        (("--target", "device"), "a linear model of quantities does not recognise devices"),
        (("--target", "device", "--model", "resnet18"), "has no label 'device'"),
        (("--model", "resnet18", "--crop", 500), "looks at 500 pixels, the crops have 400"),
        (("--model", "resnet18", "--processes", "some"), "--processes: must be a number or auto"),
        (("--model", "resnet18", "--device", "cuda:99"), "CUDA devices"),
    ):
        ran = run("train", chain.dataset, "-o", tmp_path / "m", *arguments)
        assert ran.code == 2 and words in ran.complaint
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["simulate", "record", "build", "train", "track", "evaluate"])
def test_an_output_below_a_file(run, chain, tmp_path: Path, command: str) -> None:
    (tmp_path / "file").write_text("dear")
    out = tmp_path / "file" / "below" / "x"
    arguments = {
        "simulate": ("simulate", "thin-lens", "--set", "probe.sensor.pixels=[32, 32]", "-o", f"{out}.npy"),
        "record": ("record", "hand-held", "--seconds", 0.2, "-o", f"{out}.rec"),
        "build": ("dataset", "build", chain.recording, "-o", f"{out}.zarr"),
        "train": ("train", chain.dataset, "-o", out),
        "track": ("track", chain.recording, "-o", f"{out}.csv"),
        "evaluate": ("evaluate", chain.model, chain.dataset, "-o", f"{out}.json"),
    }[command]
    ran = run(*arguments)
    assert ran.code == 2
    complaint = ran.err.splitlines()[-1]
    assert f"{tmp_path / 'file'} is a file, not a folder" in complaint
    assert files(tmp_path) == {"file": b"dear"}


def test_what_is_read_is_never_written(run, tmp_path: Path) -> None:
    picture, scene = tmp_path / "lit.png", tmp_path / "bench.png"
    cv2.imwrite(str(picture), np.full((64, 64), 20, np.uint8))
    scene.write_text(SCENE)
    before = files(tmp_path)
    for words in (
        ("detect", picture, "-o", tmp_path / "found.csv", "--picture", picture, "--overwrite"),
        ("simulate", scene, "-o", scene, "--overwrite"),
    ):
        ran = run(*words)
        assert ran.code == 2 and ran.complaint.endswith("is what is read; name another file to write")
    same = run("detect", picture, "--dark", picture, "-o", tmp_path / "found.csv")
    assert same.code == 2 and "--dark: is LIT itself" in same.complaint
    table = run("detect", picture, "-o", tmp_path / "x.png", "--picture", tmp_path / "x.png")
    assert table.code == 2 and "--picture: is the table too" in table.complaint
    assert files(tmp_path) == before


def test_a_file_where_a_folder_belongs_and_the_reverse(run, tmp_path: Path) -> None:
    (tmp_path / "model").write_text("no model")
    ran = run("track", tmp_path, "--model", tmp_path / "model", "-o", tmp_path / "x.csv")
    assert ran.code == 2 and "model: is a file, and a model is a folder" in ran.complaint
    ran = run("simulate", tmp_path, "-o", tmp_path / "x.npy")
    assert ran.code == 2 and "is a folder; give the path of a YAML file" in ran.complaint


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_an_output_that_cannot_be_written() -> None:
    with Path("/dev/full").open("w") as full:
        ran = subprocess.run(
            [sys.executable, "-m", "tapetum", "--help"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ran.returncode == 2, ran.stderr
    assert ran.stderr.startswith("error: standard output: cannot be written (No space left")
    assert len(ran.stderr.splitlines()) == 1


def test_ctrl_c_while_the_command_line_imports() -> None:
    """The interruption comes from within the import, at a moment that does not depend on the machine."""
    code = """
import sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "tapetum.cli.plan":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from tapetum.__main__ import main
sys.exit(main())
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (130, "interrupted\n")
