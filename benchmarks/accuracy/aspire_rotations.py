"""Rotations by ASPIRE-Python, run inside an environment where it is installed.

python aspire_rotations.py INPUT.npz OUTPUT.npz

INPUT holds stacks ``(N, L, L)`` of centred images by name and ``settings`` ``(S, 2)``: largest image size
and n_theta. OUTPUT holds ``(N, 3, 3)`` rotations, lab to object, named ``method/stack/setting``, without what
ASPIRE fails on.
"""

from __future__ import annotations

import logging
import sys

import numpy as np
from aspire.abinitio import CLSync3N, CLSyncVoting
from aspire.source import ArrayImageSource


def rotations(images: np.ndarray, size: int, n_theta: int) -> dict[str, np.ndarray]:
    """Run both methods on the same common lines; all that is not set here is ASPIRE's default."""
    source = ArrayImageSource(images.astype(np.float32), pixel_size=1.0)
    if size < images.shape[1]:
        source = source.downsample(size)
    # the images are centred exactly: no shift is searched
    sync = CLSync3N(source, n_theta=n_theta, max_shift=0, seed=0)
    voting = CLSyncVoting(source, n_theta=n_theta, max_shift=0)
    voting.clmatrix = sync.clmatrix
    found = {}
    for method in (sync, voting):
        try:
            R = np.asarray(method.rotations, float)
        except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
            print(f"{type(method).__name__}: {error}", file=sys.stderr)
            continue
        if np.isfinite(R).all():
            found[type(method).__name__] = R
    return found


def main() -> None:
    logging.disable(logging.WARNING)
    arrays = dict(np.load(sys.argv[1]))
    settings = arrays.pop("settings")
    results = {}
    for name, images in arrays.items():
        for number, (size, n_theta) in enumerate(settings):
            for method, R in rotations(images, int(size), int(n_theta)).items():
                results[f"{method}/{name}/{number}"] = R
    np.savez(sys.argv[2], **results)


if __name__ == "__main__":
    main()
