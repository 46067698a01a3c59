"""``voronerf eval``: the scores of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from voronerf.app.cli.display import console, printable, say, tracked
from voronerf.app.cli.opening import AS_IN_TRAINING, Opening, check_counts
from voronerf.app.evaluate.angles import FAR_ANGLE
from voronerf.app.evaluate.lpips import OFF
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.files import json_text, write_text
from voronerf.app.train.config import ConfigError
from voronerf.editing.run import is_cut


def evaluate_run(
    run: Path,
    /,
    opening: Opening = AS_IN_TRAINING,
    views: int | None = None,
    panels: int = 4,
    lpips: Path | None = None,
) -> int:
    """Score a trained run on its test views and draw panels: truth, render, error, depth, cells.

    Args:
        run: The run directory.
        opening: The settings with which the run is opened.
        views: Number of test views, evenly spread; default all.
        panels: Number of views drawn.
        lpips: LPIPS weights, a file or folder, or "off"; default as in training, else the first of VORONERF_LPIPS, the
            folder lpips in VORONERF_DATA, the folder lpips beside the scene, and the installed lpips package.
    """
    if panels < 0:
        raise ConfigError(f"--panels must not be negative, got {panels}")
    check_counts(views=views)
    opened = opening.open(run)
    metric = opened.find_lpips(lpips)
    if metric is None and str(lpips or opened.config.lpips) != OFF:
        say("LPIPS is not computed: docs/metrics.md tells what it needs")
    result = opened.evaluate(views=views, lpips=metric or "off", track=tracked)
    table = Table("view", "PSNR, dB", "SSIM", "LPIPS", "angle")
    for view in result["views"]:
        table.add_row(escape(printable(view["name"])), *_figures(view))
    table.add_section()
    table.add_row("mean", *_figures(result))
    console.print(table)
    say(f"PSNR of the mean squared error: {result['psnr_of_mean_error']:.2f} dB")
    say(
        f"{result['far_views']} of {len(result['views'])} views are over {FAR_ANGLE:g} degrees from the training "
        "cameras (angle: from the nearest training camera, at the surfaces of the view)"
    )
    if is_cut(run):
        say(
            f"{run} was cut: its pictures are empty outside of the part that is left, but are compared with whole "
            "images; voronerf eval of the run before the cut tells its quality"
        )
    write_text(run / "eval.json", json_text(result, indent=2) + "\n")
    if panels:
        write_panels(opened.renderer, opened.diagram, opened.scene, run / "images", views=panels, track=tracked)
    say(f"wrote {run / 'eval.json'}" + (f" and {run / 'images'}" if panels else ""))
    return 0


def _figures(score: dict[str, Any]) -> list[str]:
    """Formats the scores of a view for the table; a missing score is a dash."""
    places = {"psnr": 2, "ssim": 4, "lpips": 4, "angle": 1}
    values = {name: score.get(name) for name in places}
    return ["-" if value is None else f"{value:.{places[name]}f}" for name, value in values.items()]
