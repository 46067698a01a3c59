"""Draws the figures of docs/method.md with the library, and the chart of README.md, into docs/images.

python docs/scripts/figures.py
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import torch
from matplotlib.patches import Rectangle
from torch import Tensor

from voronerf import VoronoiDiagram, balance, cell_sort, split_diagram

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parents[1]
OUT = DOCS / "images" / "method"
COLOURS = plt.get_cmap("tab20").colors
SIZE = 500  # pixels along a side of a drawn plane


def main() -> None:
    """Draws every figure."""
    OUT.mkdir(parents=True, exist_ok=True)
    points, importance = samples()
    draw_balance(points, importance)
    draw_nested(points, importance)
    draw_sort()
    draw_loops()


def samples() -> tuple[Tensor, Tensor]:
    """Returns random samples in the plane z = 0, and their importance: a disc, and a small cluster that weighs more."""
    generator = torch.Generator().manual_seed(1)
    disc = torch.rand(8000, 2, generator=generator) * 2 - 1
    disc = disc[disc.norm(dim=1) < 0.85][:2000]
    detail = torch.tensor([0.35, 0.3]) + 0.14 * torch.randn(1000, 2, generator=generator)
    flat = torch.cat([disc, detail])
    points = torch.cat([flat, torch.zeros(len(flat), 1)], 1)
    importance = torch.cat([torch.full((2000,), 0.3), torch.ones(1000)])
    return points, importance


def plane() -> Tensor:
    """Returns the points [SIZE, SIZE, 3] of the drawn square."""
    line = torch.linspace(-1, 1, SIZE)
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], -1)


def show_cells(axes: plt.Axes, colours: Tensor, cells: Tensor, *, lines: float = 1.0) -> None:
    """Paints each pixel in a pale colour of its cell, with white borders."""
    picture = colours[cells.long()] * 0.55 + 0.45
    axes.imshow(picture, extent=(-1, 1, -1, 1), origin="lower", interpolation="nearest")
    line = torch.linspace(-1, 1, SIZE)
    for cell in cells.unique().tolist():
        axes.contour(line, line, (cells == cell).float(), levels=[0.5], colors="white", linewidths=lines)
    axes.set_xticks([])
    axes.set_yticks([])


def palette(count: int) -> Tensor:
    """Returns colours [count, 3], which repeat after `COLOURS`."""
    return torch.tensor([COLOURS[i % len(COLOURS)] for i in range(count)])


def draw_balance(points: Tensor, importance: Tensor) -> None:
    """Draws random and balanced centres, and the importance in every cell."""
    k = 16
    figure, axes = plt.subplots(2, 2, figsize=(8, 5.6), height_ratios=[3, 1], constrained_layout=True)
    for column, steps in enumerate((0, 500)):
        result = balance(points, importance, k, steps=steps, generator=torch.Generator().manual_seed(18))
        above, below = axes[:, column]
        show_cells(above, palette(k), VoronoiDiagram(result.centres).locate(plane()))
        above.scatter(*points[::3, :2].T, s=2, c="#333333", linewidths=0)
        above.scatter(*result.centres[:, :2].T, s=60, c=palette(k), edgecolors="black", zorder=3)
        above.set_title("centres drawn from the samples" if steps == 0 else "after 500 steps of balancing")
        share = result.after / result.after.max()
        below.bar(range(k), share, color=palette(k).numpy())
        below.set_ylim(0, 1.05)
        below.set_xticks([])
        below.set_ylabel("importance / largest")
        below.set_title(f"standard deviation {result.imbalance_after:.4f}", fontsize=10)
    figure.savefig(OUT / "balance.png", dpi=110)
    plt.close(figure)


def draw_nested(points: Tensor, importance: Tensor) -> None:
    """Draws a diagram of four cells, and a nested diagram with four cells in each of these cells."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 4.2), constrained_layout=True)
    diagram = VoronoiDiagram(torch.zeros(1, 3))
    for axis, title in zip(axes, ("4 cells", "4 x 4 cells")):
        generator = torch.Generator().manual_seed(6)
        diagram = split_diagram(diagram, points, importance, 4, min_samples=1, generator=generator).diagram
        parents = palette(4)[diagram.paths()[:, 0]]
        own = 0.75 + 0.5 * (diagram.paths()[:, -1:] % 4) / 3 if diagram.depth > 1 else 1.0
        cells = diagram.locate(plane())
        show_cells(axis, (parents * own).clamp(0, 1), cells, lines=0.8)
        axis.scatter(*points[::4, :2].T, s=2, c="#333333", linewidths=0)
        axis.set_title(title)
    figure.savefig(OUT / "nested.png", dpi=110)
    plt.close(figure)


