"""trap-motion: the rigid motion of a trapped particle from its video.

The pipeline, as in the workflow figure of Elbau et al. 2020 (Inverse Problems 36):

    frames       a video stack, read block by block                    trapcli.stack
    attenuation  J = −log(I / I₀)                                      trapcli.preprocess
    centres      C₂ of every frame, and with it the translation T      trapcli.motion.centers, translation
    reduced map  J̃, Fourier transforms about the centres               trapcli.motion.reduced_map
    v, ω₃        first time derivative of the common-line equation     trapcli.motion.first_order
    α            its third derivative                                  trapcli.motion.third_order
    R            ω integrated on SO(3)                                 trapcli.motion.integrate
    Motion       all of it, with errors, flags, units and provenance   trapcli.result

and with the motion the object itself, by `reconstruct`                trapcli.reconstruction

>>> import trapcli
>>> frames, truth = trapcli.simulate(stack={"frames": 50, "height": 64, "width": 64, "pixel_size": 0.4})
>>> motion = trapcli.estimate(frames, attenuation=True, frame_interval=0.0025, method="paper")
>>> trapcli.compare(motion, truth).errors["R"].max < 0.1  # degrees
True
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trapcli.pipeline import estimate as estimate
    from trapcli.reconstruction.volume import reconstruct as reconstruct
    from trapcli.result.comparison import compare as compare
    from trapcli.result.motion import Motion as Motion
    from trapcli.simulation.render import simulate as simulate

_PUBLIC = {
    "Motion": "trapcli.result.motion",
    "compare": "trapcli.result.comparison",
    "estimate": "trapcli.pipeline",
    "reconstruct": "trapcli.reconstruction.volume",
    "simulate": "trapcli.simulation.render",
}

__all__ = ["Motion", "compare", "estimate", "reconstruct", "simulate"]


def __getattr__(name: str) -> Any:
    # imported on first use, so that `trap-motion --help` doesn't wait for NumPy
    if name not in _PUBLIC:
        raise AttributeError(f"module 'trapcli' has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
