"""The paper's experiments with trainings: their variants and the published scores.

Both sides of every comparison have the same rays, samples, schedule and kernels. One rule sets all learning rates from
the width alone (see ``voronerf train --lr``). Published figures come from Elsner et al. 2023, "Adaptive Voronoi NeRFs":
400 x 400 images, 24 h on an RTX 2080 Ti.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from paper.runs import AS_PUBLISHED, Run, Settings, Variant, default_scenes, make_run, open_scene
from voronerf.app.train import TrainConfig
from voronerf.app.train.build import count_parameters
from voronerf.app.train.defaults import resolve

FIELDS = {"nerf": "NeRF", "mipnerf": "mip-NeRF"}
SAMPLINGS = ("stratified", "hierarchical")
WIDE, NARROW = "one network, width 256", "one network, width 64"
BALANCED, RANDOM, UNIFORM = "balanced centres", "random centres", "uniform centres"
INHERIT, FRESH = "inherited", "random parameters"
NEAREST, STOCHASTIC = "nearest cell", "stochastic assignment"
KILO_FIRST_STEPS = 16
KILO_START, KILO_LATE = f"512 uniform cells after {KILO_FIRST_STEPS} steps", "512 uniform cells, inherited"
KILO_CELLS = "16 x 16 Voronoi cells"
SPLIT_TIMES = (0.05, 0.1, 0.2, 0.4, 0.6)
COUNTS = (4, 8, 12, 16, 32)
DEFAULTS = "voronerf train"


class Scores(NamedTuple):
    """Scores of a training: PSNR in dB, SSIM, LPIPS."""

    psnr: float
    ssim: float
    lpips: float


CONDITIONS = "published: 400 x 400, 24 h, RTX 2080 Ti"
#: Published scores: (field, sampling, scene) -> (one network of width 256, 12 Voronoi cells of width 64).
PUBLISHED: dict[tuple[str, str, str], tuple[Scores, Scores]] = {
    ("nerf", "hierarchical", "lego"): (Scores(27.355, 0.9451, 0.0910), Scores(27.652, 0.9483, 0.0831)),
    ("mipnerf", "hierarchical", "lego"): (Scores(30.538, 0.9712, 0.0507), Scores(31.234, 0.9752, 0.0417)),
    ("nerf", "hierarchical", "ship"): (Scores(26.717, 0.8967, 0.2016), Scores(27.373, 0.9068, 0.1820)),
    ("mipnerf", "hierarchical", "ship"): (Scores(28.226, 0.9164, 0.1658), Scores(29.007, 0.9250, 0.1439)),
    ("nerf", "hierarchical", "drums"): (Scores(23.077, 0.9145, 0.1320), Scores(23.490, 0.9230, 0.1128)),
    ("mipnerf", "hierarchical", "drums"): (Scores(24.474, 0.9354, 0.1054), Scores(24.760, 0.9409, 0.0869)),
    ("nerf", "stratified", "lego"): (Scores(25.450, 0.912, 0.144), Scores(25.603, 0.917, 0.134)),
    ("mipnerf", "stratified", "lego"): (Scores(27.401, 0.945, 0.111), Scores(27.979, 0.949, 0.105)),
}
PUBLISHED_CELLS = 12
#: Published scores on Lego, with the same networks and time: (KiloNeRF's 512 uniform cells, 16 x 16 Voronoi cells).
KILONERF = (Scores(27.080, 0.938, 0.098), Scores(27.765, 0.952, 0.078))


@dataclass(frozen=True)
class Experiment:
    """One table or figure of the paper.

    Attributes:
        kind: The kind, "table" or "figure".
        about: A description of the comparison, printed above its table.
        variants: A function of the settings and a scene that returns the variants.
        scenes: The scenes to train if the settings name none.
        published: A function of a variant and a scene that returns the published scores, or None.
    """

    kind: str
    about: str
    variants: Callable[[Settings, str], list[Variant]]
    scenes: Callable[[], tuple[str, ...]] = default_scenes
    published: Callable[[str, str], Scores | None] = lambda variant, scene: None

    def runs(self, settings: Settings) -> list[Run]:
        """Returns the trainings."""
        return [
            make_run(variant, scene, seed, settings)
            for scene in settings.scene or self.scenes()
            for variant in self.variants(settings, scene)
            for seed in range(settings.seeds)
        ]


def cells_name(count: int) -> str:
    """Returns the name of the variant with balanced cells."""
    return f"{count} Voronoi cells, width 64"


def uniform_name(count: int) -> str:
    """Returns the name of the variant with `count` cells on a uniform grid."""
    return f"{count} uniform cells, width 64"


def levels_name(cells: tuple[int, ...]) -> str:
    """Returns a name with the cells of each level: "12 cells", "4 x 4 cells"."""
    return f"{' x '.join(map(str, cells))} cells" if cells else "one network"


def one_or_cells(settings: Settings, scene: str = "") -> list[Variant]:
    """Returns three variants: one network of width 256, one of width 64, and the cells."""
    return [
        Variant(WIDE, {"cells": (), "width": 256}),
        Variant(NARROW, {"cells": (), "width": 64}),
        Variant(cells_name(settings.cells), {"cells": (settings.cells,), "width": 64}),
    ]


def row_name(field: str, sampling: str, network: str) -> str:
    """Returns the name of a row in the tables by field and sampling."""
    return f"{FIELDS[field]}, {sampling}: {network}"


# --- tables by field and sampling -----------------------------------------------------------------------------------


def _crossed(samplings: Sequence[str]) -> Callable[[Settings, str], list[Variant]]:
    def variants(settings: Settings, scene: str) -> list[Variant]:
        found = []
        for field in FIELDS:
            for sampling in samplings:
                networks = one_or_cells(settings)
                extra: dict[str, Any] = {"field": field}
                if sampling == "stratified":
                    changes = {"cells": (settings.cells,), "width": 64, "centres": "uniform"}
                    networks.append(Variant(uniform_name(settings.cells), changes))
                else:
                    extra["sampling"] = sampling
                found += [Variant(row_name(field, sampling, v.name), {**v.changes, **extra}) for v in networks]
        return found

    return variants


def _published(variant: str, scene: str) -> Scores | None:
    if variant == DEFAULTS:  # compared with the paper's best: mip-NeRF with hierarchical samples and cells
        variant = row_name("mipnerf", "hierarchical", cells_name(PUBLISHED_CELLS))
    for (field, sampling, where), scores in PUBLISHED.items():
        for network, score in zip((WIDE, cells_name(PUBLISHED_CELLS)), scores):
            if (where, row_name(field, sampling, network)) == (scene, variant):
                return score
    return None


# --- KiloNeRF -------------------------------------------------------------------------------------------------------


def _kilo_variants(settings: Settings, scene: str) -> list[Variant]:
    common = {"field": "kilonerf"}
    uniform = {**common, "cells": (512,), "centres": "uniform"}
    # KILO_LATE is split at the time of KILO_CELLS's first split, so that its cells inherit a trained network.
    first_split = (TrainConfig(field="kilonerf", cells=(16, 16)).plan[0].at,)
    return [
        Variant(KILO_START, {**uniform, "split_at": (KILO_FIRST_STEPS,)}),
        Variant(KILO_LATE, {**uniform, "split_at": first_split}),
        Variant(KILO_CELLS, {**common, "cells": (16, 16)}),
    ]


def _kilo_published(variant: str, scene: str) -> Scores | None:
    return {KILO_START: KILONERF[0], KILO_CELLS: KILONERF[1]}.get(variant) if scene == "lego" else None


# --- figures --------------------------------------------------------------------------------------------------------


def _changed(*variants: tuple[str, dict[str, Any]]) -> Callable[[Settings, str], list[Variant]]:
    """Returns a function that makes a variant for each (name, changes to the configuration).

    All variants have the number of cells in the settings.
    """
    return lambda settings, scene: [Variant(name, {"cells": (settings.cells,), **more}) for name, more in variants]


def _split_name(at: float) -> str:
    return f"split at {100 * at:.0f} %"


def _early_late_variants(settings: Settings, scene: str) -> list[Variant]:
    usual = (TrainConfig(cells=(settings.cells,)).plan[0].at,)
    times = [(_split_name(at), {} if (at,) == usual else {"split_at": (at,)}) for at in SPLIT_TIMES]
    return _changed(*times)(settings, scene)


def _cell_count_variants(settings: Settings, scene: str) -> list[Variant]:
    """Returns variants with different numbers of cells: with equal widths, and with equal total parameters."""
    levels: list[tuple[int, ...]] = [(), *((count,) for count in COUNTS), (4, 4)]
    reference = TrainConfig(**{"data": scene, **AS_PUBLISHED, "cells": (PUBLISHED_CELLS,)})
    total = count_parameters(resolve(reference, open_scene(scene, settings)))
    own = [Variant(levels_name(cells), {"cells": cells}) for cells in levels]
    # The other variants match the parameters of 12 cells, so that the training with 12 cells serves both series.
    matched = [{"cells": cells} | ({} if cells == (PUBLISHED_CELLS,) else {"parameters": total}) for cells in levels]
    return own + [Variant(f"{levels_name(cells)}, matched", changes) for cells, changes in zip(levels, matched)]


_INITIALISED = _changed((INHERIT, {}), (FRESH, {"init": "random"}))

EXPERIMENTS: dict[str, Experiment] = {
    "convergence": Experiment(
        "figure",
        "Test PSNR over training time: one wide network, one narrow network, cells of narrow networks.",
        one_or_cells,
    ),
    "sampling": Experiment(
        "table",
        "NeRF and mip-NeRF, each with stratified and with hierarchical sampling: one network against cells.",
        _crossed(SAMPLINGS),
        scenes=lambda: default_scenes(2),
        published=_published,
    ),
    "architecture": Experiment(
        "table",
        "Hierarchical NeRF and mip-NeRF on several scenes: one network against cells.",
        _crossed(SAMPLINGS[1:]),
        scenes=lambda: default_scenes(3),
        published=_published,
    ),
    "at-size": Experiment(
        "table",
        "The defaults of `voronerf train`, beside the paper's best. With --downscale 1 in the paper's own size.",
        lambda settings, scene: [
            Variant(DEFAULTS, {name: getattr(TrainConfig(), name) for name in (*AS_PUBLISHED, "rays", "samples")})
        ],
        scenes=lambda: default_scenes(3),
        published=_published,
    ),
    "kilonerf": Experiment(
        "table",
        "Networks of KiloNeRF's size for the same time: a uniform grid of cells against nested Voronoi cells. "
        "The grid is there after 16 steps, KiloNeRF's from the start, or it inherits when the Voronoi cells do.",
        _kilo_variants,
        published=_kilo_published,
    ),
    "initialisation": Experiment(
        "figure", "New cells start as copies of their parent, or from random parameters.", _INITIALISED
    ),
    "ghosting": Experiment(
        "figure",
        "A held-out view soon after the split and at the end: inherited networks and random ones.",
        _INITIALISED,
    ),
    "density": Experiment(
        "figure", "Density on a horizontal slice: the coarse network, soon after the split, at the end.", _INITIALISED
    ),
    "split-kinds": Experiment(
        "figure",
        "Centres balanced by importance, drawn from the samples, or on a grid over them.",
        _changed((BALANCED, {}), (RANDOM, {"centres": "random"}), (UNIFORM, {"centres": "uniform"})),
    ),
    "early-late": Experiment("figure", "The time of the split, as a share of the run.", _early_late_variants),
    "cell-count": Experiment(
        "figure",
        "The number of cells, with networks of one width, and with the parameters of 12 such networks in total.",
        _cell_count_variants,
    ),
    "seams": Experiment(
        "figure",
        "Samples go to the nearest cell, or while training to one drawn from the distances.",
        _changed((NEAREST, {}), (STOCHASTIC, {"assignment": "stochastic"})),
    ),
    "title": Experiment(
        "figure",
        "Each pixel in the colour of its cell.",
        lambda settings, scene: [
            Variant(levels_name(cells), {"cells": cells}) for cells in ((settings.cells,), (4, 4))
        ],
    ),
}
