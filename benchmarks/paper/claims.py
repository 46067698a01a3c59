"""The claims of the paper, and whether the figures of a run agree: every verdict is computed from them."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Row = dict[str, Any]


class Rows:
    """Results by scene and variant, a value a seed."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = list(rows)

    @property
    def scenes(self) -> list[str]:
        """The scenes in the order of the results."""
        return list(dict.fromkeys(row["scene"] for row in self.rows))

    @property
    def variants(self) -> list[str]:
        """The variants in the order of the results."""
        return list(dict.fromkeys(row["variant"] for row in self.rows))

    def of(self, variant: str, scene: str | None = None) -> list[Row]:
        """The rows of a variant, of one scene or of all, by seed."""
        found = [row for row in self.rows if row["variant"] == variant and scene in (None, row["scene"])]
        return sorted(found, key=lambda row: (row["scene"], row["seed"]))

    def values(self, variant: str, scene: str | None = None, metric: str = "psnr") -> list[float]:
        """A metric of a variant, a value a seed; those that were not measured are left out."""
        return [row[metric] for row in self.of(variant, scene) if row.get(metric) is not None]

    def mean(self, variant: str, scene: str | None = None, metric: str = "psnr") -> float | None:
        """Its mean; None without values."""
        values = self.values(variant, scene, metric)
        return statistics.fmean(values) if values else None

    def gains(
        self, better: str, worse: str, scene: str | None = None, value: Callable[[Row], float | None] | None = None
    ) -> list[float]:
        """Difference between two variants, for each scene and seed that both have; PSNR by default."""
        return list(self.paired(better, worse, scene, value).values())

    def paired(
        self, better: str, worse: str, scene: str | None = None, value: Callable[[Row], float | None] | None = None
    ) -> dict[tuple[str, int], float]:
        """The same by scene and seed."""
        get = value or (lambda row: row.get("psnr"))
        first, second = ({(row["scene"], row["seed"]): row for row in self.of(name, scene)} for name in (better, worse))
        pairs = {key: (get(row), get(second[key])) for key, row in first.items() if key in second}
        return {key: a - b for key, (a, b) in pairs.items() if a is not None and b is not None}


class Claim(NamedTuple):
    """A claim, the published figure, the figure here, and whether they agree."""

    claim: str
    published: str
    here: str
    verdict: str


NOT_MEASURED = "not measured"


def verdict(gains: Sequence[float], wanted: float = 0.0) -> str:
    """Whether a gain is there: for every seed, in the mean, by less than wanted, or not."""
    if not gains:
        return NOT_MEASURED
    single = " (one seed)" if len(gains) == 1 else ""
    mean = statistics.fmean(gains)
    if min(gains) > 0 and min(gains) >= wanted:
        return f"holds{single or ' for every seed'}"
    if mean > 0 and mean >= wanted:
        return "holds in the mean, not for every seed"
    if wanted > 0 and mean > 0:
        every = single or (" for every seed" if min(gains) > 0 else " in the mean")
        return f"the order holds{every}, by less than {wanted:g}"
    return f"does not hold{single}"


def spread(values: Sequence[float], unit: str = "dB", sign: bool = True) -> str:
    """The mean of some values and their range: "+1.20 dB (+1.05 to +1.35)"."""
    if not values:
        return "-"
    form = "{:+.2f}" if sign else "{:.2f}"
    mean = f"{form.format(statistics.fmean(values))} {unit}".strip()
    if len(values) == 1:
        return mean
    return f"{mean} ({form.format(min(values))} to {form.format(max(values))})"


def gain_claim(claim: str, published: str, gains: Sequence[float], wanted: float = 0.0, unit: str = "dB") -> Claim:
    """A claim that one variant is better than another."""
    return Claim(claim, published, spread(gains, unit), verdict(gains, wanted))


