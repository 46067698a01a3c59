"""``voronerf join | cut | place``: runs of several parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import tyro

from voronerf.app.cli.display import busy, say
from voronerf.app.run import BOX
from voronerf.app.scenes.record import read_scene
from voronerf.app.train.callbacks import counted
from voronerf.app.train.config import ConfigError
from voronerf.app.wording import as_typed
from voronerf.editing import edits
from voronerf.editing.edits import RunContents, check_out
from voronerf.editing.geometry import Similarity, Solid

#: The text that describes a transform in error messages.
MOVE = "seven finite numbers tx ty tz rx ry rz s, the scale s 1e-9 to 1e9"


def tell(out: Path, written: RunContents) -> int:
    """Prints the path, cells, parts and size of a written run."""
    counts = {"cell": written.parts.num_cells, "part": len(written.parts.parts)}
    cells, parts = (counted(count, name) for name, count in counts.items())
    size = sum(file.stat().st_size for file in (out / "checkpoints").iterdir())
    say(f"wrote {out}: {cells} in {parts}, {size / 2**20:.1f} MiB")
    return 0


def join(
    runs: tuple[Path, ...],
    /,
    out: Path,
    move: tyro.conf.UseAppendAction[tuple[tuple[str, str], ...]] = (),
    align: bool = False,
) -> int:
    """Join several runs into one. Where they overlap, the nearest centre decides; the runs are not changed.

    Args:
        runs: Two run directories or more; the first gives data, background and settings.
        out: The new run directory.
        move: N "tx ty tz rx ry rz s", once for each run to move: run N, counted from 1, is scaled by s, turned by
            angles in degrees about x, y, z, then moved.
        align: Find the transforms of all runs but the first, from the cameras of images that have the same name in
            both runs.
    """
    check_out(out)
    if len(runs) < 2:
        raise ConfigError(f"join needs two runs or more, got {len(runs)}")
    frames = given_frames(len(runs), move)
    if align and frames:
        raise ConfigError("give --align or --move, not both")
    if align:
        first, *others = (read_scene(run / "scene.json") for run in runs)
        for number, scene in enumerate(others, 1):
            frame, error, count = edits.align(first, scene, str(runs[number]))
            say(
                f"{runs[number]}: scale {frame.scale:.6g}, {count} images in common, "
                f"their cameras {error:.3g} scene units apart"
            )
            frames[number] = frame
    transforms = [frames.get(number, Similarity()) for number in range(len(runs))]
    with busy("joining"):
        written = edits.join(runs, out, frames=transforms)
    return tell(out, written)


def given_frames(runs: int, move: Sequence[tuple[str, str]]) -> dict[int, Similarity]:
    """Parses --move into a transform for each moved run; runs are counted from 0."""
    frames: dict[int, Similarity] = {}
    for number, text in move:
        if not number.isdecimal() or not 1 <= int(number) <= runs:
            raise ConfigError(f"--move {number}: must be the number of a run, 1 to {runs}")
        if int(number) - 1 in frames:
            raise ConfigError(f"--move {number}: must be given once")
        try:
            tx, ty, tz, rx, ry, rz, s = map(float, text.replace(",", " ").split())
            frames[int(number) - 1] = Similarity.of((tx, ty, tz), (rx, ry, rz), s)
        except ValueError:
            raise ConfigError(f"--move {number} must be {MOVE}, got {text!r}") from None
    return frames


def cut(
    run: Path,
    /,
    out: Path,
    box: tuple[float, float, float, float, float, float] | None = None,
    sphere: tuple[float, float, float, float] | None = None,
    cells: tuple[int, ...] | None = None,
    outside: bool = False,
) -> int:
    """Make a new run with only a region of a run, or with --outside all but the region; the run is not changed.

    Args:
        run: The run directory.
        out: The new run directory.
        box: x y z of the lowest and of the highest corner.
        sphere: x y z of the centre, and the radius.
        cells: Numbers of cells, as the viewer shows them.
        outside: Keep everything outside the region instead.
    """
    check_out(out)
    named = {name: value for name, value in (("box", box), ("sphere", sphere), ("cells", cells)) if value is not None}
    if len(named) != 1:
        options = " and ".join(f"--{name}" for name in named) or "none"
        raise ConfigError(f"cut needs one of --box, --sphere and --cells, got {options}")
    try:
        solid = Solid.box(box[:3], box[3:]) if box is not None else None if sphere is None else Solid(ball=sphere)
    except ValueError:
        rule = BOX if box is not None else "finite x y z of the centre and a radius above 0"
        ((name, value),) = named.items()
        raise ConfigError(f"--{name} must be {rule}, got {as_typed(value)}") from None
    kept = list(cells or ()) if solid is None else solid
    with busy("cutting"):
        written = edits.cut(run, kept, out, outside=outside)
    return tell(out, written)


def place(
    run: Path,
    object_run: Path,
    /,
    out: Path,
    at: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> int:
    """Place an object into a scene, as a new run; its density is added to the scene's. Neither run is changed.

    Args:
        run: The run directory of the scene.
        object_run: The run directory of the object, cut out with voronerf cut, or trained on white.
        out: The new run directory.
        at: Position x y z in the scene of the bottom centre of the object's box.
        turn: Degrees about the axes x, y, z, in this order.
        scale: Factor on the object's size.
    """
    check_out(out)
    for name, value in (("at", at), ("turn", turn)):
        if not all(map(math.isfinite, value)):
            raise ConfigError(f"--{name} must be three finite numbers, got {as_typed(value)}")
    try:
        Similarity.of(scale=scale)
    except ValueError:
        raise ConfigError(f"--scale must be 1e-9 to 1e9, got {as_typed(scale)}") from None
    with busy("placing"):
        written = edits.place(run, object_run, at, out, degrees=turn, scale=scale)
    return tell(out, written)
