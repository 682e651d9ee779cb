"""Import of foreign data: what a folder holds, what it probably means, and a dataset made of it."""

from __future__ import annotations

import os
from pathlib import Path

from tapetum.data.importing.inventory import Inventory, common_root, look_into
from tapetum.data.importing.mapping import ImportMapping, load_mapping
from tapetum.data.importing.propose import Proposal, propose
from tapetum.data.importing.videos import write_videos
from tapetum.data.importing.write import write_stacks
from tapetum.progress import Progress, quiet

__all__ = [
    "ImportMapping",
    "Inventory",
    "Proposal",
    "common_root",
    "import_dataset",
    "load_mapping",
    "look_into",
    "propose",
]


def import_dataset(
    mapping: ImportMapping,
    root: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> list[str]:
    """Make a dataset from what a mapping describes.

    Images with labels go straight into the dataset. Pairs of videos first become recordings, in the folder
    `NAME-recordings` beside `NAME.zarr`, labelled by the laser in the target's video.

    Parameters
    ----------
    mapping
        What the files mean; see `load_mapping`.
    root
        The folder that the mapping's paths start from.
    out
        The store to write, by convention NAME.zarr.
    progress
        Shown over the images.
    overwrite
        Whether an existing `out` may be replaced.

    Returns
    -------
    list of str
        One line per recording: how its clocks were aligned, and how many frames are labelled.

    Raises
    ------
    InputError
        When a file is missing or damaged, labels do not fit their images, or two clocks cannot be aligned. Nothing is
        written then.
    """
    if mapping.videos:
        return write_videos(mapping, Path(root), Path(out), progress, overwrite)
    write_stacks(mapping, Path(root), out, progress, overwrite)
    return []
