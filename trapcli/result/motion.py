"""`Motion`: the rigid motion of one stack, measured or true, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag
from pathlib import Path

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


@dataclass(frozen=True)
class Landscape:
    """The paper's function Φ (section Numerics), least at the direction φ of ω in the image plane.

    Attributes
    ----------
    phi:
        ``(L,)`` angles in [0, π) [rad].
    frame:
        ``(K,)`` index in the input of the frames where Φ was kept.
    values:
        ``(K, L)`` Φ, dimensionless.
    """

    phi: Array
    frame: NDArray[np.int64]
    values: Array


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The rigid motion of N frames in the geometry and gauge of the result file (see ``docs/formats.md``).

    ``A(t, x) = C₃ + R(t)(x − C₃ + T(t))`` takes lab to object coordinates (``eq:affine``);
    ``Rᵀ R' x = ω × x`` with ``ω = (α cos φ, α sin φ, ω₃)`` (``eqDefOmega``, ``eqDefO_v``; Elbau et al. 2020,
    Inverse Problems 36). Frames that can't be judged hold NaN. Errors are 1-σ, NaN where not known.

    Attributes
    ----------
    time, frame:
        ``(N,)`` time [time_unit] and index in the input.
    T, T_errors, center:
        ``(N, 2)`` translation, its error and the centre C₂ of each frame [length_unit];
        ``T = C₂(first) − C₂``.
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
        (see `trapcli.result.provenance.collect`).
    landscape:
        Φ at a few frames, where the method computes it.
    truth:
        The motion of a simulation, known exactly: its file holds no quality.
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
    landscape: Landscape | None = None
    truth: bool = False

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

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the result file (HDF5); an existing file stays as it is until the new one is complete.

        Raises
        ------
        OutputError
            Where the file exists and `overwrite` is false, or can't be written.
        """
        from trapcli.result import hdf5

        hdf5.save(self, Path(path), overwrite=overwrite)

    @classmethod
    def load(cls, path: Path | str) -> Motion:
        """Read a result or truth file (HDF5).

        Raises
        ------
        InputError
            Where the file is missing, damaged, incomplete or not a result of trap-motion.
        """
        from trapcli.result import hdf5

        return hdf5.load(Path(path))
