"""Hash of a dataset's content: a digest of every image, and all labels and names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["DIGEST", "DIGEST_BYTES", "hash_of", "image_digests"]

DIGEST = "image_digest"
"""Variable of a stored set: BLAKE2b of every image, so that parts can be hashed without reading images."""

DIGEST_BYTES = 16
_DOMAIN = b"tapetum-dataset-content/2\n"


def image_digests(images: Iterable[NDArray[np.generic]]) -> NDArray[np.uint8]:
    """Return the BLAKE2b digests [N, 16] of images, which cover type, shape and pixels."""
    found = b""
    for image in map(np.ascontiguousarray, images):
        # With type and shape as the key, equal bytes of another shape differ.
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
    """Return the SHA-256, in hexadecimal, of image digests [N, 16], all variables [N] along ``frame``, and the rest."""
    digest = hashlib.sha256(_DOMAIN)
    digest.update(np.ascontiguousarray(digests).tobytes())
    for name in sorted(variables):
        digest.update(f"{name}:{variables[name].dtype.str}:{len(variables[name])}\n".encode())
        digest.update(np.ascontiguousarray(variables[name]).tobytes())
    about = {"full_scale": float(full_scale), "targets": list(targets), "classes": list(classes)}
    digest.update(json.dumps(about, sort_keys=True).encode())
    return digest.hexdigest()
