"""Translation in the image plane from the centres: P T = P C₃ − C₂ (``eqRecCenter``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def translation(center: Array) -> Array:
    """Return P T of every frame in the gauge T = 0 at the first frame, C₃ being unknown.

    Parameters
    ----------
    center:
        ``(N, 2)`` centres C₂ [length]; NaN in blank frames.

    Returns
    -------
    ndarray
        ``(N, 2)`` T₁ and T₂ [length]; where the first frame is blank, the first that is not has T = 0.
    """
    seen = np.flatnonzero(np.isfinite(center).all(axis=1))
    origin = center[seen[0]] if len(seen) else np.full(2, np.nan)
    return np.asarray(origin - center)