def draw_sort() -> None:
    """Draws samples in the order of the batch, and sorted by cell with offsets and stacked weights."""
    cells = torch.tensor([2, 0, 1, 0, 2, 2, 1, 0, 2, 0], dtype=torch.int32)
    order, offsets = cell_sort(cells, 3)
    figure, axis = plt.subplots(figsize=(8, 3.1), constrained_layout=True)
    colours = palette(3)
    rows = (("samples as they come", 2.2, cells, None), ("sorted by cell", 0.9, cells[order.long()], order))
    for title, y, row, labels in rows:
        axis.text(-0.3, y + 0.32, title, ha="right", va="center")
        for x, cell in enumerate(row.tolist()):
            axis.add_patch(Rectangle((x, y), 0.9, 0.65, color=tuple(colours[cell].tolist())))
            axis.text(x + 0.45, y + 0.32, str(x if labels is None else int(labels[x])), ha="center", va="center")
    for cell in range(3):
        first, last = int(offsets[cell]), int(offsets[cell + 1])
        axis.plot([first, last - 0.1], [0.72, 0.72], color=tuple(colours[cell].tolist()), lw=3)
        label = f"network {cell}: weight[{cell}]"
        axis.text((first + last - 0.1) / 2, 0.35, label, ha="center", va="center", fontsize=9)
    axis.text(-0.3, 0.35, f"offsets = {offsets.tolist()}", ha="right", va="center")
    axis.set_xlim(-4.2, 10.1)
    axis.set_ylim(0, 3)
    axis.axis("off")
    figure.savefig(OUT / "sort.png", dpi=110)
    plt.close(figure)


def draw_loops() -> None:
    """Plots the time of running all cells' networks, for the library and for PyTorch's fastest loop over cells."""
    measured = json.loads((DOCS.parent / "benchmarks" / "results" / "throughput.json").read_text())
    rows = {
        (row["case"], row["dtype"], row["direction"]): row
        for row in measured["results"]
        if (row["op"], row["backend"]) == ("routed_mlp", "native")
    }
    names = {
        "nerf64 n=262144 k=16": "16 NeRFs of width 64",
        "w64d4 n=262144 k=16": "16 MLPs of width 64",
        "mlp32 n=262144 k=256": "256 MLPs of width 32",
    }
    figure, axis = plt.subplots(figsize=(8, 3.2), constrained_layout=True)
    chosen = [rows[case, "float32", "forward+backward"] for case in names]
    sides = {
        "voronerf": ("#00897b", [row["median_ms"] for row in chosen]),
        "the fastest loop over cells in PyTorch": ("#9e9e9e", [min(row["alternatives"].values()) for row in chosen]),
    }
    for shift, (name, (colour, times)) in zip((-0.19, 0.19), sides.items()):
        bars = axis.barh([place + shift for place in range(len(times))], times, 0.36, color=colour, label=name)
        axis.bar_label(bars, [f"{time:.0f} ms" for time in times], padding=4, fontsize=9)
    axis.set_yticks(range(len(names)), names.values())
    axis.invert_yaxis()
    axis.set_xticks([])
    metadata = measured["metadata"]
    hardware = f"{metadata['threads']} threads of an {metadata['machine']}"
    axis.set_xlabel(f"forward and backward pass of 262,144 samples, float32, {hardware}", fontsize=9)
    axis.spines[["top", "right", "bottom"]].set_visible(False)
    figure.legend(loc="outside upper right", frameon=False, ncols=2)
    figure.savefig(DOCS / "images" / "loops.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
