"""Markdown of the paper's experiments: what came out beside what was published."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from paper.published import CONDITIONS, Scores

Row = dict[str, Any]
PLACES = {"psnr": 2, "ssim": 4, "lpips": 4, "psnr_of_mean_error": 2}


def grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    return [f"| {' | '.join(header)} |", "|---" * len(header) + "|", *(f"| {' | '.join(line)} |" for line in lines)]


def score(values: Sequence[float | None], places: int) -> str:
    """Mean of the seeds, with their range where there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    mean = f"{statistics.fmean(known):.{places}f}"
    if len(known) == 1:
        return mean
    return f"{mean} ({min(known):.{places}f} to {max(known):.{places}f})"


def triple(scores: Scores | None) -> str:
    """PSNR / SSIM / LPIPS."""
    return "-" if scores is None else f"{scores.psnr:.3f} / {scores.ssim:g} / {scores.lpips:g}"


def training_table(rows: Sequence[Row], published: Callable[[str, str], Scores | None]) -> list[str]:
    """The table of an experiment made of trainings: a line a scene and variant, means and ranges over the seeds."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["variant"]), []).append(row)
    paper = any(published(variant, scene) for scene, variant in groups)
    header = ["scene", "variant", "PSNR", "SSIM", "LPIPS", "PSNR of the mean error"]
    header += ([CONDITIONS] if paper else []) + ["cells", "width", "parameters", "steps"]
    lines = []
    for (scene, variant), group in groups.items():
        scores = [score([row.get(name) for row in group], places) for name, places in PLACES.items()]
        sizes = [_range([row.get(name) for row in group]) for name in ("cells", "width", "parameters", "steps")]
        middle = [triple(published(variant, scene))] if paper else []
        lines.append([scene, variant, *scores, *middle, *sizes])
    return grid(header, lines)


def _range(values: Sequence[int | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    low, high = min(known), max(known)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def nested_table(rows: Sequence[Row]) -> list[str]:
    """The table of the nested fit of a picture."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["variant"]), []).append(row)
    lines = [
        [
            scene,
            variant,
            score([row["psnr"] for row in group], 2),
            *(_range([row[name] for row in group]) for name in ("cells", "width", "parameters", "steps")),
        ]
        for (scene, variant), group in groups.items()
    ]
    return grid(("scene", "variant", "PSNR", "cells", "width", "parameters", "steps"), lines)


def balance_table(rows: Sequence[Row]) -> list[str]:
    """The table of the experiment on balance."""
    lines = []
    for row in rows:
        quartiles = [
            statistics.quantiles(row[name], n=4) if len(row[name]) > 1 else [] for name in ("before_all", "after_all")
        ]
        before, after = (f", quartiles {q[0]:.4f} and {q[2]:.4f}" if q else "" for q in quartiles)
        lines.append(
            [
                row["variant"],
                f"{row['before']:.4f}{before}",
                f"{row['after']:.4f}{after}",
                f"{max(row['after_all']):.4f}",
            ]
        )
    return grid(("samples", "median before", "median after", "worst after"), lines)


CLAIM = ("claim", "published", "here", "holds?")


def claim_line(claim: Mapping[str, str]) -> list[str]:
    """A claim, what was published, what came out, whether it holds."""
    return [claim["claim"], claim["published"], claim["here"], claim["verdict"]]


def claims_table(claims: Sequence[Mapping[str, str]]) -> list[str]:
    """The claims of one experiment."""
    return grid(CLAIM, [claim_line(claim) for claim in claims])


def all_claims_table(outcomes: Iterable[Mapping[str, Any]]) -> list[str]:
    """The claims of several experiments, each with the training seconds, seeds and pixels that it was judged by."""
    lines = []
    for outcome in outcomes:
        described = outcome["metadata"]
        size = described.get("size")
        # balance is judged over diagrams, which the claim names
        trained = "diagrams" not in described
        under = [f"{described['budget_seconds']:g}", str(described["seeds"])] if trained else ["-", "-"]
        under.append(f"{size[1]} x {size[0]}" if size else "-")
        lines += [[*claim_line(claim), *under] for claim in outcome.get("claims", [])]
    # two experiments that share trainings may judge the same claim by the same figures
    return grid((*CLAIM, "seconds", "seeds", "image size"), list({tuple(line): line for line in lines}.values()))


def markdown(name: str, outcome: dict[str, Any], published: Callable[[str, str], Scores | None]) -> list[str]:
    """Tables of one experiment from its JSON."""
    rows = outcome["results"]
    if name == "balance":
        found = balance_table(rows)
    elif name == "nested-2d":
        found = nested_table(rows)
    else:
        found = training_table(rows, published)
    claims = outcome.get("claims", [])
    return [*found, *(["", *claims_table(claims)] if claims else [])]
