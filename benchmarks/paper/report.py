"""docs/paper.md from the JSON of the experiments: tables, claims with their verdicts, pictures.

Everything is computed from what is in the output folder. What stands in the document between ``NOTES`` and its end was
written by hand and is kept.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from paper.experiments import EXPERIMENTS
from paper.figures import draw
from paper.tables import all_claims_table, markdown
from voronerf.files import write_bytes, write_text

NOTES = "<!-- what follows is written by hand and kept -->"
COLOURS = 192  # of a picture in the document
WIDEST = 1100  # pixels
ORDER = (
    *("convergence", "sampling", "architecture", "kilonerf", "initialisation", "ghosting", "density", "split-kinds"),
    *("early-late", "cell-count", "balance", "seams", "title", "nested-2d", "limits"),
)
ABOUT = {
    "balance": "How evenly 16 cells share the importance, before and after balancing, over 100 diagrams.",
    "nested-2d": "A picture fitted by networks of places in the plane, split three times into four where it is wrong: "
    "one network, one of as many parameters as all cells have, nested cells.",
}
INTRODUCTION = """# The paper's experiments, repeated

*Adaptive Voronoi NeRFs* (Elsner, Czech, Berger, Selman, Lim, Kobbelt 2023) in small: every table and figure by name,
both sides of each comparison for the same training time, on the same kernels, with the same rays, samples and schedule.

    python benchmarks/paper.py table sampling|architecture|kilonerf [--scene lego ship] [--budget SECONDS] [--seeds N]
    python benchmarks/paper.py figure convergence|initialisation|split-kinds|early-late|cell-count|ghosting|...
    make paper        # all of it in small, which is docs/paper.md

This page is written by `benchmarks/paper.py report`; its verdicts are computed from the figures. Published figures are
those of 400 x 400 images after 24 h on an RTX 2080 Ti. The networks here have four hidden layers (KiloNeRF's two) on
both sides of each comparison, where a NeRF usually has eight. Values are means over the seeds, with their range; a gain
is taken seed by seed, and "every seed" is said of one sitting, not of its repetition."""


def load(out: Path) -> dict[str, dict[str, Any]]:
    """The experiments that are in the output folder, in the page's order."""
    return {name: json.loads((out / f"{name}.json").read_text()) for name in ORDER if (out / f"{name}.json").is_file()}


def about(name: str) -> str:
    """What an experiment compares."""
    return ABOUT[name] if name in ABOUT else EXPERIMENTS[name].about


def table_of(name: str, outcome: Mapping[str, Any]) -> list[str]:
    """Tables of one experiment, and what is missing of it."""
    published = EXPERIMENTS[name].published if name in EXPERIMENTS else lambda variant, scene: None
    lines = markdown(name, dict(outcome), published)
    absent = outcome["metadata"].get("missing", [])
    return [*lines, *(["", f"Missing: {'; '.join(absent)}."] if absent else [])]


def conditions(described: Mapping[str, Any]) -> str:
    """Where and how large an experiment was, from its metadata."""
    size = described.get("size")
    parts = [
        ", ".join(described["scenes"]),
        f"{size[1]} x {size[0]} pixels" if size else "",
        f"{described['diagrams']} diagrams"
        if "diagrams" in described
        else f"{described['budget_seconds']:g} s a variant",
        f"{described['seeds']} seeds" if described["seeds"] > 1 else "one seed",
        f"{described['rays']} rays x {described['samples']} samples" if "rays" in described else "",
        f"for each the best of {len(described['rates'])} learning rates by final test PSNR"
        if len(described.get("rates", [])) > 1
        else "",
        *(described.get("options") or []),
        *(described.get("machines") or [f"{described['threads']} threads", described["machine"]]),
        *(f"failed: {failure}" for failure in described.get("failed", [])),
    ]
    return "; ".join(part for part in parts if part)


def write_experiment(name: str, outcome: Mapping[str, Any], out: Path) -> list[Path]:
    """Writes the table and the pictures of an experiment beside its JSON; returns the pictures."""
    lines = [f"# {name}", "", about(name), "", conditions(outcome["metadata"]), "", *table_of(name, outcome)]
    write_text(out / f"{name}.md", "\n".join(lines) + "\n")
    return draw(name, outcome["results"], out)


def write_report(out: Path, page: Path) -> None:
    """Writes the page from all experiments in the output folder, and its pictures to images/NAME beside NAME.md.

    Where the results are from a record and nothing can be drawn of them, the pictures of an earlier page stay.

    Raises:
        ValueError: When the folder holds no experiment.
    """
    outcomes = load(out)
    if not outcomes:
        raise ValueError(f"--out must hold results of experiments, got {out}")
    lines = [INTRODUCTION, "", "## What the paper claims, and what came out", ""]
    lines += all_claims_table(outcomes.values())
    images = page.parent / "images" / page.stem
    missing = [name for name in ORDER if name not in outcomes]
    if missing:
        lines += ["", f"Not run: {', '.join(missing)}."]
    for name, outcome in outcomes.items():
        lines += ["", f"## {outcome['metadata']['kind'].capitalize()}: {name}", "", about(name), ""]
        lines += [conditions(outcome["metadata"]) + ".", ""]
        lines += table_of(name, {**outcome, "claims": []})
        for picture in write_experiment(name, outcome, out):
            write_bytes(images / picture.name, smaller(picture))
        for picture in sorted(images.glob(f"{name}*.png"), key=lambda path: path.stem):
            lines += ["", f"![{picture.stem}]({picture.relative_to(page.parent).as_posix()})"]
    write_text(page, "\n".join(lines) + "\n\n" + kept_notes(page))


def kept_notes(page: Path) -> str:
    """What was written by hand into the page before, with the line above it."""
    text = page.read_text() if page.is_file() else ""
    _, mark, notes = text.partition(NOTES)
    return NOTES + (notes if mark else "\n")


def smaller(path: Path) -> bytes:
    """A picture with few colours and at most ``WIDEST`` pixels wide, as PNG."""
    with Image.open(path) as file:
        picture = file.convert("RGB")
    if picture.width > WIDEST:
        size = (WIDEST, round(picture.height * WIDEST / picture.width))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(data, format="PNG", optimize=True)
    return data.getvalue()


def claims_text(claims: Sequence[Mapping[str, str]]) -> str:
    """Claims for the terminal, a line each."""
    return "\n".join(f"{c['verdict']:40} {c['claim']}: {c['here']} (published: {c['published']})" for c in claims)
