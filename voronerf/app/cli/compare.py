"""``voronerf compare``: trained runs side by side, in one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import html
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from PIL import Image
from rich.markup import escape
from rich.table import Table

from voronerf.app.cli.commands import console, say
from voronerf.app.cli.display import printable
from voronerf.app.evaluate.plots import draw_curves
from voronerf.app.files import read_json, write_text
from voronerf.app.train.config import ConfigError
from voronerf.app.train.run_directory import check_folders, read_curve, read_metrics

#: Figures of a run: its entry of summary.json, the heading, the decimals, and whether more or less (-1) is better.
FIGURES = (
    ("cells", "cells", 0, 0),
    ("parameters", "parameters", 0, 0),
    ("steps", "steps", 0, 0),
    ("seconds", "training [s]", 0, 0),
    ("rays_per_second", "rays/s", 0, 1),
    ("psnr", "PSNR [dB]", 2, 1),
    ("ssim", "SSIM", 4, 1),
    ("lpips", "LPIPS", 4, -1),
)
#: Settings that say where a run is, rather than what it is.
PLACES = ("out", "resume", "allow_outside", "panels", "tensorboard")
STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .25rem .8rem; text-align: right; border-bottom: 1px solid #8884; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; background: #fff; }
figure { margin: .5rem 0; }
figcaption { opacity: .7; }
"""


@dataclass(frozen=True)
class Summary:
    """What the files of a run say about it: summary.json, config.json, its curve, and pictures by name."""

    name: str
    figures: dict[str, Any]
    settings: dict[str, Any]
    curve: list[tuple[float, float]]
    pictures: dict[str, Path]


def compare(runs: tuple[Path, ...], /, out: Path = Path("compare.html"), views: int = 4) -> int:
    """Compare trained runs: a table, curves and pictures in one HTML page.

    Args:
        runs: The run directories, at least two.
        out: The page, which holds its pictures itself.
        views: Test views at the most, of those that two or more of the runs have panels of.
    """
    if len(runs) < 2:
        raise ConfigError(f"compare needs at least two runs, got {len(runs)}")
    if views < 0:
        raise ConfigError(f"--views must not be negative, got {views}")
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--out must end in .html, got {out}")
    names = [run.resolve().name for run in runs]
    labels = [name if names.count(name) == 1 else str(run) for name, run in zip(names, runs)]
    found = [read_summary(run, label) for run, label in zip(runs, labels)]
    table = Table("run", *(heading for _, heading, _, _ in FIGURES))
    for run in found:
        shown = (figure(run.figures.get(key), places) for key, _, places, _ in FIGURES)
        table.add_row(escape(printable(run.name)), *shown)
    console.print(table)
    write_text(out, page(found, views))
    say(f"wrote {out}")
    return 0


def read_summary(run: Path, name: str) -> Summary:
    """Reads the files of a run; one that has not ended has its last evaluation in the place of a summary.

    Raises:
        ConfigError: there is no run, or a folder of it leads elsewhere.
        ValueError: a file cannot be read as that of a run.
    """
    check_folders(run)
    if not (run / "config.json").is_file():
        raise ConfigError(f"{run}: there is no run, it has no config.json")
    metrics = read_metrics(run)
    ended = (run / "summary.json").is_file()
    figures = read_json(run / "summary.json") if ended else metrics[-1] if metrics else {}
    settings = read_json(run / "config.json")
    for file, value in (("summary.json", figures), ("config.json", settings)):
        if not isinstance(value, dict):
            raise ValueError(f"{run / file}: must be an object, got {value!r:.60}")
    pictures = {path.stem: path for path in sorted((run / "images").glob("*.png"))}
    return Summary(name, figures, settings, read_curve(run), pictures)


