"""``voronerf info``: backends, instruction set and optional extras of this installation."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rich.markup import escape
from rich.table import Table

from voronerf.app import PACKAGES
from voronerf.app.cli.display import console, say
from voronerf.app.run import open_run
from voronerf.nerf import RayLoss
from voronerf.ops._core import backends


class Extra(NamedTuple):
    """An optional extra of the package: a line about its use, and the modules that it installs."""

    adds: str
    modules: tuple[str, ...]


EXTRAS = {
    "app": Extra("the command line, and voronerf.app in programs", PACKAGES),
    "export": Extra("voronerf export: points, meshes, cells", ("trimesh", "skimage", "scipy")),
    "viewer": Extra("voronerf view and train --view, in the browser", ("viser",)),
    "colmap": Extra("voronerf process: cameras of a video or of pictures", ("pycolmap",)),
    "warp": Extra("kernels in NVIDIA Warp (--backend warp)", ("warp",)),
    "tensorboard": Extra("train --tensorboard", ("tensorboard",)),
    "dev": Extra("checks of the source code", ("ruff", "mypy")),
}


def info(run: Path | None = None, /, *, ops: bool = False) -> int:
    """Show what this installation can use: build, instruction set, extras, backends, and why something is missing.

    Args:
        run: A run directory. If given, the command shows instead how a training step of this run is computed, and what
            prevents a faster implementation.
        ops: Show instead the devices and dtypes of each implementation of each operation.
    """
    if run is not None:
        opened = open_run(run)
        for line in RayLoss(opened.renderer).explain().splitlines():
            say(line)
        return 0
    if ops:
        _show_ops()
        return 0
    for name, value in backends.describe().items():
        values = value if isinstance(value, dict) else {"": value}
        for key, entry in values.items():
            text = ", ".join(map(str, entry)) or "none" if isinstance(entry, list) else str(entry)
            console.print(f"{f'{name} {key}'.strip():26} {text}", highlight=False, markup=False)
    for name, extra in EXTRAS.items():
        text = f"{extra.adds}: {_state(name, extra.modules)}"
        console.print(f"{f'extra {name}':26} {text}", highlight=False, markup=False)
    say("voronerf info --ops: where each operation runs, and for which dtypes")
    return 0


def _show_ops() -> None:
    """Prints the table of backends."""
    rows = {(row.op, row.backend): row for row in backends.table()}
    missing = dict.fromkeys(row.reason for row in rows.values() if row.dtypes and row.reason)
    numbers = {reason: number for number, reason in enumerate(missing, 1)}
    table = Table("op", *backends.BACKENDS, title="where each implementation runs, and for which dtypes")
    for op in backends.ops():
        texts = []
        for row in (rows[op, backend] for backend in backends.BACKENDS):
            where = f"{', '.join(row.devices)}: {', '.join(row.dtypes)}" if row.devices else ""
            note = f" [{numbers[row.reason]}]" if row.reason in numbers else ""
            texts.append(escape((where + note).strip() or "-"))
        table.add_row(op, *texts)
    console.print(table)
    for reason, number in numbers.items():
        console.print(f"[{number}] {reason}", highlight=False, markup=False)


def _state(name: str, modules: Sequence[str]) -> str:
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    return f"no {', '.join(missing)}; pip install 'voronerf[{name}]'" if missing else "installed"
