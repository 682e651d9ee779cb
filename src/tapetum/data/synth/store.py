"""A set that is being made: its parts as they are done, in any order, and the whole put together at the end."""

from __future__ import annotations

import json
import shutil
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from tapetum.data.content import image_digests
from tapetum.data.dataset import DEVICE, QUANTITIES
from tapetum.data.synth.plan import PIECE, Part, Plan
from tapetum.data.synth.work import Made
from tapetum.data.write import CHUNK, dataset_writer, make_array
from tapetum.durable import sync
from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder, told_when_full
from tapetum.progress import Progress, quiet

__all__ = ["Staging"]

_PLAN, _CROPS, _DONE = "plan.json", "crops", "done"


class Staging:
    """The folder `SET.part`: a plan, a region of crops for every part, and a file for every part that is done.

    Parts never share a chunk of the store, so any number of workers may write at once. A part counts as done when
    its file is there, which is written last and is whole or absent.

    Parameters
    ----------
    path
        The folder, made by `begin`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def begin(cls, out: Path, plan: Plan) -> Staging:
        """Begin a set, or carry one on that was begun with the same arguments.

        Raises
        ------
        InputError
            When what was begun is another set.
        """
        # Workers may stand in other folders.
        path = out.absolute().with_name(f"{out.name}.part")
        if path.exists():
            _check_same(path, plan)
            return cls(path)
        dtype = np.dtype(np.uint8 if plan.full_scale <= 255 else np.uint16)
        side, told = plan.rules.side, {**plan.as_dict(), "digest": plan.digest}
        with atomic_folder(path) as folder:
            (folder / _DONE).mkdir()
            (folder / _PLAN).write_text(json.dumps(told), encoding="utf-8")
            group = zarr.create_group(str(folder / _CROPS), zarr_format=3)
            shape = (len(plan.parts) * PIECE, side, side)
            make_array(group, "image", shape, (CHUNK, side, side), dtype, ("frame", "y", "x"))
        return cls(path)

    def done(self) -> set[int]:
        """Return the numbers of the parts that are done."""
        return {int(file.stem) for file in (self.path / _DONE).glob("[0-9]*.json")}

    def has(self, part: Part) -> bool:
        """Return whether a part is done."""
        return self._file(part).exists()

    def keep(self, part: Part, made: Made) -> None:
        """Write a part's crops to its region, then mark it as done.

        Raises
        ------
        InputError
            When the disk is full.
        """
        with told_when_full(self.path):
            if made.crops:
                # Whole chunks: one that is written in part would be read first.
                room = np.zeros((-len(made.crops) % CHUNK, *made.crops[0].shape), made.crops[0].dtype)
                block = np.concatenate([np.stack(made.crops), room])
                start = part.number * PIECE
                self._images("r+")[start : start + len(block)] = block
                for number in range(start // CHUNK, (start + len(block)) // CHUNK):
                    sync(self.path / _CROPS / "image" / "c" / str(number) / "0" / "0")
            with atomic_file(self._file(part)) as file:
                digests = [digest.tobytes().hex() for digest in image_digests(made.crops)]
                rest = {"columns": made.columns, "told": made.told, "parameters": made.parameters, "digests": digests}
                file.write_text(json.dumps(rest), encoding="utf-8")

    def read(self, part: Part) -> Made:
        """Return a part that is done.

        Raises
        ------
        InputError
            When it is damaged.
        """
        file = self._file(part)
        try:
            made = Made(**json.loads(file.read_text(encoding="utf-8")))
            count, start = int(made.told["used"]), part.number * PIECE
            made.crops = list(np.asarray(self._images("r")[start : start + count])) if count else []
        except (ValueError, KeyError, TypeError, OSError, RuntimeError) as error:
            remedy = "remove this file and run the same command again"
            raise InputError(f"damaged ({error})", where=file, remedy=remedy) from error
        # Zarr reads a chunk that is not there as black crops, without a word.
        found = [digest.tobytes().hex() for digest in image_digests(made.crops)]
        if made.digests is not None and found != made.digests:
            lost = sum(one != other for one, other in zip(found, made.digests, strict=False))
            remedy = "remove this file and run the same command again: it regenerates the part"
            raise InputError(f"{lost} of its {count} crops are lost or damaged", where=file, remedy=remedy)
        return made

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.path)

    def _file(self, part: Part) -> Path:
        return self.path / _DONE / f"{part.number:07d}.json"

    def _images(self, mode: Any) -> Any:
        return zarr.open_group(str(self.path / _CROPS), mode=mode, zarr_format=3)["image"]

    def put_together(self, plan: Plan, out: Path, *, progress: Progress = quiet, overwrite: bool = False) -> None:
        """Write the set, all parts of which are done, in their order: a dataset as `build_dataset` writes it.

        Raises
        ------
        InputError
            When nothing, or nothing for one of the two splits, was kept, or a part is damaged.
        """
        names = _labels(plan)
        with dataset_writer(out, plan.rules, names, plan.classes, plan.full_scale, overwrite=overwrite) as writer:
            writer.told = [_heading(plan, number) for number in range(len(plan.videos))]
            for part in progress(plan.parts, "putting the set together", total=len(plan.parts)):
                made = self.read(part)
                for n, crop in enumerate(made.crops):
                    writer.add(crop, **{name: values[n] for name, values in made.columns.items()})
                _count(writer.told[part.video], made)
            writer.attributes["synth"] = {
                "kind": plan.kind,
                "size": plan.size,
                "seed": plan.seed,
                "plan": plan.digest,
            }


def _check_same(path: Path, plan: Plan) -> None:
    """Refuse to carry on what was begun with other arguments."""
    remedy = "give the same arguments to carry on, or remove the folder to start over"
    try:
        begun = json.loads((path / _PLAN).read_text(encoding="utf-8"))
        digest = begun["digest"]
        words = [(name, begun[name], getattr(plan, name)) for name in ("kind", "size", "seed")]
    except (OSError, ValueError, KeyError, TypeError) as error:
        remedy = "choose another name or remove it yourself"
        raise InputError("is no set that was begun", where=path, remedy=remedy) from error
    other = next((f"{name} {was}, not {now}" for name, was, now in words if was != now), None)
    if other is not None:
        raise InputError(f"was begun with {other}", where=path, remedy=remedy)
    if digest != plan.digest:
        what = "was begun with other scenes or another version of Tapetum"
        raise InputError(what, where=path, remedy="remove the folder to start over")


def _labels(plan: Plan) -> tuple[str, ...]:
    constant = {name for video in plan.videos for name, _ in video.labels}
    return tuple(name for name in (*QUANTITIES, DEVICE) if name in {"gaze_x", "gaze_y"} | constant)


def _heading(plan: Plan, number: int) -> dict[str, Any]:
    """All that is known of a video beforehand."""
    video = plan.videos[number]
    # Made of the plan alone, so that the same command gives the same set to the last byte.
    own = uuid.uuid5(uuid.NAMESPACE_URL, f"tapetum:{plan.digest}:{number}")
    head = {"name": video.name, "uuid": str(own), "frames": 0, "used": 0, "left_out": {}}
    return {**head, "seed": video.session.seed, "labels": dict(video.labels)}


def _count(told: dict[str, Any], made: Made) -> None:
    """Add what became of one part to what is reported of its video."""
    told["frames"] = made.told["frames"]
    told["used"] += made.told["used"]
    for why, count in made.told["left_out"].items():
        told["left_out"][why] = told["left_out"].get(why, 0) + count
    if made.parameters is not None:
        told["parameters"] = made.parameters
