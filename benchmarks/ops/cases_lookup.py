"""Cases of nearest_centre, locate_cell and cell_sort. n points, k cells."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ops.case import FORWARD, Case, Contender, NotApplicable, Work, generator, optional, rotation, uniform_points
from voronerf import ops
from voronerf.diagram import VoronoiDiagram

CHUNK = 1 << 19
"""Distances that torch and numpy hold at a time: 2 MiB, what makes them fastest."""
CHECKED = 1 << 14
"""Points whose answer is compared with float64."""
FLOPS = 8
"""Of one squared distance: three differences, three products, two sums."""
ALL = ("native", "reference", "warp")

Lookup = Callable[[Tensor], Any]


def cases() -> list[Case]:
    """The rows of these ops."""
    n, single = 1 << 18, torch.float32
    found = []
    for k in (1, 16, 64, 256, 512, 4096):
        found.append(_nearest(n, k, single, backends=ALL if k == 16 else ("native",), quick=k == 16))
    found += [_nearest(count, 16, single) for count in (1 << 10, 1 << 14, 1 << 20)]
    found.append(_nearest(n, 16, torch.float64))
    for count, shape, quick in ((n, (16, 16), True), (n, (64, 64), False), (1 << 10, (16, 16), False)):
        name = "x".join(str(k) for k in shape)
        work = functools.partial(_locate_work, count, shape)
        shown = ALL if quick else ("native",)
        cells = int(np.prod(shape))
        found.append(Case("locate_cell", f"{name} n={count}", single, FORWARD, count, cells, work, shown, quick))
    for count, k in (
        (n, 1),
        (n, 16),
        (n, 64),
        (n, 256),
        (n, 512),
        (n, 4096),
        (1024, 256),
        (1 << 14, 256),
        (1 << 20, 256),
    ):
        base = (count, k) == (n, 256)
        work = functools.partial(_sort_work, count, k)
        name = f"n={count} k={k}"
        found.append(Case("cell_sort", name, torch.int32, FORWARD, count, k, work, ALL if base else ("native",), base))
    return found


def _nearest(
    n: int,
    k: int,
    dtype: torch.dtype,
    *,
    backends: tuple[str, ...] = ("native",),
    quick: bool = False,
) -> Case:
    name = f"n={n} k={k}"
    work = functools.partial(_nearest_work, n, k, dtype)
    return Case("nearest_centre", name, dtype, FORWARD, n, k, work, backends, quick)


def _nearest_work(n: int, k: int, dtype: torch.dtype, device: torch.device) -> Work:
    points = [uniform_points(n, seed, device, dtype) for seed in range(rotation(12 * n))]
    centres = uniform_points(k, 1000, device, dtype)

    def ours(backend: str) -> Contender:
        return Contender(lambda call: ops.nearest_centre(points[call % len(points)], centres, backend=backend))

    def using(make: Callable[[Tensor], Lookup]) -> Callable[[], Contender]:
        def set_up() -> Contender:
            find = make(centres)
            return Contender(lambda call: find(points[call % len(points)]), lambda found: torch.as_tensor(found).int())

        return set_up

    return Work(
        ours,
        {name: using(maker) for name, maker in LOOKUPS.items()},
        lambda cells: _wrong_cells(points[0], centres, cells),
        tolerance=0.01 * min(n, CHECKED),  # the expanded square misplaces some points
        amount=float(FLOPS) * n * k,
        bound="float32" if dtype == torch.float32 else "",
    )


def _wrong_cells(points: Tensor, centres: Tensor, cells: Tensor) -> float:
    """The number of ``CHECKED`` points whose centre is farther than another, in float64."""
    step = max(1, points.shape[0] // CHECKED)
    points, chosen = points[::step].double().cpu(), cells[::step].long().cpu()
    if int(chosen.min()) < 0 or int(chosen.max()) >= centres.shape[0]:
        return float("inf")
    wrong = 0
    for piece, choice in zip(points.split(1024), chosen.split(1024)):
        squared = (piece[:, None] - centres.double().cpu()).square().sum(2)
        wrong += int((squared.gather(1, choice[:, None])[:, 0] > squared.amin(1)).sum())
    return float(wrong)


def _torch_lookup(centres: Tensor) -> Lookup:
    """The expanded square in pieces that stay in cache: addmm and argmin."""
    squares, transposed = centres.square().sum(1), centres.t().contiguous()
    rows = max(256, CHUNK // centres.shape[0])

    def find(points: Tensor) -> Tensor:
        cells = torch.empty(points.shape[0], dtype=torch.int64, device=points.device)
        for start in range(0, points.shape[0], rows):
            piece = torch.addmm(squares, points[start : start + rows], transposed, alpha=-2)
            torch.argmin(piece, dim=1, out=cells[start : start + rows])
        return cells

    return find


def _numpy_lookup(centres: Tensor) -> Lookup:
    """The same in numpy, which is single-threaded but for the product."""
    table = _host(centres).numpy()
    squares, transposed = np.square(table).sum(1), np.ascontiguousarray(table.T) * -2
    rows = max(256, CHUNK // table.shape[0])

    def find(points: Tensor) -> np.ndarray:
        array, cells = points.numpy(), np.empty(points.shape[0], dtype=np.int64)
        for start in range(0, array.shape[0], rows):
            cells[start : start + rows] = (array[start : start + rows] @ transposed + squares).argmin(1)
        return cells

    return find


def _tree_lookup(centres: Tensor) -> Lookup:
    tree = optional("scipy.spatial").cKDTree(_host(centres).numpy())
    return lambda points: tree.query(points.numpy(), workers=torch.get_num_threads())[1]


LOOKUPS: dict[str, Callable[[Tensor], Lookup]] = {
    "torch addmm + argmin": _torch_lookup,
    "numpy": _numpy_lookup,
    "scipy cKDTree": _tree_lookup,
}


def _host(tensor: Tensor) -> Tensor:
    if tensor.device.type != "cpu":
        raise NotApplicable("runs on the CPU")
    return tensor


def _locate_work(n: int, shape: tuple[int, int], device: torch.device) -> Work:
    outer, inner = shape
    points = [uniform_points(n, seed, device) for seed in range(rotation(12 * n))]
    root = VoronoiDiagram(uniform_points(outer, 1000, torch.device("cpu")))
    scale = outer ** (-1 / 3)
    children = {
        leaf: root.centres[leaf] + scale * (torch.rand(inner, 3, generator=generator(leaf)) * 2 - 1)
        for leaf in range(outer)
    }
    diagram = root.refine(children)[0].to(device)

    def ours(backend: str) -> Contender:
        return Contender(
            lambda call: ops.locate_cell(
                points[call % len(points)],
                diagram.centres,
                diagram.child_offsets,
                diagram.child,
                depth=diagram.depth,
                backend=backend,
            )
        )

    levels = diagram.centres[:outer], diagram.centres[outer:].view(outer, inner, 3)

    def by_masks(make: Callable[[Tensor], Lookup]) -> Callable[[], Contender]:
        """Level by level: the root's cell, then for each of them the points in it."""

        def set_up() -> Contender:
            top, below = make(levels[0]), [make(centres) for centres in levels[1]]

            def run(call: int) -> Tensor:
                batch = points[call % len(points)]
                parents = torch.as_tensor(top(batch))
                leaves = torch.empty(n, dtype=torch.int32, device=device)
                for parent in range(outer):
                    rows = torch.nonzero(parents == parent)[:, 0]
                    leaves[rows] = (torch.as_tensor(below[parent](batch[rows])) + parent * inner).int()
                return leaves

            return Contender(run)

        return set_up

    def error(leaves: Tensor) -> float:
        """Points on the wrong side at either level, in float64."""
        leaves = leaves.long().cpu()
        parents = leaves // inner
        wrong = _wrong_cells(points[0], levels[0], parents)
        for parent in range(outer):
            rows = torch.nonzero(parents == parent)[:, 0]
            if rows.numel():
                wrong += _wrong_cells(points[0].cpu()[rows], levels[1][parent], leaves[rows] - parent * inner)
        return wrong

    return Work(
        ours,
        {"masks, torch addmm + argmin": by_masks(_torch_lookup)},
        error,
        tolerance=0.01 * n,
        amount=float(FLOPS) * n * (outer + inner),
        bound="float32",
    )


