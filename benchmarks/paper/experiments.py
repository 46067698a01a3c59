"""The paper's experiments that are trainings: which variants each compares, and what it claims.

Both sides of every comparison have the same rays, samples, schedule and kernels; the learning rate follows from the
width alone, by one rule for all (see ``voronerf train --lr``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from paper.cells import cell_count_claims, cell_count_variants, early_late_claims, early_late_variants, levels_name
from paper.claims import Claim, Rows, at_look, equal_claim, fewer_seams, gain_claim, growing_claim, order_claim
from paper.published import CELLS, HIERARCHICAL, KILONERF, STRATIFIED, Scores
from paper.runs import Run, Variant, default_scenes, make_run
from paper.settings import Settings
from voronerf.training.config import ConfigError, TrainConfig

FIELDS = {"nerf": "NeRF", "mipnerf": "mip-NeRF"}
SAMPLINGS = ("stratified", "hierarchical")
WIDE, NARROW = "one network, width 256", "one network, width 64"
BALANCED, RANDOM, UNIFORM = "balanced centres", "random centres", "uniform centres"
LOOSE = "uniform centres, twice the box"
INHERIT, FRESH = "inherited", "random parameters"
NEAREST, STOCHASTIC = "nearest cell", "stochastic assignment"
KILO_START, KILO_LATE, KILO_CELLS = (
    "512 uniform cells after 16 steps",
    "512 uniform cells, inherited",
    "16 x 16 Voronoi cells",
)
KILO_FIRST_STEPS = 16
NEVER, TOO_EARLY, USUAL, LATE = "never split", "split at 2 %", "split at 20 %", "split at 50 %"
EARLY = ("after", "at-25", "at-50")
SOLID, TRANSLUCENT = "builtin", "builtin-translucent"


@dataclass(frozen=True)
class Experiment:
    """One table or figure of the paper.

    Attributes:
        kind: "table" or "figure".
        about: what it compares, for the reader of its table.
        variants: for some settings and a scene.
        claims: what the paper says, judged by the results.
        scenes: those of the settings, or its own where the user named none.
        published: the published scores of a variant on a scene, or None.
        metrics: columns.
    """

    kind: str
    about: str
    variants: Callable[[Settings, str], list[Variant]]
    claims: Callable[[Rows, Settings], list[Claim]] = lambda rows, settings: []
    scenes: Callable[[], tuple[str, ...]] = default_scenes
    published: Callable[[str, str], Scores | None] = lambda variant, scene: None

    def runs(self, settings: Settings) -> list[Run]:
        """Its trainings.

        Raises:
            ConfigError: When --options has what the variants differ in.
        """
        for scene in settings.scene or self.scenes():
            compared = {name for variant in self.variants(settings, scene) for name in variant.changes}
            if compared & settings.further.keys():
                names = ", ".join(sorted(compared & settings.further.keys()))
                raise ConfigError(f"--options must not name what the experiment compares, got {names}")
        return [
            make_run(variant, scene, seed, settings, rate)
            for scene in settings.scene or self.scenes()
            for variant in self.variants(settings, scene)
            for rate in settings.rates
            for seed in range(settings.seeds)
        ]


def cells_name(count: int) -> str:
    """The paper's own variant."""
    return f"{count} Voronoi cells, width 64"


def uniform_name(count: int) -> str:
    """The same number of cells on a grid."""
    return f"{count} uniform cells, width 64"


def one_or_cells(settings: Settings) -> list[Variant]:
    """One network of width 256, one of width 64, the cells."""
    return [
        Variant(WIDE, {"cells": (), "width": 256}),
        Variant(NARROW, {"cells": (), "width": 64}),
        Variant(cells_name(settings.cells), {"cells": (settings.cells,), "width": 64}),
    ]


def rendered(field: str, sampling: str, settings: Settings) -> dict[str, Any]:
    """The settings of a field and a sampling; two passes share the samples of one."""
    changes: dict[str, Any] = {} if field == "nerf" else {"field": field}
    if sampling == "hierarchical":
        half = settings.samples // 2
        changes |= {"sampling": sampling, "samples": half, "fine_samples": settings.samples - half}
    return changes


