"""ASPIRE-Python on the same frames, in an environment of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Images = NDArray[np.floating[Any]]

REQUIREMENT = "aspire==0.14.3"
IMAGES = 60
METHODS = ("CLSync3N", "CLSyncVoting")
INPUTS = ("single", "averaged")
"""60 single frames, and 60 means of their neighbours: the class averages that ASPIRE is made for."""
SETTINGS = ((80, 360), (40, 720))
"""Largest image size and n_theta (ASPIRE's default is 360); the better one by true error counts."""

_FOLDER = Path(__file__).parent
_ENVIRONMENT = _FOLDER / ".venv-aspire"
_MASK = 0.45  # radius of ASPIRE's mask in edges of the image


@dataclass(frozen=True)
class Aspire:
    """A Python that has ASPIRE."""

    python: Path

    def rotations(
        self, images: dict[str, Images], settings: tuple[tuple[int, int], ...] = SETTINGS
    ) -> dict[str, list[Array]]:
        """Return rotations by ``method/name`` for named stacks of centred images, for each setting.

        Raises
        ------
        RuntimeError
            Where ASPIRE fails on all.
        """
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "images.npz", Path(folder) / "rotations.npz"
            np.savez(source, settings=np.array(settings), **images)  # type: ignore[arg-type]
            command = [str(self.python), str(_FOLDER / "aspire_rotations.py"), str(source), str(target)]
            # it writes logs into the working directory and a configuration folder into the home
            environment = {**os.environ, "ASPIREDIR": folder}
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(f"ASPIRE failed:\n{done.stderr[-2000:]}")
            results = dict(np.load(target))
        found: dict[str, list[Array]] = {}
        for name, R in results.items():
            found.setdefault(name.rpartition("/")[0], []).append(R)
        return found


def install() -> Aspire | str:
    """Return ASPIRE, installed into its own environment where that is needed, or why there is none."""
    python = _ENVIRONMENT / ("Scripts" if os.name == "nt" else "bin") / "python"
    try:
        if not python.exists():
            print(f"installing {REQUIREMENT} into {_ENVIRONMENT}", file=sys.stderr)
            _run([sys.executable, "-m", "venv", str(_ENVIRONMENT)])
        probe = [str(python), "-c", "from importlib.metadata import version; print(version('aspire'))"]
        if subprocess.run(probe, capture_output=True, text=True).stdout.strip() != REQUIREMENT.split("==")[1]:
            _run([str(python), "-m", "pip", "install", "--quiet", REQUIREMENT])
    except (OSError, subprocess.CalledProcessError) as error:
        last = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
        return f"{REQUIREMENT} could not be installed: {last}"
    return Aspire(python)


def chosen(frames: int) -> tuple[NDArray[np.intp], int]:
    """Return the 60 evenly spaced frames, and how many neighbours on each side are averaged with them."""
    reach = max((frames // IMAGES - 1) // 2, 0)
    return np.round(np.linspace(reach, frames - 1 - reach, min(IMAGES, frames))).astype(np.intp), reach


def squares(frames: Images, center: Array, pixel_size: float, radius: float) -> dict[str, Images]:
    """Return centred squares about the object: of single frames, and of means of their neighbours.

    Parameters
    ----------
    frames:
        ``(N, H, W)`` attenuation.
    center:
        ``(N, 2)`` true centres [length].
    radius:
        Of the object [length].
    """
    index, reach = chosen(len(frames))
    half = min(int(np.ceil(radius / pixel_size / _MASK / 2)), frames.shape[1] // 2, frames.shape[2] // 2)
    windows = np.array(
        [
            [_centred(frames[i], center[i] / pixel_size, half) for i in range(n - reach, n + reach + 1)]
            for n in index
        ],
        np.float32,
    )
    return {"single": windows[:, reach], "averaged": windows.mean(axis=1)}


def _centred(image: Images, shift: Array, half: int) -> Array:
    """Move the true centre to the middle pixel by a Fourier shift, which leaves white noise white; crop."""
    height, width = image.shape
    wave1, wave2 = (
        np.exp(2j * np.pi * np.fft.fftfreq(size) * s) for size, s in zip((width, height), shift, strict=True)
    )
    moved = np.fft.ifft2(np.fft.fft2(image) * wave2[:, None] * wave1).real
    rows, columns = slice(height // 2 - half, height // 2 + half), slice(width // 2 - half, width // 2 + half)
    return np.asarray(moved[rows, columns])


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)
