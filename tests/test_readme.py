"""Documents that can't rot: the README's commands are run, docs/cli.md is what ``--help`` prints.

Run as a program, this writes the outputs in both anew.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest

from trapcli.cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
CLI = ROOT / "docs" / "cli.md"
CONSOLE = re.compile(r"(?<=^```console\n).*?(?=^```$)", re.MULTILINE | re.DOTALL)
PYTHON = re.compile(r"(?<=^```python\n).*?(?=^```$)", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
CLI_HEAD = """# Commands

What `trap-motion COMMAND --help` prints. Results go to stdout, all else to stderr. Exit codes: 0 done; 1 some
of several inputs failed, each named; 2 an option or a configuration makes no sense; 3 an input can't be read;
4 a result is written, but not trustworthy; 5 an output exists or can't be written; 130 interrupted.
"""


def shell(command: str, folder: Path) -> str:
    """Run a command as a reader would: the program is on the path, stdout and stderr are one."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": "80"}
    done = subprocess.run(
        ["bash", "-c", f"{{ {command}\n}} 2>&1"],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout


def run_block(block: str, folder: Path) -> str:
    """Run the commands of a console block and return it with their outputs."""
    commands = [line for line in block.splitlines() if line.startswith("$ ")]
    return "".join(f"{command}\n{shell(command[2:], folder)}" for command in commands)


def workplace(folder: Path) -> Path:
    shutil.copytree(ROOT / "sample_data", folder / "sample_data")
    return folder


def cli_page() -> str:
    sections = [
        f"\n## trap-motion {name}\n\n```text\n{shell(f'trap-motion {name} --help', ROOT)}```\n"
        for name in COMMANDS
    ]
    return CLI_HEAD + "".join(sections)


def words(text: str) -> list[str]:
    return NUMBER.sub("0", text).split()


def numbers(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def test_the_readmes_commands_print_what_it_shows(tmp_path: Path) -> None:
    folder = workplace(tmp_path)
    blocks = CONSOLE.findall(README.read_text(encoding="utf-8"))
    assert len(blocks) >= 4
    for block in blocks:
        found = run_block(block, folder)
        assert words(found) == words(block)
        # the last digits depend on the processor
        shown = np.array(numbers(block))
        np.testing.assert_allclose(numbers(found), shown, rtol=0.3, atol=0.02, err_msg=found)


def test_the_readmes_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = PYTHON.findall(README.read_text(encoding="utf-8"))
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(block, "README.md", "exec"), {})
    assert re.fullmatch(r"\de-0[345] degrees at most\n", output.getvalue())
    assert (tmp_path / "motion.h5").exists()


def test_the_page_of_commands_is_what_help_prints() -> None:
    assert CLI.read_text(encoding="utf-8").split() == cli_page().split()


@pytest.mark.parametrize("page", [README, *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_functions_that_the_theory_names_exist() -> None:
    names = re.findall(r"`(trapcli\.[\w.]+)`", (ROOT / "docs" / "theory.md").read_text(encoding="utf-8"))
    assert len(names) > 15
    for name in names:
        pkgutil.resolve_name(name)


def test_versions_agree() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert importlib.metadata.version("trapcli") == version


def test_sample_data_are_small_and_can_be_made_again(tmp_path: Path) -> None:
    from trapcli.stack import open_stack

    sample = ROOT / "sample_data"
    assert sum(path.stat().st_size for path in sample.iterdir()) < 2_000_000
    folder = workplace(tmp_path) / "sample_data"
    made = ("tumbling-grain.tif", "turning-grain.avi")
    for name in made:
        (folder / name).unlink()
    shell("TRAP_MOTION=trap-motion ./make.sh", folder)
    for name in made:
        old, new = (open_stack(str(place / name)).to_array().astype(int) for place in (sample, folder))
        # rounding may differ between processors
        assert np.abs(new - old).max() <= 1
        assert (new != old).mean() < 0.001


def update() -> None:
    """Write the README's outputs and docs/cli.md anew."""
    CLI.write_text(cli_page(), encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        place = workplace(Path(folder))
        text = README.read_text(encoding="utf-8")
        README.write_text(CONSOLE.sub(lambda m: run_block(m[0], place), text), encoding="utf-8")


if __name__ == "__main__":
    update()
