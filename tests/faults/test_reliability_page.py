"""The page on reliability names tests that exist, and counts its cases."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reliability.md").read_text()
ROWS = [line for line in PAGE.splitlines() if re.match(r"\| (?!case)[^-]", line)]


def test_the_cases_are_counted() -> None:
    assert f"{len(ROWS)} cases" in PAGE


@pytest.mark.parametrize("row", ROWS)
def test_every_case_has_its_test(row: str) -> None:
    match = re.search(r"`(tests/[\w/]+\.py)::(?:(\w+)::)?(\w+)` \|$", row)
    assert match
    file, group, name = match.groups()
    text = (ROOT / file).read_text()
    assert re.search(rf"^( *)def {name}\(", text, re.MULTILINE)
    assert group is None or f"class {group}:" in text
