"""The targets of the project, and what the rows of a run reach.

Every target reads rows of the native backend; a row that was not measured leaves its target open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
FULL, HALF, FORWARD, BACKWARD = "float32", "bfloat16", "forward", "forward+backward"
BASE = 1 << 18


class Missing(Exception):
    """A row that a target needs is not there."""


class Rows:
    """The rows of the native backend by what identifies them."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self._rows = {
            (row["op"], row["case"], row["dtype"], row["direction"]): row for row in rows if row["backend"] == "native"
        }

    def get(self, op: str, case: str, dtype: str = FULL, direction: str = FORWARD) -> Row:
        """A row, or ``Missing``."""
        key = (op, case, dtype, direction)
        if key not in self._rows:
            raise Missing("/".join(key))
        return self._rows[key]

    def number(self, column: str, op: str, case: str, dtype: str = FULL, direction: str = FORWARD) -> float:
        """A row's number, or ``Missing`` where it has none."""
        value = self.get(op, case, dtype, direction)[column]
        if value is None:
            raise Missing(f"{column} of {op}/{case}")
        return float(value)

    def nanoseconds(self, op: str, case: str, dtype: str = FULL) -> float:
        """Of a sample."""
        row = self.get(op, case, dtype)
        return float(row["median_ms"]) * 1e6 / float(row["n"])

    def over(self, name: str, op: str, case: str, dtype: str = FULL, direction: str = FORWARD) -> float:
        """How many times faster than the best alternative whose name has this part."""
        row = self.get(op, case, dtype, direction)
        times = [value for other, value in row["alternatives"].items() if name in other and value is not None]
        if not times:
            raise Missing(f"{name} of {op}/{case}")
        return min(times) / float(row["median_ms"])


@dataclass(frozen=True)
class Target:
    """A figure to reach.

    Attributes:
        what: in words.
        wanted: the figure.
        unit: behind it.
        reach: the figure from the rows.
        most: the figure is to stay below ``wanted`` instead of above.
    """

    what: str
    wanted: float
    unit: str
    reach: Callable[[Rows], float]
    most: bool = False


def _mlp(net: str, n: int = BASE, suffix: str = "") -> str:
    return f"{net} n={n} k={256 if net == 'mlp32' else 16}{suffix}"


def _percent(net: str, dtype: str, wanted: float, suffix: str = "") -> Target:
    case = _mlp(net, suffix=suffix)
    what = f"grouped_mlp forward, {dtype}, {net}{suffix}"
    return Target(what, wanted, "% of peak", lambda rows: rows.number("percent_of_peak", "grouped_mlp", case, dtype))


def _training(net: str, wanted: float) -> list[Target]:
    case = _mlp(net)
    what = f"grouped_mlp forward + backward, float32, {net}"
    return [
        Target(what, wanted, "x the best torch loop", lambda r: r.over("loop", "grouped_mlp", case, FULL, BACKWARD)),
        Target(
            f"{what}, executed",
            80,
            "% of peak",
            lambda r: r.number("executed_percent_of_peak", "grouped_mlp", case, FULL, BACKWARD),
        ),
    ]


def _nearest(k: int, wanted: float) -> list[Target]:
    case = f"n={BASE} k={k}"
    return [
        Target(
            f"nearest_centre, k = {k}", wanted, "ns", lambda rows: rows.nanoseconds("nearest_centre", case), most=True
        ),
        Target(f"nearest_centre, k = {k}", 1, "x faiss", lambda rows: rows.over("faiss", "nearest_centre", case)),
    ]


def _route(net: str, dtype: str, wanted: float) -> Target:
    what = f"routed_mlp forward, {dtype}, {net}"
    return Target(what, wanted, "x the best torch pipeline", lambda r: r.over("torch", "routed_mlp", _mlp(net), dtype))


def _ratio(first: tuple[str, str], second: tuple[str, str], direction: str) -> Callable[[Rows], float]:
    """Time of the second over time of the first, (case, dtype) each."""

    def reach(rows: Rows) -> float:
        times = [rows.number("median_ms", "grouped_mlp", case, dtype, direction) for case, dtype in (first, second)]
        return times[1] / times[0]

    return reach


