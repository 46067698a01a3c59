"""``voronerf compare``: the figures of trained runs side by side."""

from __future__ import annotations

import shlex
from decimal import Decimal
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from voronerf.app.cli.display import console, printable, say
from voronerf.app.files import read_json
from voronerf.app.train.callbacks import views_of
from voronerf.app.train.checkpoint import last_checkpoint, no_run
from voronerf.app.train.config import ConfigError, parse_option
from voronerf.app.train.run_directory import check_folders, read_metrics
from voronerf.editing.run import has_parts, is_cut, open_parts

#: Rows of the table: the name in summary.json, the heading, and the decimals; None for a time.
FIGURES = (
    *(("cells", "cells", 0), ("parameters", "parameters", 0), ("steps", "steps", 0), ("seconds", "training", None)),
    *(("rays_per_second", "rays/s", 0), ("psnr", "PSNR [dB]", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3)),
)
#: Scores of test views, and the mark of scores that were computed only on the central part of each view.
SCORES, PARTLY = ("psnr", "ssim", "lpips"), "*"
#: Settings about the location and outputs of a run, which are not compared.
PLACES = ("out", "resume", "allow_outside", "panels", "tensorboard")


def compare(runs: tuple[Path, ...], /) -> int:
    """Show the scores of trained runs side by side, and the settings in which they differ.

    A star marks scores that were computed only on the central part of each view. They are not comparable with scores
    of whole views.

    Args:
        runs: The run directories, at least two. An unfinished run shows its last evaluation. A run that was made by
            join, cut or place shows the scores of voronerf eval; a cut run has low scores, since a part is missing.
    """
    if len(runs) < 2:
        raise ConfigError(f"compare needs at least two runs, got {len(runs)}")
    read = [read_files(run) for run in runs]
    table = Table()
    table.add_column("", no_wrap=True)
    for run in runs:
        table.add_column(escape(printable(str(run))), justify="right", overflow="fold")
    for key, heading, places in FIGURES:
        marks = [PARTLY * (key in SCORES and figures.get("part", 1) != 1) for figures, _ in read]
        numbers = (shown(figures.get(key), places) for figures, _ in read)
        table.add_row(escape(heading), *map("".join, zip(numbers, marks, strict=True)))
    viewed = ([views_of(figures), "cut" * is_cut(run)] for run, (figures, _) in zip(runs, read, strict=True))
    table.add_row("scores of", *(", ".join(filter(None, words)) or "-" for words in viewed))
    table.add_section()
    for name in dict.fromkeys(name for _, settings in read for name in settings if name not in PLACES):
        values = [escape(printable(written(settings.get(name)))) for _, settings in read]
        if len(set(values)) > 1:
            table.add_row(escape(printable(name)), *values)
    console.print(table)
    for run, (figures, _) in zip(runs, read, strict=True):
        if figures.get("psnr") is None:
            say(f"{run} has no scores: {shlex.join(['voronerf', 'eval', str(run)])} computes them")
    return 0


def read_files(run: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the figures of a run, and its settings with the options of its field.

    Raises:
        ConfigError: There is no run, or one of its folders is a link to elsewhere.
        ValueError: A file of the run is damaged.
    """
    check_folders(run)
    if not (run / "config.json").is_file():
        raise ConfigError(no_run(run, "config.json"))
    metrics = read_metrics(run)
    ended = (run / "summary.json").is_file()
    figures = read_json(run / "summary.json", dict) if ended else metrics[-1] if metrics else {}
    settings = read_json(run / "config.json", dict)
    scores = read_json(run / "eval.json", dict) if (run / "eval.json").is_file() else {}
    if not figures and has_parts(run):
        figures = count_parts(run)
    if figures.get("psnr") is None and isinstance(views := scores.get("views"), list):
        figures |= {**scores, "views": len(views)}
    options = settings.pop("field_options", [])
    return figures, settings | dict(parse_option(str(text)) for text in (options if isinstance(options, list) else []))


def count_parts(run: Path) -> dict[str, Any]:
    """Returns the numbers of cells and parameters of a run of several parts."""
    parts = open_parts(run, last_checkpoint(run))
    networks = {id(part.network): part.network.checkpoint for part in parts}
    sizes = (value.numel() for network in networks.values() for value in network.group("router.module").values())
    return {"cells": parts.num_cells, "parameters": sum(sizes)}


def shown(value: object, places: int | None) -> str:
    """Formats a number with ``places`` decimals, or seconds as a time if ``places`` is None; other values as a dash."""
    if not isinstance(value, int | float):
        return "-"
    if places is not None:
        return f"{value:,.{places}f}"
    minutes, seconds = divmod(round(value), 60)
    return f"{minutes} min" + f" {seconds} s" * (seconds > 0) if minutes else f"{value:.2g} s"


def written(value: object) -> str:
    """Returns a setting as people write it: 0.00001 for 1e-05, 4 4 for [4, 4], a dash for None."""
    if isinstance(value, list | tuple):
        return " ".join(map(written, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return f"{value:,}" if isinstance(value, int) else f"{Decimal(f'{value:.6g}'):,f}"
    return "-" if value is None else str(value)
