"""Cases of nearest_centre, locate_cell and cell_sort. n points, k cells, d coordinates."""

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
from voronerf.diagram.voronoi import MANY_CELLS

CHUNK = 1 << 19
"""The number of distances that torch and numpy compute at a time: 2 MiB, the fastest size."""
CHECKED = 1 << 14
"""The number of points whose result is compared with float64."""
PAIRS = 1 << 25
"""The largest number of distances of a check in float64."""
FEW = 4096
"""Above this number of centres, only trees are alternatives."""
MANY = 10_000
"""The number of points in most benchmark cases that compare indices and trees (`KEPT`, `MADE`)."""
DIAGRAM = 4096
"""Up to this number of cells, cell_sort's cells come from a diagram; above it, they are random."""
FLOPS = 8
"""Operations of one squared distance: three differences, three products, two sums."""
ALL = ("native", "reference", "warp")

Lookup = Callable[[Tensor], Any]


def cases() -> list[Case]:
    """Returns the cases of these ops."""
    n, single = 1 << 18, torch.float32
    rows = []
    for k in (1, 16, 64, 256, 512, 4096):
        rows.append(_nearest(n, k, single, backends=ALL if k == 16 else ("native",), quick=k == 16))
    rows += [_nearest(count, 16, single) for count in (1, 16, 256, 1 << 10, 1 << 14, 1 << 20)]
    for k in (256, 1024, 4096, 1 << 14, 1 << 16, 1_000_000):
        for kind in KINDS:
            rows += [_nearest(MANY, k, single, kind=kind, way=way) for way in (KEPT, MADE)]
    rows += [_nearest(MANY, 4096, single, d=d, way=KEPT) for d in (1, 2, 4)]
    rows += [_nearest(count, 4096, single, way=KEPT) for count in (1, 16, 256)]
    rows.append(_nearest(n, 16, torch.float64))
    for count, shape, quick in ((n, (16, 16), True), (n, (64, 64), False), (1 << 10, (16, 16), False)):
        name = "x".join(str(k) for k in shape)
        work = functools.partial(_locate_work, count, shape)
        shown = ALL if quick else ("native",)
        cells = int(np.prod(shape))
        rows.append(Case("locate_cell", f"{name} n={count}", single, FORWARD, count, cells, work, shown, quick))
    sizes = [(n, k) for k in (1, 16, 64, 256, 512, 4096)] + [(count, 256) for count in (1024, 1 << 14, 1 << 20)]
    for count, k in sizes:
        base = (count, k) == (n, 256)
        work = functools.partial(_sort_work, count, k)
        name = f"n={count} k={k}"
        rows.append(Case("cell_sort", name, torch.int32, FORWARD, count, k, work, ALL if base else ("native",), base))
    for count, k in ((10**6, 256), (10**5, 10**6), (1000, 10**6)):
        work = functools.partial(_sort_work, count, k)
        name = f"n={count} k={k} threads=1"
        rows.append(Case("cell_sort", name, torch.int32, FORWARD, count, k, work, ("native",), threads=1))
    return rows


def _nearest(
    n: int,
    k: int,
    dtype: torch.dtype,
    *,
    d: int = 3,
    kind: str = "",
    way: str = "",
    backends: tuple[str, ...] = ("native",),
    quick: bool = False,
) -> Case:
    name = " ".join([f"n={n} k={k}", *[f"d={d}"] * (d != 3), *filter(None, (kind, way))])
    work = functools.partial(_nearest_work, n, k, dtype, d=d, kind=kind, way=way)
    return Case("nearest_centre", name, dtype, FORWARD, n, k, work, backends, quick)


def _nearest_work(
    n: int, k: int, dtype: torch.dtype, device: torch.device, *, d: int = 3, kind: str = "", way: str = ""
) -> Work:
    def draw(count: int, seed: int) -> Tensor:
        uniform = torch.cat([uniform_points(count, seed + 100_000 * part, device, dtype) for part in range(2)], 1)
        return KINDS.get(kind, torch.clone)(uniform[:, :d]).contiguous()

    points, centres = [draw(n, seed) for seed in range(rotation(4 * d * n))], draw(k, 1000)

    def ours(backend: str) -> Contender:
        index = ops.index_centres(centres) if way == KEPT and k >= MANY_CELLS else None
        return Contender(
            lambda call: ops.nearest_centre(points[call % len(points)], centres, index=index, backend=backend)
        )

    def using(make: Callable[[Tensor], Lookup]) -> Callable[[], Contender]:
        def set_up() -> Contender:
            kept = make(centres)

            def find(call: int) -> Any:
                return (make(centres) if way == MADE else kept)(points[call % len(points)])

            return Contender(find, lambda found: torch.as_tensor(np.asarray(found).astype(np.int32)))

        return set_up

    bound = "float32" if dtype == torch.float32 and not way else ""  # without an index, all pairs are computed
    lookups = {**LOOKUPS, **(TREES if way else {}), **({"torch searchsorted": _sorted_lookup} if d == 1 else {})}
    return Work(
        ours,
        {name: using(maker) for name, maker in lookups.items() if k <= FEW or name in TREES},
        lambda cells: _wrong_cells(points[0], centres, cells),
        tolerance=0.01 * min(n, CHECKED),  # the expanded square rounds some points into another cell
        amount=float(FLOPS) * n * k if bound else float(n),
        bound=bound,
    )