def row_name(field: str, sampling: str, network: str) -> str:
    """The name of a row of the tables by field and sampling."""
    return f"{FIELDS[field]}, {sampling}: {network}"


def _crossed(samplings: Sequence[str]) -> Callable[[Settings, str], list[Variant]]:
    def variants(settings: Settings, scene: str) -> list[Variant]:
        found = []
        for field in FIELDS:
            for sampling in samplings:
                networks = one_or_cells(settings)
                if sampling == "stratified":
                    changes = {"cells": (settings.cells,), "width": 64, "centres": "uniform"}
                    networks.append(Variant(uniform_name(settings.cells), changes))
                extra = rendered(field, sampling, settings)
                found += [Variant(row_name(field, sampling, v.name), {**v.changes, **extra}) for v in networks]
        return found

    return variants


def _published(variant: str, scene: str) -> Scores | None:
    found: dict[str, Scores] = {}
    for field in FIELDS:
        tables = {"hierarchical": HIERARCHICAL.get((field, scene))}
        tables["stratified"] = STRATIFIED[field] if scene == "lego" else None
        for sampling, scores in tables.items():
            for network, score in zip((WIDE, cells_name(CELLS)), scores or ()):
                found[row_name(field, sampling, network)] = score
    return found.get(variant)


def _published_gain(better: str, worse: str, scene: str) -> str:
    high, low = _published(better, scene), _published(worse, scene)
    return f"{high.psnr - low.psnr:+.2f} dB" if high and low else "-"


def _kilo_published(variant: str, scene: str) -> Scores | None:
    if scene != "lego":
        return None
    return KILONERF[0] if variant == KILO_START else KILONERF[1] if variant == KILO_CELLS else None


def _crossed_claims(samplings: Sequence[str]) -> Callable[[Rows, Settings], list[Claim]]:
    def claims(rows: Rows, settings: Settings) -> list[Claim]:
        found = []
        for scene in rows.scenes:
            for field in FIELDS:
                for sampling in samplings:

                    def named(network: str, field: str = field, sampling: str = sampling) -> str:
                        return row_name(field, sampling, network)

                    cells, what = named(cells_name(settings.cells)), f"{scene}, {FIELDS[field]}, {sampling}: cells beat"
                    text = _published_gain(cells, named(WIDE), scene)
                    wide, narrow = rows.gains(cells, named(WIDE), scene), rows.gains(cells, named(NARROW), scene)
                    found.append(gain_claim(f"{what} one network of width 256, by 2 dB", text, wide, 2.0))
                    found.append(gain_claim(f"{what} one network of width 64, by 0.5 dB", "-", narrow, 0.5))
                    if sampling == "stratified":
                        uniform = named(uniform_name(settings.cells))
                        found.append(gain_claim(f"{what} uniform cells", "-", rows.gains(cells, uniform, scene)))
        return found

    return claims


def _kilo_variants(settings: Settings, scene: str) -> list[Variant]:
    # More samples a batch, so that 512 of them are there after a few steps; the same for all.
    common = {"field": "kilonerf", "reservoir_batches": 100}
    uniform = {**common, "cells": (512,), "centres": "uniform"}
    first = {"split_at_steps": (KILO_FIRST_STEPS,)}
    # The inherited grid is split when the Voronoi cells are for the first time.
    config = TrainConfig(field="kilonerf", cells=(16, 16))
    return [
        Variant(KILO_START, {**uniform, **first}),
        Variant(KILO_LATE, {**uniform, "split_at": config.splits[:1]}),
        Variant(KILO_CELLS, {**common, "cells": (16, 16)}),
    ]


def _kilo_claims(rows: Rows, settings: Settings) -> list[Claim]:
    text = f"{KILONERF[1].psnr - KILONERF[0].psnr:+.3f} dB"
    return [
        gain_claim(
            f"{scene}: 16 x 16 Voronoi cells beat {other}, by 0.5 dB",
            text if scene == "lego" and other == KILO_START else "-",
            rows.gains(KILO_CELLS, other, scene),
            0.5,
        )
        for scene in rows.scenes
        for other in (KILO_START, KILO_LATE)
    ]