def order_claim(claim: str, published: str, rows: Rows, variants: Sequence[str], scene: str | None = None) -> Claim:
    """A claim that variants come in an order, the best first."""
    steps = [rows.gains(a, b, scene) for a, b in itertools.pairwise(variants)]
    if not all(steps):
        return Claim(claim, published, "-", NOT_MEASURED)
    means = [rows.mean(name, scene) for name in variants]
    here = ", ".join(f"{name} {mean:.2f}" for name, mean in zip(variants, means) if mean is not None)
    here += "; " + ", ".join(f"{a} over {b} {spread(g)}" for a, b, g in zip(variants, variants[1:], steps))
    verdicts = [verdict(step) for step in steps]
    if all(text.startswith(("holds for", "holds (")) for text in verdicts):
        return Claim(claim, published, here, verdicts[0])
    if all(text.startswith("holds") for text in verdicts):
        return Claim(claim, published, here, "holds in the mean, not for every seed")
    parts = [f"{a} over {b}: {text}" for a, b, text in zip(variants, variants[1:], verdicts)]
    return Claim(claim, published, here, "; ".join(parts))


def at_look(row: dict[str, Any], look: str, value: str) -> float | None:
    """A number of a run's look, such as its seam measure; None where it was not measured."""
    return next((entry.get(value) for entry in row["looks"] if entry["look"] == look), None)


def fewer_seams(rows: Rows, scene: str, usual: str, other: str, looks: Sequence[str]) -> list[float]:
    """By how many per cent of the usual variant's mean the other's seams are lower, for each seed.

    For each seed, only looks that both variants have count.
    """
    others = {row["seed"]: row for row in rows.of(other, scene)}
    means = []
    for row in rows.of(usual, scene):
        if row["seed"] not in others:
            continue
        pairs = [(at_look(row, name, "seam"), at_look(others[row["seed"]], name, "seam")) for name in looks]
        shared = [(a, b) for a, b in pairs if a is not None and b is not None]
        if shared:
            means.append((statistics.fmean(a for a, _ in shared), statistics.fmean(b for _, b in shared)))
    level = statistics.fmean(a for a, _ in means) if means else 0.0
    return [100 * (a - b) / level for a, b in means] if level > 0 else []


def at_share(row: Row, share: float) -> float | None:
    """PSNR of a run at a share of its time, between its evaluations in a straight line; None before the first."""
    points = [(entry["seconds"], entry["psnr"]) for entry in row["curve"]]
    if not points:
        return None
    second = share * points[-1][0]
    if second < points[0][0] - 1e-9:
        return None
    for (t0, p0), (t1, p1) in itertools.pairwise(points):
        if second <= t1:
            return float(p0 + (p1 - p0) * (second - t0) / max(t1 - t0, 1e-9))
    return float(points[-1][1])


def growing_claim(claim: str, published: str, rows: Rows, better: str, worse: str, scene: str | None) -> Claim:
    """A claim that a lead grows with the time: its size at 60 %, 80 % and the end."""
    shares = (0.6, 0.8, 1.0)
    by_seed = [rows.paired(better, worse, scene, lambda row, share=share: at_share(row, share)) for share in shares]
    shared = [key for key in by_seed[-1] if all(key in found for found in by_seed)]
    if not shared:
        return Claim(claim, published, "-", NOT_MEASURED)
    leads = [[found[key] for key in shared] for found in by_seed]
    here = ", ".join(f"{statistics.fmean(lead):+.2f} at {100 * share:.0f} %" for share, lead in zip(shares, leads))
    changes = [last - first for first, last in zip(leads[0], leads[-1])]
    leading = statistics.fmean(leads[-1]) > 0
    text = verdict(changes) if leading else "does not hold: there is no lead at the end"
    return Claim(claim, published, here, text)


def equal_claim(claim: str, published: str, gains: Sequence[float], tolerance: float, unit: str = "dB") -> Claim:
    """A claim that two variants come out alike: their difference within a tolerance."""
    if not gains:
        return Claim(claim, published, "-", NOT_MEASURED)
    single = " (one seed)" if len(gains) == 1 else ""
    if max(map(abs, gains)) <= tolerance:
        text = f"holds{single or ' for every seed'}"
    elif abs(statistics.fmean(gains)) <= tolerance:
        text = "in the mean only"
    else:
        text = f"does not hold{single}"
    return Claim(claim, published, spread(gains, unit), f"{text} (within {tolerance:g} {unit})")
