"""A set in the making: its finished parts, in any order, and their assembly."""

from __future__ import annotations

import json
import shutil
import uuid
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, QUANTITIES, UNIT
from tapetum.data.synth.plan import Part, Plan
from tapetum.data.write import dataset_writer
from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder
from tapetum.futures import in_order
from tapetum.progress import Progress, quiet

__all__ = ["Made", "Staging"]

_PLAN, _DONE = "plan.json", "done"
# Parts that are read before the first of them is needed.
_AHEAD = 2


@dataclass
class Made:
    """A finished part: its crops [side, side], and everything else that the set keeps of it."""

    crops: list[NDArray[Any]] = field(default_factory=list)
    # Labels and places of the crops, by name.
    columns: dict[str, list[float]] = field(default_factory=dict)
    # Frames used and left out, by reason, and the frames of the whole video.
    told: dict[str, Any] = field(default_factory=dict)
    # All that was drawn for the video, with its first part only.
    parameters: dict[str, Any] | None = None

    def add(self, image: NDArray[np.generic], /, **values: float) -> None:
        """Add a crop and its values by name."""
        self.crops.append(image)
        for name, value in values.items():
            self.columns.setdefault(name, []).append(value)


class Staging:
    """The folder `SET.part`, made by `begin`: a plan, and a Parquet file for every finished part, one row per crop.

    Each part has its own file, complete or absent, so any number of workers may write at once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def begin(cls, out: Path, plan: Plan) -> Staging:
        """Begin a set, or continue one that was begun with the same arguments; raise an InputError for another set."""
        # Absolute, because workers may run in other folders.
        path = out.absolute().with_name(f"{out.name}.part")
        if path.exists():
            _check_same(path, plan)
            return cls(path)
        with atomic_folder(path) as folder:
            (folder / _DONE).mkdir()
            (folder / _PLAN).write_text(json.dumps({**plan.as_dict(), "digest": plan.digest}), encoding="utf-8")
        return cls(path)

    @property
    def stands(self) -> bool:
        """Whether its plan is there: the folder may be removed meanwhile."""
        return (self.path / _PLAN).is_file()

    def done(self) -> set[int]:
        """Return the numbers of the parts that are done."""
        return {int(file.stem) for file in (self.path / _DONE).glob("[0-9]*.parquet")}

    def has(self, part: Part) -> bool:
        """Return whether a part is done."""
        return self._file(part).exists()

    def keep(self, part: Part, made: Made) -> None:
        """Write a part's crops and values, which marks it as done; raise an InputError where the folder has gone."""
        if not self.stands:
            remedy = "run the same command again, which starts over"
            raise InputError("has been removed while it was written", where=self.path, remedy=remedy)
        like = made.crops[0] if made.crops else np.empty(0)
        about = {"told": made.told, "parameters": made.parameters, "dtype": like.dtype.str, "shape": like.shape}
        table = pa.table({"crop": pa.array([crop.tobytes() for crop in made.crops], pa.binary()), **made.columns})
        with atomic_file(self._file(part)) as file:
            # The checksums notice a flipped bit when the part is read.
            pq.write_table(
                table.replace_schema_metadata({"about": json.dumps(about)}),
                file,
                compression="zstd",
                use_dictionary=False,
                write_statistics=False,
                write_page_checksum=True,
            )

    def read(self, part: Part) -> Made:
        """Return a part that is done; raise an InputError when it is damaged."""
        file = self._file(part)
        try:
            table = pq.read_table(file, page_checksum_verification=True)
            about = json.loads((table.schema.metadata or {})[b"about"])
            crops = [np.frombuffer(raw.as_buffer(), about["dtype"]).reshape(about["shape"]) for raw in table["crop"]]
            columns: dict[str, Any] = {name: table[name].to_pylist() for name in table.column_names if name != "crop"}
            return Made(crops, columns, about["told"], about["parameters"])
        except FileNotFoundError as error:
            remedy = "run the same command again: it makes the part again"
            raise InputError("has been removed", where=file, remedy=remedy) from error
        except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
            remedy = "remove this file and run the same command again: it makes the part again"
            raise InputError(f"damaged ({error})", where=file, remedy=remedy) from error

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.path)

    def _file(self, part: Part) -> Path:
        return self.path / _DONE / f"{part.number:07d}.parquet"

    def put_together(self, plan: Plan, out: Path, *, progress: Progress = quiet, overwrite: bool = False) -> None:
        """Write the set from its finished parts, in order, like `build_dataset`.

        Raises an InputError when no frame is left to train or to test with, or a part is damaged.
        """
        labels = {"gaze_x", "gaze_y"} | {name for video in plan.videos for name, _ in video.labels}
        names = tuple(name for name in (*QUANTITIES, DEVICE) if name in labels)
        with (
            dataset_writer(out, plan.rules, names, plan.classes, plan.full_scale, overwrite=overwrite) as writer,
            ThreadPoolExecutor(1, "part") as pool,
        ):
            writer.told = [_heading(plan, number) for number in range(len(plan.videos))]
            writer.units = list(plan.units)
            read = in_order((pool.submit(self.read, part) for part in plan.parts), _AHEAD)
            parts = progress(zip(plan.parts, read, strict=True), "putting the set together", total=len(plan.parts))
            for part, made in parts:
                unit = plan.videos[part.video].unit
                own = {} if unit is None else {UNIT: unit}
                for n, crop in enumerate(made.crops):
                    writer.add(crop, **{name: values[n] for name, values in made.columns.items()}, **own)
                _count(writer.told[part.video], made)
            about = {"kind": plan.kind, "size": plan.size, "seed": plan.seed, "plan": plan.digest}
            writer.attributes["synth"] = about


def _check_same(path: Path, plan: Plan) -> None:
    """Refuse to continue a set that was begun with other arguments."""
    try:
        begun = json.loads((path / _PLAN).read_text(encoding="utf-8"))
        digest, words = begun["digest"], [(name, begun[name]) for name in ("kind", "size", "seed")]
    except (OSError, ValueError, KeyError, TypeError) as error:
        remedy = "choose another name or remove it yourself"
        raise InputError("is no set that was begun", where=path, remedy=remedy) from error
    for name, was in words:
        if was != (now := getattr(plan, name)):
            remedy = "give the same arguments to carry on, or remove the folder to start over"
            raise InputError(f"was begun with {name} {was}, not {now}", where=path, remedy=remedy)
    if digest != plan.digest:
        what = "was begun with other scenes or another version of Tapetum"
        raise InputError(what, where=path, remedy="remove the folder to start over")


def _heading(plan: Plan, number: int) -> dict[str, Any]:
    """Return a video's entry before it is filmed."""
    video = plan.videos[number]
    # From the plan alone, so that the same command gives the same set to the last byte.
    own = uuid.uuid5(uuid.NAMESPACE_URL, f"tapetum:{plan.digest}:{number}")
    head = {"name": video.name, "uuid": str(own), "frames": 0, "used": 0, "left_out": {}}
    own = {} if video.unit is None else {UNIT: plan.units[video.unit]}
    return {**head, "seed": video.session.seed, "labels": dict(video.labels), **own}


def _count(told: dict[str, Any], made: Made) -> None:
    """Add the counts of one part to its video's entry."""
    told["frames"] = made.told["frames"]
    told["used"] += made.told["used"]
    for why, count in made.told["left_out"].items():
        told["left_out"][why] = told["left_out"].get(why, 0) + count
    if made.parameters is not None:
        told["parameters"] = made.parameters