def _sort_work(n: int, k: int, device: torch.device) -> Work:
    centres = uniform_points(k, 1000, device)
    sets = rotation(4 * n)
    cells = [ops.nearest_centre(uniform_points(n, seed, device), centres) for seed in range(sets)]

    def ours(backend: str) -> Contender:
        return Contender(lambda call: ops.cell_sort(cells[call % sets], k, backend=backend))

    def torch_sort(dtype: torch.dtype) -> Callable[[], Contender]:
        def set_up() -> Contender:
            bounds = torch.arange(k, dtype=dtype, device=device)

            def run(call: int) -> tuple[Tensor, Tensor]:
                keys, order = torch.sort(cells[call % sets].to(dtype), stable=True)
                return order, torch.searchsorted(keys, bounds, out_int32=True)

            return Contender(run)

        return set_up

    def numpy_sort() -> Contender:
        arrays = [_host(tensor).numpy() for tensor in cells]
        dtype = np.int16 if k < 1 << 15 else np.int32
        bounds = np.arange(k, dtype=dtype)

        def run(call: int) -> tuple[np.ndarray, np.ndarray]:
            keys = arrays[call % sets].astype(dtype)
            order = keys.argsort(kind="stable")
            return order, keys[order].searchsorted(bounds)

        return Contender(run)

    def error(result: tuple[Any, Any]) -> float:
        """Number of entries that differ from numpy's stable sort."""
        expected = cells[0].cpu().numpy().argsort(kind="stable")
        order, offsets = (torch.as_tensor(part).cpu().numpy() for part in result)
        first = cells[0].cpu().numpy()[expected].searchsorted(np.arange(k))
        return float((order != expected).sum() + (offsets[:k] != first).sum())

    types = ((torch.uint8, 256), (torch.int16, 1 << 15))
    alternatives: dict[str, Callable[[], Contender]] = {
        f"torch sort {str(dtype).removeprefix('torch.')}": torch_sort(dtype) for dtype, most in types if k <= most
    }
    # At the least: read every cell once, write the order and the offsets.
    amount = 8.0 * n + 4 * (k + 1)
    return Work(ours, {**alternatives, "numpy argsort int16": numpy_sort}, error, 0.0, amount, "copy")
