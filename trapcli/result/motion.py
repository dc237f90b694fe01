"""`Motion`: the rigid motion of one stack, measured or true, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Flag(IntFlag):
    """What is wrong with a frame; the bits of ``/motion/quality/flags``."""

    BLANK = 1
    SATURATED = 2
    CLIPPED = 4
    ALPHA_ZERO = 8
    THIRD_ORDER_SILENT = 16
    AMBIGUOUS_PHI = 32
    OUTLIER = 64


FLAG_MEANINGS = {
    Flag.BLANK: "blank",
    Flag.SATURATED: "saturated",
    Flag.CLIPPED: "clipped by the field of view",
    Flag.ALPHA_ZERO: "alpha close to 0: phi is undefined",
    Flag.THIRD_ORDER_SILENT: "omega_3 close to -sigma: the third-order equation says nothing about alpha",
    Flag.AMBIGUOUS_PHI: "ambiguous phi",
    Flag.OUTLIER: "outlier",
}


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The rigid motion of N frames in the geometry and gauge of the result file (see ``docs/formats.md``).

    ``A(t, x) = C₃ + R(t)(x − C₃ + T(t))`` takes lab to object coordinates (``eq:affine``); ``Rᵀ R' x = ω × x`` with
    ``ω = (α cos φ, α sin φ, ω₃)`` (``eqDefOmega``, ``eqDefO_v``). Frames that can't be judged hold NaN. Errors are
    1-σ, NaN where not known.

    Attributes
    ----------
    time, frame:
        ``(N,)`` time [time_unit] and index in the input.
    T, T_errors, center:
        ``(N, 2)`` translation, its error and the centre C₂ of each frame [length_unit]; ``T = C₂(first) − C₂``.
    phi, omega_3, alpha (+ _errors):
        ``(N,)`` [rad], [rad / time_unit], [rad / time_unit].
    R:
        ``(N, 3, 3)`` rotations, 1 at the first frame.
    R_errors:
        ``(N, 3)`` error of R as a rotation vector in lab coordinates [rad].
    valid, flags, residual:
        ``(N,)`` uint8, uint16 (`Flag`), relative misfit of the frame.
    identifiable, verdict:
        Whether the motion can be known from these frames, and why in words.
    time_unit, length_unit:
        ``"s"`` or ``"frame"``; ``"pixel"`` or what the user or the file gave.
    provenance:
        Text by name for ``/motion/process``: program, version, date, command_line, configuration, inputs, …
    """

    time: Array
    frame: NDArray[np.int64]
    T: Array
    center: Array
    phi: Array
    omega_3: Array
    alpha: Array
    R: Array
    T_errors: Array
    phi_errors: Array
    omega_3_errors: Array
    alpha_errors: Array
    R_errors: Array
    valid: NDArray[np.uint8]
    flags: NDArray[np.uint16]
    residual: Array
    identifiable: bool = True
    verdict: str = ""
    time_unit: str = "frame"
    length_unit: str = "pixel"
    provenance: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def omega_1(self) -> Array:
        """``(N,)`` first Cartesian component of ω, α cos φ."""
        return self.alpha * np.cos(self.phi)

    @property
    def omega_2(self) -> Array:
        """``(N,)`` second Cartesian component of ω, α sin φ."""
        return self.alpha * np.sin(self.phi)
