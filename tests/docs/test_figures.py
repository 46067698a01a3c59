"""Tests that the figures in the pages occur in the files of benchmarks/results.

A line ``<!-- figures of FILE.json -->`` names the file for the next table or paragraph.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import script

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
MARKED = re.compile(r"<!-- figures of (\S+) -->\n\n((?:.+\n)+)")
FIGURE = re.compile(r"(?<!\w)-?[\d,]*\.?\d+")


def marked() -> Iterator[Any]:
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for name, text in MARKED.findall(page.read_text()):
            yield pytest.param(name, text, id=f"{page.stem}-{name}")


def numbers(value: Any) -> Iterator[float]:
    """Yields all numbers within a JSON value."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)
    elif isinstance(value, int | float):
        yield value


def entries(name: str) -> list[list[float]]:
    """Returns the numbers of each result in a file."""
    results = json.loads((RESULTS / name).read_text())["results"]
    groups = results.values() if isinstance(results, dict) else [results]
    return [list(numbers(entry)) for group in groups for entry in group]


def holds(entry: list[float], text: str) -> bool:
    """Returns whether all figures in a text occur in an entry, rounded to the digits shown."""

    def shown(figure: str) -> bool:
        digits = figure.replace(",", "")
        places = len(digits.partition(".")[2])
        return any(abs(number - float(digits)) <= 0.5000001 * 10**-places for number in entry)

    return all(map(shown, FIGURE.findall(text)))


@pytest.mark.parametrize(("name", "text"), list(marked()))
def test_figures_are_those_of_the_file(name: str, text: str) -> None:
    """All figures of a paragraph are in the file; each row, or each column, of a table is from one result."""
    results = entries(name)
    if not text.startswith("|"):
        decimals = re.findall(r"\d+\.\d+", text)
        assert decimals and holds([number for entry in results for number in entry], " ".join(decimals))
        return
    rows = [re.findall(r"[^|]+", line.strip())[1:] for line in text.splitlines()[2:]]
    absent = [
        [cells for cells in parts if not any(holds(entry, " ".join(cells)) for entry in results)]
        for parts in (rows, list(zip(*rows)))
    ]
    assert not all(absent), absent


def test_a_page_or_a_script_names_every_file() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    texts = [path.read_text() for path in [*pages, *(ROOT / "benchmarks").rglob("*.py")]]
    named = set(re.findall(r"[\w.]+\.json", " ".join(texts)))
    assert not [path.name for path in RESULTS.iterdir() if path.name not in named]


@pytest.mark.parametrize(
    ("page", "arguments"),
    [("performance", "throughput.json"), ("foreign-fields", "foreign_fields.json --foreign")],
)
def test_tables_of_operations_are_those_of_the_program(page: str, arguments: str) -> None:
    name, *options = arguments.split()
    printed = script(ROOT / "benchmarks" / "table.py", RESULTS / name, *options).splitlines()
    head = next(line for line in printed if line.startswith("|"))
    text = (ROOT / "docs" / f"{page}.md").read_text()
    rows = text[text.index(head) :].split("\n\n")[0].splitlines()
    assert 4 < len(rows) <= 14 and not set(rows) - set(printed)


def test_counted_instructions_are_those_of_the_check() -> None:
    passes = json.loads((ROOT / ".ci" / "cuda_resources.json").read_text())["passes"]
    section = (ROOT / "docs" / "cuda.md").read_text().split("## Speed, counted")[1].split("\n## ")[0]
    counts = re.findall(r"^\| (\w+)[^|]*\| ([\d,]+)(?: \|[^|]*){2} \| ([\d,]+) ", section, re.MULTILINE)
    shown = {f"{name} {way}": count for name, *both in counts for way, count in zip(("forward", "gradients"), both)}
    assert shown == {name: f"{count:,}" for name, count in passes.items()}


def test_the_claims_of_the_first_page() -> None:
    text = " ".join((ROOT / "README.md").read_text().split())

    def results(name: str) -> Any:
        assert f"(benchmarks/results/{name})" in text
        return json.loads((RESULTS / name).read_text())

    calls = {row["row"]: row["microseconds"] for row in results("calls.json")["results"]}
    ours, one, torchs = (
        [calls[f"{rows} rows, with backward"][name] for rows in (16, 256, 4096, 65536)]
        for name in ("router", "one cell", "nn.Sequential")
    )
    for cost in (a / b for a, b in zip(ours[2:], one[2:])):
        assert f"Sixteen networks take {cost:.1f} times as long as one, with 4,096 and with 65,536 points" in text
    losses = sorted(a / b for a, b in zip(ours[:2], torchs[:2]))
    assert f"16 cells take {losses[0]:.1f} to {losses[1]:.1f} times as long as one network in PyTorch" in text
    (nerf,) = (
        row
        for row in results("foreign_training.json")["results"]["over seeds"]
        if (row["loop"], row["seconds"]) == ("nerf", 60)
    )
    assert f"makes {nerf['fused']['steps'] / nerf['narrow']['steps']:.1f} times as many training steps" in text
    routed = [
        row["speedup_over_best"]
        for row in results("throughput.json")["results"]
        if row["op"] == "routed_mlp" and row["backend"] == "native" and row["n"] >= 1024
    ]
    assert f"{min(routed):.0f} to {max(routed):.0f} times" in text
    lookups = {
        row["case"]: f"{row['speedup_over_best']:.1f} times"
        for row in results("lookup.json")["results"]
        if row["backend"] == "native"
    }
    assert f"nearest of 65,536 centres is found {lookups['n=10000 k=65536 uniform kept']} as fast" in text
    assert f"builds the index is {lookups['n=10000 k=65536 uniform made']} as fast" in text
    modules = results("foreign_modules.json")["metadata"]
    fused = modules["fused"] + modules["fused in runs"]
    assert f"{fused} of {modules['modules']} modules of public codebases" in text
    ways = f"{modules['fused']} are fused whole and {modules['fused in runs']} in runs"
    kinds = f"Of {modules['modules']} modules and methods ({modules['classes']} classes) of {modules['repositories']}"
    foreign = " ".join((ROOT / "docs" / "foreign-fields.md").read_text().split())
    assert f"{kinds} public repositories, {ways}" in foreign
    for minutes, place in ((3, "after three minutes"), (10, "after ten")):
        beside = results("photographs_splats.json")["results"]["beside"]
        rows = [row for row in beside if row["minutes"] == minutes and "opensplat" in row]
        leads = [row["mean"]["psnr"] - max(of["psnr"] for of in row["opensplat"]) for row in rows]
        assert f"{min(leads):.1f} to {max(leads):.1f} dB {place}" in text
