"""ASPIRE-Python on the same frames, in an environment of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import Images, Stack

Array = NDArray[np.float64]

REQUIREMENT = "aspire==0.14.3"
IMAGES = 60
METHODS = ("CLSync3N", "CLSyncVoting")
INPUTS = ("single", "averaged")
"""60 single frames, and 60 means of their neighbours: the class averages that ASPIRE is made for."""
SETTINGS = ((80, 360), (40, 360), (80, 720), (40, 720))
"""Largest image size and n_theta (ASPIRE's default is 360); of each, the best by true error counts."""
QUICK_SETTINGS = ((40, 720),)

_FOLDER = Path(__file__).parent
_ENVIRONMENT = _FOLDER / ".venv-aspire"
_MASK = 0.45  # radius of ASPIRE's mask in edges of the image


@dataclass(frozen=True)
class Aspire:
    """A Python that has ASPIRE."""

    python: Path

    def estimate(
        self, stack: Stack, frames: Images, settings: tuple[tuple[int, int], ...], inputs: tuple[str, ...]
    ) -> tuple[dict[str, list[Array]], str]:
        """Return rotations of the `chosen` frames by ``method/input``, for each setting, and the version."""
        images = {name: image for name, image in _images(stack, frames).items() if name in inputs}
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
            if name != "version":
                found.setdefault(name.rpartition("/")[0], []).append(R)
        return found, str(results["version"])


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
    return np.round(np.linspace(reach, frames - 1 - reach, IMAGES)).astype(np.intp), reach


def _images(stack: Stack, frames: Images) -> dict[str, Images]:
    """Return centred squares about the object of each chosen frame and of the mean of its neighbours."""
    index, reach = chosen(len(frames))
    around = np.arange(-reach, reach + 1)
    windows = [
        np.stack([_centred(stack, frames[i], stack.truth.center[i]) for i in n + around]) for n in index
    ]
    return {
        "single": np.stack([window[reach] for window in windows]).astype(np.float32),
        "averaged": np.stack([window.mean(axis=0) for window in windows]).astype(np.float32),
    }


def _centred(stack: Stack, image: Images, center: Array) -> Array:
    """Move the true centre to the middle pixel by a Fourier shift, which leaves white noise white; crop."""
    height, width = image.shape
    shift = center / stack.pixel_size
    wave1, wave2 = (
        np.exp(2j * np.pi * np.fft.fftfreq(size) * s) for size, s in zip((width, height), shift, strict=True)
    )
    moved = np.fft.ifft2(np.fft.fft2(image) * wave2[:, None] * wave1).real
    half = min(int(np.ceil(stack.radius / stack.pixel_size / _MASK / 2)), width // 2, height // 2)
    rows, columns = slice(height // 2 - half, height // 2 + half), slice(width // 2 - half, width // 2 + half)
    return np.asarray(moved[rows, columns])


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)
