"""The paper's experiments on when to split and into how many cells: their variants, and what they claim."""

from __future__ import annotations

from dataclasses import replace

from paper.claims import Claim, Rows, gain_claim, order_claim
from paper.runs import Variant, open_scene
from paper.settings import Settings
from voronerf.training.config import TrainConfig
from voronerf.training.networks import count_parameters, resolve_config

SPLIT_TIMES, TYPICAL = (0.05, 0.1, 0.2, 0.4, 0.6), 0.2
COUNTS = (4, 8, 12, 16, 32)


def early_late_variants(settings: Settings, scene: str) -> list[Variant]:
    """The same cells, split at different shares of the run."""
    usual = TrainConfig(cells=(settings.cells,)).splits
    return [
        Variant(
            f"split at {100 * at:.0f} %", {"cells": (settings.cells,)} | ({} if (at,) == usual else {"split_at": (at,)})
        )
        for at in SPLIT_TIMES
    ]


def early_late_claims(rows: Rows, settings: Settings) -> list[Claim]:
    """Whether a split before or after the usual time costs."""
    early, usual, late = (f"split at {100 * at:.0f} %" for at in (SPLIT_TIMES[0], TYPICAL, SPLIT_TIMES[-1]))
    return [
        gain_claim(f"{scene}: a {what} costs: {usual} beats {other}", "-", rows.gains(usual, other, scene))
        for scene in rows.scenes
        for what, other in (("too early split", early), ("too late split", late))
    ]


def cell_count_variants(settings: Settings, scene: str) -> list[Variant]:
    """Different numbers of cells, of one width, and of one number of parameters in total."""
    levels: list[tuple[int, ...]] = [(), *((count,) for count in COUNTS), (4, 4)]
    levels += [(16, 16)] if settings.large else []
    further = {name: value for name, value in settings.further.items() if name not in ("cells", "parameters")}
    reference = TrainConfig(**{"data": scene, "field": "nerf", "occupancy": False, "cells": (12,), **further})
    total = count_parameters(resolve_config(reference, open_scene(scene, replace(settings, seeds=1))))
    own = [Variant(levels_name(cells), {"cells": cells}) for cells in levels]
    # 12 cells are what the others are matched with: one training is both
    matched = [{"cells": cells} | ({} if cells == (12,) else {"parameters": total}) for cells in levels]
    return own + [Variant(f"{levels_name(cells)}, matched", changes) for cells, changes in zip(levels, matched)]


def cell_count_claims(rows: Rows, settings: Settings) -> list[Claim]:
    """Whether more cells are better, and whether they still are with as many parameters in total."""
    names = [levels_name((count,)) for count in COUNTS]
    most, fewest, alone = names[-1], names[0], levels_name(())
    order, found = names[::-1], []
    for scene in rows.scenes:
        gains = rows.gains(most, fewest, scene)
        found.append(gain_claim(f"{scene}: more cells are better at the same width: {most} beat {fewest}", "-", gains))
        found.append(
            order_claim(f"{scene}: each step to more cells is, from {fewest} to {most}", "-", rows, order, scene)
        )
        for better, worse in (("12 cells", alone), (most, fewest)):
            what = f"{scene}: with as many parameters in total {better} beat {worse}"
            found.append(gain_claim(what, "-", rows.gains(f"{better}, matched", f"{worse}, matched", scene)))
    return found


def levels_name(cells: tuple[int, ...]) -> str:
    """The cells of each level: "12 cells", "4 x 4 cells"."""
    return f"{' x '.join(map(str, cells))} cells" if cells else "one network"
