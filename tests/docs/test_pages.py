"""Tests of the pages: their Python code runs, and the options and files that they name exist."""

from __future__ import annotations

import dataclasses
import functools
import re
from pathlib import Path
from typing import Any

import pytest
from helpers import script

ROOT = Path(__file__).resolve().parents[2]
RUNNABLE = ("README.md", "docs/quickstart.md", "docs/method.md", "docs/extend.md", "docs/groups.md")
GENERATED = {"docs/scene.html"}  # made by docs/scripts/scene.py in `make docs`
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


def blocks(name: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", RUNNABLE)
def test_python_on_a_page_runs(name: str) -> None:
    blocks_to_run = [code for code in blocks(name) if "sys.argv" not in code]
    assert blocks_to_run, f"{name} has no Python"
    names = {"__name__": "__main__"}
    for number, code in enumerate(blocks_to_run, 1):
        exec(compile(code.replace("seconds=5", "seconds=0.3"), f"{name}, block {number}", "exec"), names)


def test_the_example_of_a_codebase_runs() -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(blocks("docs/use-in-your-codebase.md")[0], "docs/use-in-your-codebase.md", "exec"), names)
    assert names["router"].num_cells == 16 and names["router"].explain() == "forward: fused"


@pytest.mark.parametrize("name", PAGES)
def test_linked_files_are_there(name: str) -> None:
    # contributing.md and changelog.md include files of the root folder; the links of these files are not checked here.
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / name).read_text()):
        file = (ROOT / name).parent / target
        assert file.is_file() or file.relative_to(ROOT).as_posix() in GENERATED, f"{name} links {target}"


def test_promises_name_tests_that_are_there() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs/reliability.md").read_text())
    missing = [f"{file}::{name}" for file, name in named if f"def {name}(" not in (ROOT / file).read_text()]
    assert len(named) > 20 and not missing, missing


@functools.cache
def options() -> dict[str, set[str]]:
    """Returns the options of each command, as in docs/options.md."""
    text = script(ROOT / "docs" / "scripts" / "options.py")
    commands = re.findall(r"^## voronerf ([\w-]+)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    return {name: set(re.findall(r"--[a-z][a-z-]+", part)) for name, part in commands}


def test_every_option_is_on_the_page() -> None:
    from voronerf.app.cli.program import COMMANDS
    from voronerf.app.train.config import TrainConfig

    assert set(options()) == set(COMMANDS)
    assert {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(TrainConfig)} <= options()["train"]
    assert "--frames" in options()["render"]


@functools.cache
def sources() -> set[str]:
    names = ("voronerf", "csrc", "kernels", "benchmarks", "tests", "docs", "examples", ".ci")
    files = [path for name in names for path in (ROOT / name).rglob("*.*")] + list(ROOT.glob("*.*"))
    return {f"/{path.relative_to(ROOT).as_posix()}" for path in files}


@pytest.mark.parametrize("name", [*PAGES, "CONTRIBUTING.md", "CHANGELOG.md", "Makefile"])
def test_files_that_a_page_names_exist(name: str) -> None:
    files = sources()
    for path in re.findall(r"(?<![*>\w./-])[\w./-]+\.(?:py|cpp|cu|h|toml)\b(?!:)", (ROOT / name).read_text()):
        assert any(file.endswith(f"/{path}") for file in files), f"{name} names {path}"
