"""What the README shows works as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
SHELL = [
    line
    for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    for line in block.splitlines()
]


@pytest.mark.parametrize("example", PYTHON, ids=[str(i) for i in range(len(PYTHON))])
def test_the_examples_run(example: str, tmp_path: Path) -> None:
    """Each Python block runs as a program of its own, warnings being errors."""
    program = tmp_path / "example.py"
    program.write_text(example)
    done = subprocess.run(
        [sys.executable, "-W", "error", str(program)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_there_is_a_library_example_of_about_ten_lines() -> None:
    """It is short enough to be read."""
    assert PYTHON
    assert len(PYTHON[0].splitlines()) <= 14


@pytest.mark.parametrize("line", [line for line in SHELL if line.startswith("terrasim ")])
def test_the_commands_exist_and_name_files_that_exist(line: str) -> None:
    """Every command of the README is one of the program's; scenarios it names are there."""
    words = line.split("#", maxsplit=1)[0].split()
    done = subprocess.run(
        [sys.executable, "-m", "terrasim", words[1], "--help"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for word in words:
        if word.startswith("scenarios/"):
            assert (ROOT / word).is_file()


def test_the_files_it_links_to_are_there() -> None:
    """Pictures and documents."""
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).is_file(), link