TARGETS: tuple[Target, ...] = (
    *[_percent(net, FULL, wanted) for net, wanted in (("w64d4", 85), ("nerf64", 85), ("mlp32", 65), ("nerf256", 92))],
    *[_percent(net, HALF, wanted) for net, wanted in (("w64d4", 75), ("nerf64", 80), ("mlp32", 45), ("nerf256", 94))],
    _percent("w64d4", FULL, 82, " avx2"),
    *_training("w64d4", 3),
    *_training("nerf64", 3),
    *_training("mlp32", 6),
    Target(
        "grouped_mlp forward + backward, bfloat16, nerf64",
        1.6,
        "x our own float32",
        _ratio((_mlp("nerf64"), HALF), (_mlp("nerf64"), FULL), BACKWARD),
    ),
    Target(
        "grouped_mlp forward, mlp32, 4,096 cells",
        60,
        "% of the speed of 16 cells",
        lambda rows: 100 * _ratio((f"mlp32 n={BASE} k=4096", FULL), (f"mlp32 n={BASE} k=16", FULL), FORWARD)(rows),
    ),
    Target(
        "grouped_mlp forward, w64d4, n = 1,024",
        6,
        "x the best torch loop",
        lambda rows: rows.over("loop", "grouped_mlp", _mlp("w64d4", 1024)),
    ),
    *[target for k, wanted in ((16, 0.6), (64, 2.0), (256, 7.0), (512, 14.0)) for target in _nearest(k, wanted)],
    Target(
        "nearest_centre, k = 4,096, frozen centres",
        30,
        "ns",
        lambda rows: rows.nanoseconds("nearest_centre", f"n={BASE} k=4096 frozen"),
        most=True,
    ),
    *[
        Target(
            f"cell_sort with offsets, n = {n:,}",
            wanted,
            "ns",
            lambda rows, n=n: rows.nanoseconds("cell_sort", f"n={n} k=256", "int32"),
            most=True,
        )
        for n, wanted in ((BASE, 0.6), (1 << 20, 1.3))
    ],
    *[
        _route(net, dtype, wanted)
        for net, wanteds in (("w64d4", (5.5, 9)), ("mlp32", (11, 16)))
        for dtype, wanted in zip((FULL, HALF), wanteds)
    ],
)
ELSEWHERE = (("Lego at 100 x 100, 16 cells, 8 minutes", "24 dB, 8,382 steps", "benchmarks/time_to_quality.py"),)
"""Targets that are measured by training."""


def reached(rows: Sequence[Row]) -> list[tuple[Target, float | None]]:
    """Every target with the figure of the rows; None where a row is missing."""
    native = Rows(rows)
    found: list[tuple[Target, float | None]] = []
    for target in TARGETS:
        try:
            found.append((target, target.reach(native)))
        except Missing:
            found.append((target, None))
    return found


def verdict(target: Target, value: float | None) -> str:
    if value is None:
        return "not measured"
    return "reached" if (value <= target.wanted if target.most else value >= target.wanted) else "missed"


def target_lines(rows: Sequence[Row]) -> list[str]:
    """The table of targets as text."""
    found = [f"{'target':58} {'wanted':>8} {'reached':>8}"]
    for target, value in reached(rows):
        sign = "<=" if target.most else ">="
        figure = "-" if value is None else f"{value:.2f}" if value < 10 else f"{value:.1f}"
        found.append(f"{target.what:58} {sign} {target.wanted:5g} {figure:>8}  {target.unit}: {verdict(target, value)}")
    return [*found, *(f"{what:58}    {wanted}: see {script}" for what, wanted, script in ELSEWHERE)]


@dataclass(frozen=True)
class Comparison:
    """One wide network in torch against cells of narrow ones here, taken apart.

    Attributes:
        dtype: of both.
        wide_torch_ms: one network of width 256, the best alternative.
        wide_ms: the same network on the kernels here.
        cells_ms: 16 cells of width 64 on the kernels here.
    """

    dtype: str
    wide_torch_ms: float
    wide_ms: float
    cells_ms: float

    @property
    def kernel(self) -> float:
        """What the kernels save: the same network, both ways."""
        return self.wide_torch_ms / self.wide_ms

    @property
    def architecture(self) -> float:
        """What cells save: both on the same kernels."""
        return self.wide_ms / self.cells_ms


def comparisons(rows: Sequence[Row]) -> list[Comparison]:
    """The paper's comparator, in the dtypes that were measured."""
    native, found = Rows(rows), []
    for dtype in (FULL, HALF):
        try:
            wide = native.get("grouped_mlp", f"nerf256 n={BASE} k=1", dtype)
            cells = native.get("grouped_mlp", _mlp("nerf64"), dtype)
        except Missing:
            continue
        times = [value for value in wide["alternatives"].values() if value is not None]
        if times:
            found.append(Comparison(dtype, min(times), wide["median_ms"], cells["median_ms"]))
    return found


def architecture_lines(rows: Sequence[Row]) -> list[str]:
    """What the kernels save and what the architecture saves, as text."""
    return [
        f"one network of width 256 against 16 cells of width 64, forward, {one.dtype}, n = {BASE:,}: "
        f"{one.wide_torch_ms:.0f} ms by the best alternative, {one.wide_ms:.0f} ms by the kernels here "
        f"({one.kernel:.2f} x by kernels), {one.cells_ms:.1f} ms with cells ({one.architecture:.1f} x by architecture)"
        for one in comparisons(rows)
    ]
