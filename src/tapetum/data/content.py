"""What a dataset's hash is made of: a digest of every image, and everything else that a model could learn from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["DIGEST", "DIGEST_BYTES", "hash_of", "image_digests"]

DIGEST = "image_digest"
"""Variable of a stored set: BLAKE2b of every image, so that a part of the set is hashed without reading its images."""

DIGEST_BYTES = 16
_DOMAIN = b"tapetum-dataset-content/2\n"


def image_digests(images: Iterable[NDArray[np.generic]]) -> NDArray[np.uint8]:
    """Return the BLAKE2b digests [N, 16] of images: of each one's type, shape and pixels."""
    found = b""
    for image in map(np.ascontiguousarray, images):
        # The type and shape are the key, so that equal bytes of another shape differ.
        key = f"{image.dtype.str}{image.shape}".encode()
        found += hashlib.blake2b(image.data, digest_size=DIGEST_BYTES, key=key).digest()
    return np.frombuffer(found, np.uint8).reshape(-1, DIGEST_BYTES)


def hash_of(
    digests: NDArray[np.uint8],
    variables: Mapping[str, NDArray[np.generic]],
    *,
    full_scale: float,
    targets: Sequence[str],
    classes: Sequence[str],
) -> str:
    """Return the SHA-256 of a dataset's content, in hexadecimal.

    It is made of the images' digests [N, 16] in order, all variables [N] along ``frame``, the camera's largest count,
    the names of the labels among the variables, and the names of the numbers in `device`.
    """
    digest = hashlib.sha256(_DOMAIN)
    digest.update(np.ascontiguousarray(digests).tobytes())
    for name in sorted(variables):
        digest.update(f"{name}:{variables[name].dtype.str}:{len(variables[name])}\n".encode())
        digest.update(np.ascontiguousarray(variables[name]).tobytes())
    about = {"full_scale": float(full_scale), "targets": list(targets), "classes": list(classes)}
    digest.update(json.dumps(about, sort_keys=True).encode())
    return digest.hexdigest()
