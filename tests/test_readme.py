"""Documents that can't rot: commands of README and tutorial are run, docs/cli.md is what ``--help`` prints.

Run as a program, this writes all outputs anew.
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
DOCS = ROOT / "docs"
CLI = DOCS / "cli.md"
CLUSTER = DOCS / "cluster.md"
PAGES = [README, *sorted((DOCS / "tutorial").glob("*.md"))]
"""In the order of reading: a page may use what an earlier one made."""
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
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


class Reader:
    """Someone who reads all pages and does what they say, in one folder."""

    def __init__(self, folder: Path) -> None:
        shutil.copytree(ROOT / "sample_data", folder / "sample_data")
        self.folder = folder
        self._done: dict[str, str] = {}

    def follow(self, block: str) -> str:
        """Run the commands of a console block and return it with their outputs; none is run twice."""
        commands = [line for line in block.splitlines() if line.startswith("$ ")]
        for command in commands:
            if command not in self._done:
                self._done[command] = shell(command[2:], self.folder)
        return "".join(f"{command}\n{self._done[command]}" for command in commands)

    def python(self, block: str, page: str) -> str:
        """Run a block of Python and return what it prints."""
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.chdir(self.folder):
            exec(compile(block, page, "exec"), {})
        return output.getvalue()


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


def test_commands_print_what_the_pages_show(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    for page in PAGES:
        blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
        assert {language for language, _ in blocks} <= {"console", "python", "sh", "bibtex"}, page
        assert sum(language == "console" for language, _ in blocks) >= 2, page
        for language, block in blocks:
            if language == "python":
                assert reader.python(block, page.name)
            elif language == "console":
                found = reader.follow(block)
                assert words(found) == words(block), f"{page}: {found}"
                # the last digits depend on the processor
                shown = np.array(numbers(block))
                np.testing.assert_allclose(numbers(found), shown, rtol=0.3, atol=0.02, err_msg=found)


def test_the_readmes_python(tmp_path: Path) -> None:
    (block,) = (text for language, text in BLOCK.findall(README.read_text("utf-8")) if language == "python")
    printed = Reader(tmp_path).python(block, "README.md")
    assert re.fullmatch(r"\de-0[345] degrees at most\n", printed)
    assert (tmp_path / "motion.h5").exists()


@pytest.mark.slow
def test_a_newcomer_with_a_bare_clone(tmp_path: Path) -> None:
    """The commands that install and start, as README and tutorial give them."""
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
    for page, least in ((README, "turning.h5"), (PAGES[1], ".venv/bin/trap-motion")):
        language, block = BLOCK.findall(page.read_text(encoding="utf-8"))[0]
        assert language == "sh"
        shutil.rmtree(clone / ".venv", ignore_errors=True)
        done = subprocess.run(
            ["bash", "-ec", block], cwd=clone, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            check=False,
        )  # fmt: skip
        if "No matching distribution found" in done.stdout:
            pytest.skip("no package index can be reached")
        assert done.returncode == 0, done.stdout
        assert (clone / least).exists()
    assert (clone / "demo" / "auto.png").exists()


# docs/cluster.md


def example(name: str) -> Path:
    """Return the file of an example, which the page shows word for word."""
    path = DOCS / "examples" / name
    assert any(block == path.read_text() for _, block in BLOCK.findall(CLUSTER.read_text(encoding="utf-8")))
    return path


def tiny_stacks(folder: Path, count: int) -> list[str]:
    (folder / "stacks").mkdir()
    names = [f"stacks/run {n}.tif" for n in range(count)]
    shell("trap-motion simulate -n 16 --size 32 --spacing 0.7 -o made.tif", folder)
    for name in names:
        shutil.copy(folder / "made.tif", folder / name)
    (folder / "stacks.txt").write_text("".join(f"{name}\n" for name in names))
    return names


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="shell")
def test_a_job_array_shares_the_stacks(tmp_path: Path) -> None:
    script = example("slurm-array.sh")
    directives = re.findall(r"^#SBATCH --([\w-]+)=\S+$", script.read_text(), re.MULTILINE)
    assert directives == ["job-name", "array", "cpus-per-task", "mem-per-cpu", "time", "output"]
    names = tiny_stacks(tmp_path, 5)
    (tmp_path / names[3]).write_text("no image")
    codes = []
    for task in range(6):  # more tasks than stacks
        given = f"SLURM_ARRAY_TASK_COUNT=6 SLURM_ARRAY_TASK_ID={task} SLURM_CPUS_PER_TASK=1"
        options = "--attenuation --method paper"
        codes.append(shell(f"{given} bash {script} stacks.txt {options} >&2; echo code $?", tmp_path)[-2])
    assert codes == ["0", "0", "0", "3", "0", "0"]
    assert sorted(path.name for path in (tmp_path / "stacks").glob("*.h5")) == [
        f"run {n}.h5" for n in (0, 1, 2, 4)
    ]
    assert len(list(tmp_path.glob("summary-*.csv"))) == 5


@pytest.mark.slow
def test_the_rules_of_snakemake(tmp_path: Path) -> None:
    pytest.importorskip("snakemake", reason="Snakemake isn't installed")
    rules = example("Snakefile")
    names = tiny_stacks(tmp_path, 2)
    # a sphere can't be judged, which is no failure of the workflow
    made = "-n 16 --size 32 --spacing 0.7 --phantom sphere --truth truth-2.h5"
    shell(f"trap-motion simulate {made} -o stacks/sphere.tif", tmp_path)
    given = "stacks=stacks options='--attenuation --method paper'"
    command = f"snakemake --snakefile {rules} --cores 1 --config {given}"
    done = shell(f"{command}; echo code $?", tmp_path)
    assert done.endswith("code 0\n"), done
    for name in (*names, "stacks/sphere.tif"):
        assert (tmp_path / name).with_suffix(".html").exists()
    assert "Nothing to be done" in shell(command, tmp_path)


# other pages


def test_the_page_of_commands_is_what_help_prints() -> None:
    assert CLI.read_text(encoding="utf-8").split() == cli_page().split()


@pytest.mark.parametrize("page", [README, *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_figures_in_the_readme_are_those_of_the_benchmarks() -> None:
    text = README.read_text(encoding="utf-8")
    shown = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(shown) >= 8
    assert current_rows(text) == text


def current_rows(text: str) -> str:
    """Return a page with the rows of its tables as the pages of benchmarks have them now."""
    pages = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("benchmarks*.md")))
    rows = {line.split("|")[1]: line for line in reversed(pages.splitlines()) if line.startswith("| ")}
    lines = (rows[line.split("|")[1]] if line.startswith("| ") else line for line in text.split("\n"))
    return "\n".join(lines)


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="MkDocs isn't installed")
    built = shell(f"mkdocs build --strict --quiet --site-dir {tmp_path / 'site'}", ROOT)
    assert built == ""
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(list(DOCS.rglob("*.md")))
    for page in pages:
        loaded = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(\w+:[^"]+)"', page.read_text("utf-8"))
        assert [address for address in loaded if not address.startswith("data:")] == []


def test_functions_that_the_theory_names_exist() -> None:
    names = re.findall(r"`(trapcli\.[\w.]+)`", (DOCS / "theory.md").read_text(encoding="utf-8"))
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
    folder = Reader(tmp_path).folder / "sample_data"
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
    """Write the outputs of README and tutorial, the README's tables, docs/cluster.md and docs/cli.md anew."""
    README.write_text(current_rows(README.read_text(encoding="utf-8")), encoding="utf-8")
    CLI.write_text(cli_page(), encoding="utf-8")
    text = CLUSTER.read_text(encoding="utf-8")
    for language, name in (("bash", "slurm-array.sh"), ("python", "Snakefile")):
        shown = (DOCS / "examples" / name).read_text()
        old = re.search(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        assert old
        text = text[: old.start(1)] + shown + text[old.end(1) :]
    CLUSTER.write_text(text, encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        reader = Reader(Path(folder))
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            page.write_text(
                BLOCK.sub(lambda m, name=page.name: _again(reader, m, name), text), encoding="utf-8"
            )


def _again(reader: Reader, block: re.Match[str], page: str) -> str:
    language, text = block.groups()
    if language == "python":
        reader.python(text, page)
    return f"```console\n{reader.follow(text)}```" if language == "console" else block[0]


if __name__ == "__main__":
    update()