def page(runs: list[Summary], views: int) -> str:
    """The whole page."""
    parts = ["<h1>", " · ".join(html.escape(run.name) for run in runs), "</h1>", figures_table(runs)]
    differing = settings_table(runs)
    if differing:
        parts += ["<h2>Settings that differ</h2>", differing]
    curves = {run.name: run.curve for run in runs if run.curve}
    if curves:
        splits = {run.name: split_seconds(run) for run in runs}
        parts += ["<h2>PSNR over training time</h2>", picture(draw_curves(curves, splits=splits), "", "curves")]
    names = dict.fromkeys(name for run in runs for name in run.pictures)
    shared = [name for name in names if sum(name in run.pictures for run in runs) > 1][:views]
    if shared:
        parts.append("<h2>Test views</h2>")
    for name in shared:
        parts.append(f"<h3>{html.escape(name)}</h3>")
        parts += [picture(png(run.pictures[name]), run.name, name) for run in runs if name in run.pictures]
    title = html.escape(", ".join(run.name for run in runs))
    head = f"<meta charset='utf-8'><title>{title}</title><style>{STYLE}</style>"
    return f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def figures_table(runs: list[Summary]) -> str:
    """The figures of all runs; the best of each column is bold."""
    rows = [["run", *(heading for _, heading, _, _ in FIGURES)]]
    columns = []
    for key, _, places, sign in FIGURES:
        values = [run.figures.get(key) for run in runs]
        finite = [sign * value for value in values if is_finite(value) and sign]
        texts = [figure(value, places) for value in values]
        best = figure(sign * max(finite), places) if len(finite) > 1 else None
        columns.append([f"<b>{text}</b>" if text == best else text for text in texts])
    rows += [[html.escape(run.name), *cells] for run, *cells in zip(runs, *columns)]
    return rows_of(rows)


def settings_table(runs: list[Summary]) -> str:
    """The settings in which the runs differ; nothing if there are none."""
    names = [name for name in dict.fromkeys(name for run in runs for name in run.settings) if name not in PLACES]
    texts = {name: [words(run.settings.get(name)) for run in runs] for name in names}
    rows = [
        [f"--{html.escape(name.replace('_', '-'))}", *map(html.escape, values)]
        for name, values in texts.items()
        if len(set(values)) > 1
    ]
    return rows_of([["setting", *(html.escape(run.name) for run in runs)], *rows]) if rows else ""


def words(value: Any) -> str:
    """A setting as one types it; a dash for none."""
    if isinstance(value, list):
        return " ".join(map(str, value)) or "-"
    return "-" if value is None else str(value)


def rows_of(rows: list[list[str]]) -> str:
    """A table whose first row is its head."""
    cells = [[f"<td>{cell}</td>" for cell in row] for row in rows[1:]]
    lines = [[f"<th>{cell}</th>" for cell in rows[0]], *cells]
    return "<table>" + "".join("<tr>" + "".join(line) + "</tr>" for line in lines) + "</table>"


def figure(value: Any, places: int) -> str:
    """A number as a table shows it; a dash for anything else."""
    return f"{value:,.{places}f}" if is_finite(value) else "-"


def is_finite(value: object) -> TypeGuard[float]:
    """Whether a value of JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def split_seconds(run: Summary) -> list[float]:
    """When the cells of a run were split."""
    stages = run.figures.get("stages")
    later = stages[1:] if isinstance(stages, list) else []
    seconds = (stage.get("started_at_second") for stage in later if isinstance(stage, dict))
    return [second for second in seconds if is_finite(second)]


def png(path: Path) -> bytes:
    """The bytes of a PNG.

    Raises:
        ValueError: the file is not a PNG.
    """
    try:
        with Image.open(path, formats=("PNG",)) as image:
            image.verify()
    except (OSError, SyntaxError, Image.DecompressionBombError):
        raise ValueError(f"{path}: is not a PNG") from None
    return path.read_bytes()


def picture(data: bytes, caption: str, text: str) -> str:
    """A PNG in the page."""
    source = base64.b64encode(data).decode()
    below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{below}<img alt='{html.escape(text)}' src='data:image/png;base64,{source}'></figure>"
