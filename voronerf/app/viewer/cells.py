"""What is known of a cell, as lines of Markdown."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from voronerf.app.viewer.pictures import Subject, groups_of


def read_samples(folder: Path) -> tuple[Tensor, Tensor] | None:
    """The samples that a run's last split was made from, [m, 3], and their importance [m]; None without them."""
    files = {int(found[1]): path for path in folder.glob("samples/*.npz") if (found := re.search(r"(\d+)$", path.stem))}
    if not files:
        return None
    try:
        with np.load(files[max(files)]) as stored:
            points, importance = (torch.from_numpy(stored[name]).float() for name in ("points", "importance"))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
    return (points, importance) if points.shape == (len(importance), 3) else None


def describe_cell(subject: Subject, leaf: int, level: int, psnr: tuple[str, float | None] | None) -> str:
    """A cell of a level: its number, where it is, its samples and their importance at the last split, its PSNR.

    Args:
        subject: what is viewed.
        leaf: any leaf in the cell.
        level: 1 is the coarsest.
        psnr: the name of the nearest view, and the PSNR of its pixels that the cell shows; None without images.
    """
    diagram = subject.diagram
    groups = groups_of(diagram, level)
    number = int(groups[leaf])
    inside = groups == number
    leaves = int(inside.sum())
    path = " / ".join(str(step) for step in diagram.paths()[leaf].tolist()[:level] if step >= 0)
    lines = [f"**Cell {number}** of {int(groups[-1]) + 1}" + (f" (path {path})" if diagram.depth > 1 else "")]
    if leaves > 1:
        lines.append(f"{leaves} cells of the finest level")
    else:
        lines.append("centre " + ", ".join(f"{value:.3f}" for value in diagram.leaf_centres[leaf].tolist()))
    samples = read_samples(subject.folder)
    if samples is not None:
        points, importance = samples
        mine = inside[diagram.locate(points.to(diagram.centres.device)).cpu().long()]
        share = float(importance[mine].sum() / importance.sum().clamp_min(1e-30))
        lines.append(f"{int(mine.sum())} of the {len(points)} samples of the last split, {share:.1%} of the importance")
    if psnr is not None:
        view, value = psnr
        lines.append(f"not in the nearest view, {view}" if value is None else f"PSNR {value:.2f} dB in {view}")
    return "  \n".join(lines)