def _convergence_claims(rows: Rows, settings: Settings) -> list[Claim]:
    cells = cells_name(settings.cells)
    return [
        claim
        for scene in rows.scenes
        for claim in (
            gain_claim(
                f"{scene}: cells beat one network of width 256, by 2 dB", "-", rows.gains(cells, WIDE, scene), 2
            ),
            gain_claim(
                f"{scene}: cells beat one network of width 64, by 0.5 dB", "-", rows.gains(cells, NARROW, scene), 0.5
            ),
            growing_claim(f"{scene}: the lead over width 64 grows with the time", "-", rows, cells, NARROW, scene),
        )
    ]


def _initialisation_variants(settings: Settings, scene: str) -> list[Variant]:
    cells = {"cells": (settings.cells,)}
    return [Variant(INHERIT, cells), Variant(FRESH, {**cells, "init": "random"})]


def _initialisation_claims(rows: Rows, settings: Settings) -> list[Claim]:
    found = []
    for scene in rows.scenes:
        gains = rows.gains(INHERIT, FRESH, scene)
        found.append(gain_claim(f"{scene}: inheritance beats random parameters on held-out views", "order", gains))
    return found


def _ghosting_claims(rows: Rows, settings: Settings) -> list[Claim]:
    found = []
    for scene in rows.scenes:
        for name, when in (("after", "soon after the split"), ("end", "at the end")):
            gains = rows.gains(INHERIT, FRESH, scene, lambda row, name=name: at_look(row, name, "psnr"))
            found.append(gain_claim(f"{scene}: {when} inherited networks show a held-out view better", "order", gains))
    return found


def _split_kind_variants(settings: Settings, scene: str) -> list[Variant]:
    cells = {"cells": (settings.cells,)}
    return [
        Variant(BALANCED, cells),
        Variant(RANDOM, {**cells, "centres": "random"}),
        Variant(UNIFORM, {**cells, "centres": "uniform"}),
        Variant(LOOSE, {**cells, "centres": "uniform", "uniform_scale": 2.0}),
    ]


def _split_kind_claims(rows: Rows, settings: Settings) -> list[Claim]:
    found = []
    for scene in rows.scenes:
        claim = f"{scene}: balanced centres beat random, random beat uniform"
        found.append(order_claim(claim, "order", rows, (BALANCED, RANDOM, UNIFORM), scene))
        claim = f"{scene}: balanced centres beat a grid over twice the box"
        found.append(gain_claim(claim, "-", rows.gains(BALANCED, LOOSE, scene)))
    return found


def _seam_variants(settings: Settings, scene: str) -> list[Variant]:
    cells = {"cells": (settings.cells,)}
    return [Variant(NEAREST, cells), Variant(STOCHASTIC, {**cells, "assignment": "stochastic"})]


def _seam_claims(rows: Rows, settings: Settings) -> list[Claim]:
    found = []
    for scene in rows.scenes:
        early, late = (fewer_seams(rows, scene, NEAREST, STOCHASTIC, looks) for looks in (EARLY, ("end",)))
        quality = rows.gains(STOCHASTIC, NEAREST, scene)
        found += [
            gain_claim(f"{scene}: stochastic assignment: fewer seams in the first half", "order", early, unit="%"),
            equal_claim(f"{scene}: as many seams at the end", "no difference", late, 10.0, "%"),
            equal_claim(f"{scene}: the same quality at the end", "no difference", quality, 0.2),
        ]
    return found


def _limit_variants(settings: Settings, scene: str) -> list[Variant]:
    cells = {"cells": (settings.cells,)}
    return [
        Variant(NEVER, {"cells": ()}),
        Variant(TOO_EARLY, {**cells, "split_at": (0.02,)}),
        Variant(USUAL, cells),
        Variant(LATE, {**cells, "split_at": (0.5,)}),
    ]


