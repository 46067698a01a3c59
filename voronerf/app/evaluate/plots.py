"""Plots of training curves."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from voronerf.app.files import write_bytes


def plot_curves(
    path: Path,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    *,
    splits: Mapping[str, Sequence[float]] | None = None,
    title: str = "",
) -> None:
    """Writes test PSNR over training time, one line per run, as a PNG.

    Args:
        path: The file.
        curves: For each label the points (seconds, PSNR in dB).
        splits: For each label the seconds at which its cells were split, drawn as dotted lines.
        title: The title above the axes.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    for label, points in curves.items():
        line = axes.plot(*zip(*points, strict=True), marker="o", markersize=3, label=label)[0]
        for second in (splits or {}).get(label, ()):
            axes.axvline(second, color=line.get_color(), linestyle=":", linewidth=1)
    axes.set_xlabel("training time [s]")
    axes.set_ylabel("test PSNR [dB]")
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    pyplot.close(figure)
    write_bytes(path, buffer.getvalue())
