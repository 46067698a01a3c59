"""The pages: Python in them runs, the options they name exist, their files are there."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RUNNABLE = ("README.md", "docs/quickstart.md", "docs/method.md")
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


def blocks(name: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", RUNNABLE)
def test_python_on_a_page_runs(name: str) -> None:
    found = blocks(name)
    assert found, f"{name} has no Python"
    for number, code in enumerate(found, 1):
        exec(compile(code, f"{name}, block {number}", "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("name", PAGES)
def test_linked_files_are_there(name: str) -> None:
    # contributing.md and changelog.md show files of the root, which are checked as such by GitHub's readers.
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / name).read_text()):
        assert ((ROOT / name).parent / target).is_file(), f"{name} links {target}"


def test_promises_name_tests_that_are_there() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs/reliability.md").read_text())
    missing = [f"{file}::{name}" for file, name in named if f"def {name}(" not in (ROOT / file).read_text()]
    assert len(named) > 20 and not missing, missing


def test_every_option_of_every_command_is_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs/scripts"))
    import options

    from voronerf.app.cli.main import COMMANDS
    from voronerf.app.train.config import TrainConfig

    text = options.markdown()
    for command in COMMANDS:
        assert f"## voronerf {command}\n" in text
    for field in dataclasses.fields(TrainConfig):
        assert f"\n| `--{field.name.replace('_', '-')}`" in text, field.name
    assert "\n| `RUN` |" in text and "\n| `--frames` |" in text
    sys.modules.pop("options")


@pytest.mark.parametrize("name", [name for name in PAGES if "changelog" not in name])
def test_options_on_a_page_exist(name: str) -> None:
    from voronerf.app.cli.train import train
    from voronerf.app.train.config import TrainConfig

    fields = dataclasses.fields(TrainConfig)
    known = {f"--{field.name.replace('_', '-')}" for field in fields}
    known |= {f"--{parameter}" for parameter in inspect.signature(train).parameters}
    known |= {f"--no-{field.name.replace('_', '-')}" for field in fields if isinstance(field.default, bool)}
    for line in re.findall(r"voronerf train( [^`\n|]*)", (ROOT / name).read_text()):
        for option in re.findall(r"(?<!\w)--[a-z-]+", line):
            assert option in known, f"{name}: voronerf train has no {option}"


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