def _limit_claims(rows: Rows, settings: Settings) -> list[Claim]:
    found = []
    for scene in rows.scenes:
        name = f"{scene}, a control" if scene == SOLID else scene
        text = "in translucent scenes" if scene == TRANSLUCENT else "-"
        gains = rows.gains(USUAL, TOO_EARLY, scene)
        found.append(gain_claim(f"{name}: a split before anything is known hurts", text, gains))
    if {SOLID, TRANSLUCENT} <= set(rows.scenes):

        def more(scene: str, than: str, worse: str) -> list[float]:
            """By how much the usual split's gain over another variant is larger in a scene than in another."""
            first, second = (
                {seed: gain for (_, seed), gain in rows.paired(USUAL, worse, where).items()} for where in (scene, than)
            )
            return [first[seed] - second[seed] for seed in first if seed in second]

        hurts, helps = more(TRANSLUCENT, SOLID, TOO_EARLY), more(SOLID, TRANSLUCENT, NEVER)
        found.append(gain_claim("it hurts more where much is translucent than where all is solid", "order", hurts))
        found.append(gain_claim("cells help less where much is translucent than where all is solid", "order", helps))
    return found


def _title_variants(settings: Settings, scene: str) -> list[Variant]:
    return [Variant(levels_name(cells), {"cells": cells}) for cells in ((settings.cells,), (4, 4))]


EXPERIMENTS: dict[str, Experiment] = {
    "sampling": Experiment(
        "table",
        "NeRF and mip-NeRF, each with stratified and with hierarchical sampling: one network against cells.",
        _crossed(SAMPLINGS),
        _crossed_claims(SAMPLINGS),
        scenes=lambda: default_scenes(2),
        published=_published,
    ),
    "architecture": Experiment(
        "table",
        "Hierarchical NeRF and mip-NeRF on several scenes: one network against cells.",
        _crossed(SAMPLINGS[1:]),
        _crossed_claims(SAMPLINGS[1:]),
        scenes=lambda: default_scenes(3),
        published=_published,
    ),
    "kilonerf": Experiment(
        "table",
        "Networks of KiloNeRF's size for the same time: a uniform grid of cells against nested Voronoi cells. "
        "The grid is there after 16 steps, KiloNeRF's from the start, or it inherits when the Voronoi cells do.",
        _kilo_variants,
        _kilo_claims,
        published=_kilo_published,
    ),
    "convergence": Experiment(
        "figure",
        "Test PSNR over training time: one wide network, one narrow network, cells of narrow networks.",
        lambda settings, scene: one_or_cells(settings),
        _convergence_claims,
    ),
    "initialisation": Experiment(
        "figure",
        "New cells start as copies of their parent, or from random parameters.",
        _initialisation_variants,
        _initialisation_claims,
    ),
    "split-kinds": Experiment(
        "figure",
        "Centres balanced by importance, drawn from the samples, or on a grid: over the samples, or one that "
        "is twice as large along each axis, as if their place were not known.",
        _split_kind_variants,
        _split_kind_claims,
    ),
    "early-late": Experiment(
        "figure", "The time of the split, as a share of the run.", early_late_variants, early_late_claims
    ),
    "cell-count": Experiment(
        "figure",
        "The number of cells, with networks of one width, and with the parameters of 12 such networks in total.",
        cell_count_variants,
        cell_count_claims,
    ),
    "ghosting": Experiment(
        "figure",
        "A held-out view soon after the split and at the end: inherited networks and random ones.",
        _initialisation_variants,
        _ghosting_claims,
    ),
    "density": Experiment(
        "figure",
        "Density on a horizontal slice: the coarse network, soon after the split, at the end.",
        _initialisation_variants,
    ),
    "title": Experiment("figure", "Each pixel in the colour of its cell.", _title_variants),
    "seams": Experiment(
        "figure",
        "Samples go to the nearest cell, or while training to one drawn from the distances: seams over time.",
        _seam_variants,
        _seam_claims,
    ),
    "limits": Experiment(
        "figure",
        "A scene of fog and glass beside a solid one: no split, one before anything is known, the usual, a late one.",
        _limit_variants,
        _limit_claims,
        scenes=lambda: (TRANSLUCENT, SOLID),
    ),
}
