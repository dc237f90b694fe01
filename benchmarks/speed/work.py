"""One piece of work on one stack, in a process of its own so that its memory can be told.

python work.py yardstick|front-end|literal FILE [--background FILE] [--threads N] [--frames N]

Prints the seconds per frame, without starting Python.
"""

from __future__ import annotations

import argparse
import time as clock

import numpy as np
import scipy.fft
from literal import Literal
from threadpoolctl import threadpool_limits

from trapcli.config import PreprocessConfig
from trapcli.motion.front_end import read_front_end
from trapcli.preprocess.attenuation import to_attenuation
from trapcli.stack import open_stack
from trapcli.stack.frames import Frames


def yardstick(frames: Frames, threads: int) -> None:
    """Read and transform every frame."""
    for block in frames.blocks():
        for image in block:
            scipy.fft.rfft2(image.astype(np.float32), workers=threads)


def front_end(frames: Frames, background: str) -> None:
    """Do all that the joint estimate does with frames."""
    config = PreprocessConfig(attenuation=not background, background=background or "none")
    with threadpool_limits(1, user_api="blas"):
        read_front_end(
            to_attenuation(frames, config),
            time=np.arange(len(frames), dtype=float),
            pixel_size=1.0,
            line_band=8.0,
            fine_band=16.0,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("yardstick", "front-end", "literal"))
    parser.add_argument("file")
    parser.add_argument("--background", default="")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", default="", help="START:STOP")
    options = parser.parse_args()
    from trapcli.config import InputConfig

    start = clock.perf_counter()
    frames = open_stack(options.file, InputConfig(frames=options.frames))
    if options.what == "yardstick":
        yardstick(frames, options.threads)
    elif options.what == "front-end":
        front_end(frames, options.background)
    else:
        Literal(frames, options.threads).motion()
    print((clock.perf_counter() - start) / len(frames))


if __name__ == "__main__":
    main()