def _wrong_cells(points: Tensor, centres: Tensor, cells: Tensor) -> float:
    """Counts the points, of the first ``CHECKED``, whose centre is not the nearest in float64."""
    step = max(1, points.shape[0] // max(1, min(CHECKED, PAIRS // centres.shape[0])))
    points, chosen = points[::step].double().cpu(), cells[::step].long().cpu()
    if int(chosen.min()) < 0 or int(chosen.max()) >= centres.shape[0]:
        return float("inf")
    wrong = 0
    rows = max(1, min(1024, (1 << 24) // centres.shape[0]))
    for piece, choice in zip(points.split(rows), chosen.split(rows)):
        squared = (piece[:, None] - centres.double().cpu()).square().sum(2)
        wrong += int((squared.gather(1, choice[:, None])[:, 0] > squared.amin(1)).sum())
    return float(wrong)


def _torch_lookup(centres: Tensor) -> Lookup:
    """Returns a lookup of the centre c with the least c^2 - 2 x c: addmm and argmin, in pieces that stay in cache."""
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
    """Returns a lookup of the centre c with the least c^2 - 2 x c in numpy; only the product is multi-threaded."""
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


def _fast_tree_lookup(centres: Tensor) -> Lookup:
    tree = optional("pykdtree.kdtree").KDTree(_host(centres).numpy())
    return lambda points: tree.query(points.numpy())[1]


def _flat_lookup(centres: Tensor) -> Lookup:
    """Returns a brute-force lookup by faiss."""
    index = optional("faiss").IndexFlatL2(centres.shape[1])
    index.add(_host(centres).numpy())
    return lambda points: index.search(points.numpy(), 1)[1][:, 0]


def _sorted_lookup(centres: Tensor) -> Lookup:
    """Returns a lookup in one dimension: a binary search among midpoints between neighbouring centres."""
    ascending, order = centres[:, 0].sort(stable=True)
    middles = ((ascending[1:].double() + ascending[:-1].double()) / 2).float()
    return lambda points: order[torch.searchsorted(middles, points[:, 0])]


def _on_a_sphere(points: Tensor) -> Tensor:
    return torch.nn.functional.normalize(points - 0.5, dim=1)


def _heavy_tailed(points: Tensor) -> Tensor:
    """Moves a ten-thousandth of the points a thousand times as far away as most points."""
    return (points - 0.5) * points[:, :1].clamp(min=1e-6).pow(-0.8)


KINDS: dict[str, Callable[[Tensor], Tensor]] = {
    "uniform": torch.clone,
    "on a sphere": _on_a_sphere,
    "heavy-tailed": _heavy_tailed,
}
"""Distributions of points and centres: functions of uniform numbers [n, d]."""
KEPT, MADE = "kept", "made"
"""Names of the two ways to use an index or a tree: built once for all calls, or in each call."""
TREES: dict[str, Callable[[Tensor], Lookup]] = {"scipy cKDTree": _tree_lookup, "pykdtree": _fast_tree_lookup}
LOOKUPS: dict[str, Callable[[Tensor], Lookup]] = {
    "torch addmm + argmin": _torch_lookup,
    "numpy": _numpy_lookup,
    "faiss": _flat_lookup,
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
        """Returns a lookup level by level: first the cells of the root, then a loop over them with masks."""

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
        """Counts the points that are in a wrong cell at either level, in float64."""
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
    sets = rotation(4 * n)
    if k <= DIAGRAM:
        centres = uniform_points(k, 1000, device)
        cells = [ops.nearest_centre(uniform_points(n, seed, device), centres) for seed in range(sets)]
    else:
        cells = [torch.randint(k, (n,), generator=generator(seed)).int().to(device) for seed in range(sets)]

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

    narrow = "int16" if k < 1 << 15 else "int32"

    def numpy_sort() -> Contender:
        arrays = [_host(tensor).numpy() for tensor in cells]
        dtype = np.dtype(narrow)
        bounds = np.arange(k, dtype=dtype)

        def run(call: int) -> tuple[np.ndarray, np.ndarray]:
            keys = arrays[call % sets].astype(dtype)
            order = keys.argsort(kind="stable")
            return order, keys[order].searchsorted(bounds)

        return Contender(run)

    def numba_sort() -> Contender:
        arrays = [_host(tensor).numpy() for tensor in cells]
        sort = optional("numba").njit(_counting_sort)
        sort(arrays[0], k)  # compiles
        return Contender(lambda call: sort(arrays[call % sets], k))

    def error(result: tuple[Any, Any]) -> float:
        """Counts entries that differ from numpy's stable sort."""
        expected = cells[0].cpu().numpy().argsort(kind="stable")
        order, offsets = (torch.as_tensor(part).cpu().numpy() for part in result)
        first = cells[0].cpu().numpy()[expected].searchsorted(np.arange(k))
        return float((order != expected).sum() + (offsets[:k] != first).sum())

    alternatives: dict[str, Callable[[], Contender]] = {f"torch sort {narrow}": torch_sort(getattr(torch, narrow))}
    if k <= 256:
        alternatives["torch sort uint8"] = torch_sort(torch.uint8)
    # Minimum bytes: read all cells, write the order and the offsets.
    amount = 8.0 * n + 4 * (k + 1)
    alternatives |= {f"numpy argsort {narrow}": numpy_sort, "Numba counting sort": numba_sort}
    return Work(ours, alternatives, error, 0.0, amount, "copy")


def _counting_sort(cells: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts by counting in eight lines that Numba compiles."""
    offsets = np.zeros(k + 1, np.int32)
    for cell in cells:
        offsets[cell + 1] += 1
    for c in range(k):
        offsets[c + 1] += offsets[c]
    places, order = offsets[:-1].copy(), np.empty(len(cells), np.int32)
    for i in range(len(cells)):
        order[places[cells[i]]] = i
        places[cells[i]] += 1
    return order, offsets
