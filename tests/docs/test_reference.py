"""Tests of the API reference: every public name is on a page, and has an example that runs."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import voronerf

PAGES = Path(__file__).resolve().parents[2] / "docs" / "reference"
PACKAGES = ("voronerf", *(f"voronerf.{name}" for name in ("ops", "diagram", "router", "nerf", "nerf.fields")))
PACKAGES += (
    "voronerf.editing",
    "voronerf.app",
    *(f"voronerf.app.{name}" for name in ("scenes", "train", "evaluate", "render", "export")),
)


def resolve(path: str) -> Any:
    """Returns the object of a dotted name; a module and its function may share a name."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def public_objects() -> dict[str, Any]:
    """Returns every public class and function by its first public name."""
    objects: dict[int, tuple[str, Any]] = {}
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", ()):
            objects.setdefault(id(getattr(module, name)), (f"{package}.{name}", getattr(module, name)))
    return dict(objects.values())


PUBLIC = public_objects()
EXAMPLES = "\n".join(inspect.getdoc(value) or "" for value in PUBLIC.values())


def listed() -> dict[str, Any]:
    lines = [line for page in PAGES.glob("*.md") for line in page.read_text().splitlines()]
    return {line.split()[1]: resolve(line.split()[1]) for line in lines if line.startswith("::: ")}


def test_every_public_name_is_in_the_reference_once() -> None:
    shown = listed()
    assert len(PUBLIC) > 50
    missing = [name for name, value in PUBLIC.items() if not any(value is other for other in shown.values())]
    assert not missing, f"add `::: NAME` to a page of docs/reference for {', '.join(missing)}"
    assert len({id(value) for value in shown.values()}) == len(shown)


@pytest.mark.parametrize("name", sorted(name for name, value in PUBLIC.items() if callable(value)))
def test_example_of_a_public_name_runs(name: str) -> None:
    value = PUBLIC[name]
    if inspect.isclass(value) and issubclass(value, Exception):
        assert value.__doc__
        return
    doc = inspect.getdoc(value) or ""
    if "Examples:\n" not in doc and re.search(rf"(>>>|\.\.\.) .*\b{name.rpartition('.')[2]}\b", EXAMPLES):
        return  # another name's example uses it
    assert re.search(r"^Examples:\n\s+>>> ", doc, re.MULTILINE), f"{name} needs an example under 'Examples:'"
    ran = 0
    for test in doctest.DocTestFinder(recurse=True).find(value, name, globs={}):
        torch.manual_seed(0)
        outcome = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS).run(test)
        assert outcome.failed == 0, f"{test.name}: {outcome.failed} of {outcome.attempted} fail, see the output"
        ran += outcome.attempted
    assert ran


def test_pages_say_the_version(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: make docs installs it")
    monkeypatch.syspath_prepend(str(PAGES.parent / "scripts"))
    hooks = importlib.import_module("hooks")
    assert hooks.on_config(SimpleNamespace()).copyright == f"voronerf {voronerf.__version__}"
