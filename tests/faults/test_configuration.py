"""Configuration files that would hang or crash the parser of the standard library: our own errors, soon."""

from __future__ import annotations

import contextlib
import os
import random
import time
from pathlib import Path

import pytest

from trapcli.config import EstimateConfig, from_dict, load_toml, to_toml
from trapcli.errors import ConfigError

SEED = os.environ.get("FUZZ_SEED", "0")
VARIANTS = int(os.environ.get("FUZZ_VARIANTS", "300"))

HOSTILE = {
    "dotted keys": ".".join("a" * 20_000) + " = 1",
    "brackets": "a = " + "[" * 5000,
    "closed brackets": "a = " + "[" * 5000 + "]" * 5000,
    "tables": "[" + ".".join("a" * 20_000) + "]",
    "digits": "a = " + "9" * 6000,
    "large": "# " + "x" * (64 << 10),
    "inline tables": "a = " + "{a = " * 2000 + "1" + "}" * 2000,
    "not text": "\udcff",
    "nul": "a = \0",
    "twice": "a = 1\na = 2",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "config.toml"
    path.write_bytes(HOSTILE[kind].encode(errors="surrogateescape"))
    started = time.process_time()
    with pytest.raises(ConfigError) as caught:
        from_dict(EstimateConfig, load_toml(path), str(path))
    assert time.process_time() - started < 1
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message


def test_an_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text("[motion]\nmethd = 'paper'\n")
    with pytest.raises(ConfigError, match="unknown key 'methd'; did you mean 'method'"):
        from_dict(EstimateConfig, load_toml(path), str(path))


def test_only_our_own_errors_escape(tmp_path: Path) -> None:
    whole = to_toml(EstimateConfig()).encode()
    path = tmp_path / "config.toml"
    chance = random.Random(SEED)
    for _ in range(VARIANTS):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 3, 20))):
            data[chance.randrange(len(data))] = chance.choice((*b"[].=\"'{}\n0", chance.randrange(256)))
        path.write_bytes(data)
        started = time.process_time()
        with contextlib.suppress(ConfigError):
            from_dict(EstimateConfig, load_toml(path), str(path))
        assert time.process_time() - started < 1
