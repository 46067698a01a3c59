"""Plots and pictures of the paper's experiments, from results and the snapshots in the run directories."""

from __future__ import annotations

import io
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from paper import looks as paper_looks
from paper.slices import picture_of_density
from voronerf.app.evaluate.panels import contact_sheet, picture_of_cells, picture_of_error, save_picture
from voronerf.app.files import write_bytes

matplotlib.use("Agg")
from matplotlib import pyplot

Row = dict[str, Any]
Point = tuple[float, float]
GRID = 200  # times at which curves of several seeds are averaged
DPI = 100


class Results:
    """The results by scene and variant, with one value per seed.

    Attributes:
        scenes: The scenes, in the order of the results.
        variants: The variants, in the order of the results.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = list(rows)
        self.scenes, self.variants = (list(dict.fromkeys(row[name] for row in rows)) for name in ("scene", "variant"))

    def of(self, variant: str, scene: str) -> list[Row]:
        """Returns the rows of a variant on a scene, one per seed."""
        found = [row for row in self.rows if row["variant"] == variant and row["scene"] == scene]
        return sorted(found, key=lambda row: int(row["seed"]))

    def values(self, variant: str, scene: str) -> list[float]:
        """Returns the measured PSNRs of a variant on a scene, one per seed."""
        return [row["psnr"] for row in self.of(variant, scene) if row.get("psnr") is not None]


def save(figure: Any, path: Path) -> Path:
    """Writes a plot as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    pyplot.close(figure)
    write_bytes(path, buffer.getvalue())
    return path


def panes(count: int, width: float = 5.6, height: float = 3.8) -> tuple[Any, list[Any]]:
    """Makes a figure with axes side by side."""
    figure, axes = pyplot.subplots(1, count, figsize=(width * count, height), layout="constrained", squeeze=False)
    for pane in axes[0]:
        pane.grid(alpha=0.3)
    return figure, list(axes[0])


