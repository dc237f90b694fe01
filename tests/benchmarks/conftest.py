"""The benchmarks are programs: their modules are found beside each other."""

from __future__ import annotations

import sys
from pathlib import Path

for folder in ("accuracy", "speed"):
    sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / folder))
