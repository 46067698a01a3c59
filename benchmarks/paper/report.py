"""Markdown tables of the paper's experiments, and a page with all tables, from the JSON in the output folder."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from paper.experiments import CONDITIONS, EXPERIMENTS, Scores
from paper.figures import draw
from voronerf.app.files import write_text

Row = dict[str, Any]
#: All experiments, in the order of the page.
ABOUT = {
    **{name: experiment.about for name, experiment in EXPERIMENTS.items()},
    "balance": "How evenly 16 cells share the importance, before and after balancing, over 100 diagrams.",
}
PLACES = {"psnr": 2, "ssim": 4, "lpips": 4, "psnr_of_mean_error": 2}
SIZES = ("cells", "width", "parameters", "steps")


def grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """Returns the lines of a Markdown table."""
    return [f"| {' | '.join(header)} |", "|---" * len(header) + "|", *(f"| {' | '.join(line)} |" for line in lines)]


def score(values: Sequence[float | None], form: str) -> str:
    """Formats the mean over the seeds, with the range if there are several seeds."""
    measured = [value for value in values if value is not None]
    if not measured:
        return "-"
    mean = f"{statistics.fmean(measured):{form}}"
    return mean if len(measured) == 1 else f"{mean} ({min(measured):{form}} to {max(measured):{form}})"


def span(values: Sequence[int | None]) -> str:
    """Formats one number, or the range of several numbers."""
    numbers = sorted({value for value in values if value is not None})
    return " to ".join(f"{value:,}" for value in numbers[:: max(len(numbers) - 1, 1)]) or "-"


def score_table(rows: Sequence[Row], published: Callable[[str, str], Scores | None]) -> list[str]:
    """Returns a table with a row per scene and variant: means and ranges over the seeds, and published scores."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["variant"]), []).append(row)
    paper = any(published(variant, scene) for scene, variant in groups)
    lines = []
    for (scene, variant), group in groups.items():
        scores = [score([row.get(name) for row in group], f".{places}f") for name, places in PLACES.items()]
        reference = published(variant, scene)
        middle = f"{reference.psnr:.3f} / {reference.ssim:g} / {reference.lpips:g}" if reference else "-"
        sizes = [span([row.get(name) for row in group]) for name in SIZES]
        lines.append([scene, variant, *scores, *([middle] if paper else []), *sizes])
    header = ["scene", "variant", "PSNR", "SSIM", "LPIPS", "PSNR of the mean error"]
    return grid([*header, *([CONDITIONS] if paper else []), *SIZES], lines)


def balance_table(rows: Sequence[Row]) -> list[str]:
    """Returns the table of the experiment on balance."""
    lines = []
    for row in rows:
        cells = []
        for name in ("before", "after"):
            values = row[f"{name}_all"]
            low, _, high = statistics.quantiles(values, n=4) if len(values) > 1 else [values[0]] * 3
            cells.append(f"{row[name]:.4f}, quartiles {low:.4f} and {high:.4f}")
        lines.append([row["variant"], *cells, f"{max(row['after_all']):.4f}"])
    return grid(("samples", "median before", "median after", "worst after"), lines)


def table(name: str, outcome: Mapping[str, Any]) -> list[str]:
    """Returns the table of one experiment."""
    if name == "balance":
        return balance_table(outcome["results"])
    published = EXPERIMENTS[name].published if name in EXPERIMENTS else lambda variant, scene: None
    return score_table(outcome["results"], published)


def conditions(described: Mapping[str, Any]) -> str:
    """Returns a description of an experiment's machine and size, from its metadata."""
    size = described.get("size")
    parts = [
        ", ".join(described["scenes"]),
        f"{size[1]} x {size[0]} pixels" if size else "",
        f"{described['budget_seconds']:g} s a variant",
        f"{described['seeds']} seeds" if described["seeds"] > 1 else "one seed",
        f"{described['rays']} rays x {described['samples']} samples" if "rays" in described else "",
        f"{described['threads']} threads",
        described["machine"],
        *(f"failed: {failure}" for failure in described.get("failed", [])),
    ]
    return "; ".join(part for part in parts if part)


def write_report(out: Path) -> Path:
    """Writes report.md: the table and pictures of every experiment in the output folder.

    Raises:
        ValueError: The folder holds no experiment.
    """
    outcomes = {n: json.loads((out / f"{n}.json").read_text()) for n in ABOUT if (out / f"{n}.json").is_file()}
    if not outcomes:
        raise ValueError(f"--out must hold results of experiments, got {out}")
    lines = ["# The paper's experiments, repeated"]
    for name, outcome in outcomes.items():
        lines += ["", f"## {name}", "", ABOUT[name], "", conditions(outcome["metadata"]) + ".", ""]
        lines += table(name, outcome)
        for picture in draw(name, outcome["results"], out):
            lines += ["", f"![{picture.stem}]({picture.name})"]
    write_text(out / "report.md", "\n".join(lines) + "\n")
    return out / "report.md"