def banded(axes: Any, label: str, curves: Sequence[Sequence[Point]], number: int = 0) -> Any:
    """Plots the mean of several curves over their common times, and the band from lowest to highest.

    ``number`` selects the colour, which is therefore the same in every pane.
    """
    curves = [curve for curve in curves if curve]
    if not curves:
        return None
    start, end = max(curve[0][0] for curve in curves), min(curve[-1][0] for curve in curves)
    marked = [t for t, _ in curves[0] if start <= t <= end]
    times = np.unique(np.concatenate((np.linspace(start, max(start, end), GRID), marked)))
    values = np.stack([np.interp(times, *zip(*curve)) for curve in curves])
    line = axes.plot(times, values.mean(0), label=label, color=f"C{number}")[0]
    if len(curves) > 1:
        axes.fill_between(times, values.min(0), values.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
    return line


def shown(evaluation: dict[str, Any]) -> Point:
    """Returns the training seconds and the PSNR of an evaluation.

    The PSNR is computed from the mean squared error over all views. An evaluation of a single picture has only the
    picture's PSNR.
    """
    return evaluation["seconds"], evaluation.get("psnr_of_mean_error", evaluation["psnr"])


def curves(path: Path, rows: Sequence[Row]) -> Path:
    """Plots PSNR of the mean squared error (as in the paper) over training seconds, one pane per scene.

    Bands are the range over the seeds, dotted lines the splits.
    """
    table = Results(rows)
    figure, axes = panes(len(table.scenes))
    for pane, scene in zip(axes, table.scenes):
        for number, variant in enumerate(table.variants):
            group = table.of(variant, scene)
            line = banded(pane, variant, [[shown(m) for m in row["curve"]] for row in group], number)
            for stage in (group[0].get("stages") or [])[1:] if group and line is not None else []:
                pane.axvline(stage["started_at_second"], color=line.get_color(), linestyle=":", linewidth=1)
        pane.set(xlabel="training time [s]", ylabel="test PSNR [dB]", title=scene)
        if pane.lines:
            pane.legend(fontsize=8)
    return save(figure, path)


def bars(path: Path, rows: Sequence[Row]) -> Path:
    """Plots the final PSNR of every variant, one pane per scene: the mean and each seed."""
    table = Results(rows)
    figure, axes = panes(len(table.scenes), 7.0, 0.9 + 0.3 * len(table.variants))
    for pane, scene in zip(axes, table.scenes):
        names = [name for name in table.variants if table.values(name, scene)][::-1]
        means = [statistics.fmean(table.values(name, scene)) for name in names]
        pane.barh(names, means, color="#9db7d5")
        for height, name in enumerate(names):
            values = table.values(name, scene)
            pane.plot(values, [height] * len(values), "k.", markersize=4)
        if means:
            lowest = min(min(table.values(name, scene)) for name in names)
            pane.set_xlim(left=max(0.0, lowest - 1.5))
        pane.set(xlabel="test PSNR [dB]", title=scene)
    return save(figure, path)


def counts(path: Path, rows: Sequence[Row]) -> Path:
    """Plots the final PSNR over the number of cells, with equal widths and with equal parameters."""
    table = Results(rows)
    figure, axes = panes(len(table.scenes))
    for pane, scene in zip(axes, table.scenes):
        for matched in (False, True):
            names = [name for name in table.variants if name.endswith("matched") == matched]
            widths = sorted({row["width"] for name in names for row in table.of(name, scene)})
            label = "parameters of 12 cells in total" if matched else f"width {', '.join(map(str, widths))}"
            points = []
            for name in names:
                values = table.values(name, scene)
                if values:
                    points.append((name.removesuffix(", matched"), statistics.fmean(values), min(values), max(values)))
            if points:
                labels, means, lows, highs = zip(*points)
                errors = [np.subtract(means, lows), np.subtract(highs, means)]
                pane.errorbar(labels, means, yerr=errors, marker="o", capsize=3, label=label)
        pane.set(ylabel="test PSNR [dB]", title=scene)
    axes[0].legend(fontsize=8)
    return save(figure, path)


def balance(path: Path, rows: Sequence[Row]) -> Path:
    """Plots std(W / max W) before and after balancing, as box plots."""
    figure, axes = panes(1)
    values, labels = [], []
    for row in rows:
        for when in ("before", "after"):
            values.append(row[f"{when}_all"])
            labels.append(f"{row['variant']},\n{when}".replace(", ", ",\n"))
    axes[0].boxplot(values)
    axes[0].set_xticks(range(1, len(labels) + 1), labels, fontsize=7)
    axes[0].set(yscale="log", ylabel="std(W / max W)")
    return save(figure, path)


# --- pictures -------------------------------------------------------------------------------------------------------


def _error(look: dict[str, Any]) -> Tensor:
    colour, truth = (torch.from_numpy(look[name]).float() / 255 for name in ("colour", "truth"))
    return picture_of_error(colour, truth)


def _cells(look: dict[str, Any]) -> Tensor:
    opacity = torch.from_numpy(look["opacity"]).float() / 255
    return picture_of_cells(torch.from_numpy(look["cells"]), opacity, torch.from_numpy(look["colour"]).float() / 255)


def _view(look: dict[str, Any]) -> Tensor:
    return torch.from_numpy(look["colour"])


def _density(look: dict[str, Any]) -> Tensor:
    return picture_of_density(torch.from_numpy(look["density"]).float())


def sheet(path: Path, rows: Sequence[Row], folder: Path, columns: Sequence[Column]) -> Path | None:
    """Draws pictures of the first seed, one row per scene and variant."""
    lines = []
    for row in rows:
        if row["seed"] != 0:
            continue
        pictures = {}
        for caption, name, draw in columns:
            look = paper_looks.load(folder / "runs" / row["run"], name)
            if look is not None:
                pictures[caption.format(variant=row["variant"], scene=row["scene"])] = draw(look)
        if len(pictures) == len(columns):
            lines.append(contact_sheet(pictures))
    if not lines:
        return None
    save_picture(path, stacked(lines))
    return path


def stacked(pictures: Sequence[Tensor]) -> Tensor:
    """Stacks pictures uint8 [h, w, 3] vertically; narrower pictures are padded with white."""
    width = max(picture.shape[1] for picture in pictures)
    return torch.cat([torch.nn.functional.pad(p, (0, 0, 0, width - p.shape[1]), value=255) for p in pictures])


def _truth(look: dict[str, Any]) -> Tensor:
    return torch.from_numpy(look["truth"])


Column = tuple[str, str, Callable[[dict[str, Any]], Tensor]]  # caption, name of the snapshot, its picture
_TITLE: list[Column] = [("{scene}", "end", _truth), ("{variant}", "end", _view), ("cells", "end", _cells)]
SHEETS: dict[str, list[Column]] = {
    "ghosting": [
        ("{scene}", "end", _truth),
        ("before the split", "before", _view),
        ("{variant}, soon after", "after", _view),
        ("error, soon after", "after", _error),
        ("{variant}, end", "end", _view),
        ("error, end", "end", _error),
    ],
    "density": [
        ("{scene}, coarse", "before", _density),
        ("{variant}, soon after", "after", _density),
        ("{variant}, end", "end", _density),
    ],
    "title": _TITLE,
    "split-kinds": _TITLE,
}
PLOTS: dict[str, Callable[[Path, Sequence[Row]], Path]] = {
    "sampling": bars,
    "architecture": bars,
    "kilonerf": curves,
    "convergence": curves,
    "initialisation": curves,
    "split-kinds": curves,
    "early-late": curves,
    "cell-count": counts,
    "at-size": curves,
    "seams": curves,
    "balance": balance,
}


def draw(name: str, rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draws the plots and pictures of an experiment into ``folder``; returns the files."""
    found: list[Path | None] = []
    if name in PLOTS and rows:
        found.append(PLOTS[name](folder / f"{name}.png", rows))
    if name in SHEETS and rows:
        found.append(sheet(folder / f"{name}-pictures.png", rows, folder, SHEETS[name]))
    return [path for path in found if path is not None and path.is_file()]
