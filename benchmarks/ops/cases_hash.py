"""Cases of hash_encode, and of a network on top of it.

n samples along rays, k cells, L levels, e entries of all levels, f features of a level.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ops.alternatives import compile_now
from ops.case import BACKWARD, FORWARD, Case, Contender, Work, generator, relative_error, rotation
from voronerf import MLP, HashGrid, Layer
from voronerf.ops import hash_encode, nearest_centre, routed_mlp, spherical_harmonics

SAMPLES = 64
"""Samples of a ray."""
CELLS = 16
PRIMES = (1, 2654435761 - 2**32, 805459861)

Encode = Callable[[Tensor, Tensor], Tensor]
Network = Callable[..., Tensor]


def cases() -> list[Case]:
    """Returns the cases, all on one thread; backward computes the gradients of tables and weights, as in training."""
    rows = []
    for n in (1 << 16, 1 << 18):
        for direction in (FORWARD, BACKWARD):
            work = functools.partial(network_work, n, direction)
            name, quick = f"hash + MLP n={n}", (n, direction) == (1 << 16, FORWARD)
            rows.append(Case("routed_mlp", name, torch.float32, direction, n, CELLS, work, quick=quick, threads=1))
    for n, log2_entries in ((1 << 16, 15), (1 << 18, 15), (1 << 16, 19)):
        for direction in (FORWARD, BACKWARD):
            name = f"8 x 2^{log2_entries} x 2 n={n}"
            base = (n, log2_entries) == (1 << 16, 15)
            work = functools.partial(hash_work, n, log2_entries, direction, base)
            shown = ("native", "reference") if base else ("native",)
            quick = base and direction == FORWARD
            rows.append(Case("hash_encode", name, torch.float32, direction, n, None, work, shown, quick, threads=1))
    return rows


def _samples(n: int, seed: int, device: torch.device) -> Tensor:
    """Draws positions [n, 3] in the unit cube: ray by ray, sorted along each ray."""
    draw = generator(seed)
    begin, end = torch.rand(2, n // SAMPLES, 1, 3, generator=draw)
    depths = (torch.arange(SAMPLES)[:, None] + torch.rand(n // SAMPLES, SAMPLES, 1, generator=draw)) / SAMPLES
    return (begin + (end - begin) * depths).reshape(n, 3).to(device)


def _corners(x: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
    """Returns the table entries, int32 [n, L, 8], of the corners, and their weights."""
    scale, shift, side, entries, offset, hashed = (x.new_tensor(column) for column in zip(*grid.rows))
    where = x[:, None, :] * scale[:, None] + shift[:, None]
    steps = torch.tensor([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], device=x.device)
    below = where.floor()
    inside = (where - below)[:, :, None, :]
    weights = torch.where(steps == 1, inside, 1 - inside).prod(dim=3)
    corner = below.int()[:, :, None, :] + steps.int()
    product = corner * torch.tensor(PRIMES, device=x.device, dtype=torch.int32)
    side, entries = side.int()[:, None], entries.int()[:, None]  # a hashed level has 2^b entries
    by_hash = (product[..., 0] ^ product[..., 1] ^ product[..., 2]) & (entries - 1)
    dense = (corner[..., 0] + side * (corner[..., 1] + side * corner[..., 2])) % entries
    return torch.where(hashed.bool()[:, None], by_hash, dense) + offset.int()[:, None], weights


def _by_indexing(x: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    entries, weights = _corners(x, grid)
    return (table[entries] * weights[..., None]).sum(dim=2).flatten(1)


def _by_embedding_bag(x: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    entries, weights = _corners(x, grid)
    found = F.embedding_bag(entries.view(-1, 8), table, per_sample_weights=weights.view(-1, 8), mode="sum")
    return found.view(len(x), -1)


def _by_reading(x: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    from rival_ngp import ReadTable  # imports the application

    entries, weights = _corners(x, grid)
    return ReadTable.apply(table, entries.view(-1, 8), weights.view(-1, 8)).view(len(x), -1)


def hash_work(n: int, log2_entries: int, direction: str, compiled: bool, device: torch.device) -> Work:
    """Builds a case with eight levels of two features; ``compiled`` adds torch.compile as an alternative."""
    grid = HashGrid(levels=8, features=2, log2_entries=log2_entries, base=16, finest=256)
    count = rotation(n * 4 * (3 + grid.out_features))
    sets = [_samples(n, seed, device) for seed in range(count)]
    table = torch.randn(grid.table_shape, generator=generator(7)).to(device)
    gradient = torch.randn(n, grid.out_features, generator=generator(8)).to(device)

    def results(encode: Encode, x: Tensor, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        leaf = table.to(dtype).requires_grad_(direction == BACKWARD)
        out = encode(x.to(dtype), leaf)
        return [out] if direction == FORWARD else [out, *torch.autograd.grad(out, leaf, gradient.to(dtype))]

    def contender(encode: Encode) -> Contender:
        return Contender(lambda call: results(encode, sets[call % count]))

    def compiling() -> Contender:
        torch.compiler.reset()
        made = contender(torch.compile(functools.partial(_by_indexing, grid=grid)))
        compile_now(lambda: made.run(1))
        return made

    @functools.cache
    def exact() -> list[Tensor]:
        return results(lambda x, table: hash_encode(x, table, grid, backend="reference"), sets[0], torch.float64)

    def error(found: Any) -> float:
        return max(relative_error(a, b) for a, b in zip(found, exact(), strict=True))

    # Minimum bytes: read positions and the table, write features; backward moves as many bytes again.
    amount = float(n) * 4 * (3 + grid.out_features) + table.nbytes
    if direction == BACKWARD:
        amount += float(n) * 4 * (3 + grid.out_features) + table.nbytes
    alternatives = {
        "torch, indexing": lambda: contender(functools.partial(_by_indexing, grid=grid)),
        "torch, F.embedding_bag": lambda: contender(functools.partial(_by_embedding_bag, grid=grid)),
        "torch, F.embedding_bag, scatter_add_": lambda: contender(functools.partial(_by_reading, grid=grid)),
    }
    if compiled:
        alternatives["torch, indexing, torch.compile"] = compiling
    return Work(
        lambda backend: contender(lambda x, table: hash_encode(x, table, grid, backend=backend)),
        alternatives,
        error,
        1e-3,
        amount,
        "copy",
    )


HIDDEN = (
    Layer(("positions",), 32, "relu"),
    Layer((0,), 16),
    Layer((1,), 1),
    Layer((1, "directions"), 32, "relu"),
    Layer((3,), 3),
)
"""Layers of a network: the density from 16 features, and the colour from the features and the direction."""


def network_work(n: int, direction: str, device: torch.device) -> Work:
    """Builds a case with one hash grid for all cells, harmonics of the directions, and a small network per cell."""
    grid, draw = HashGrid(levels=8, features=2, log2_entries=15, base=16, finest=256), generator(9)
    inside = MLP(HIDDEN, (4, 2), None, None, "hash", grid, "spherical", 4)
    behind = MLP(HIDDEN, (4, 2))
    shapes = inside.weight_shapes(3, 3)
    parameters = [torch.randn(grid.table_shape, generator=draw)]
    parameters += [torch.randn(CELLS, o, i, generator=draw) / i**0.5 for o, i in shapes]
    parameters += [torch.randn(CELLS, o, generator=draw) / 8 for o, _ in shapes]
    parameters = [parameter.to(device) for parameter in parameters]
    rays = F.normalize(torch.randn(n // SAMPLES, 3, generator=draw), dim=1).to(device)
    index = (torch.arange(n, device=device) // SAMPLES).int()
    gradient, centres = torch.randn(n, 4, generator=draw).to(device), torch.rand(CELLS, 3, generator=draw).to(device)
    count = rotation(n * 4 * 3)
    sets = [_samples(n, seed, device) for seed in range(count)]
    cells = [nearest_centre(x, centres) for x in sets]

    def results(call: int, network: Network, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        leaves = [parameter.to(dtype).requires_grad_(direction == BACKWARD) for parameter in parameters]
        own = leaves[0], leaves[1 : len(shapes) + 1], leaves[len(shapes) + 1 :]
        out = network(sets[call % count].to(dtype), rays.to(dtype), cells[call % count], *own)
        out = out.to(dtype)  # autocast may return another type
        return [out] if direction == FORWARD else [out, *torch.autograd.grad(out, leaves, gradient.to(dtype))]

    def fused(backend: str) -> Network:
        def network(x: Tensor, seen: Tensor, owners: Tensor, table: Tensor, *own: list[Tensor]) -> Tensor:
            options: dict[str, Any] = {"layers": inside, "features": table, "direction_index": index}
            return routed_mlp(x, *own, directions=seen, cells=owners, backend=backend, **options)[0]

        return network

    def separate(x: Tensor, seen: Tensor, owners: Tensor, table: Tensor, *own: list[Tensor]) -> Tensor:
        x, seen = hash_encode(x, table, grid, backend="native"), spherical_harmonics(seen, 4, backend="native")
        options: dict[str, Any] = {"layers": behind, "direction_index": index, "backend": "native"}
        return routed_mlp(x, *own, directions=seen, cells=owners, **options)[0]

    @functools.cache
    def exact() -> list[Tensor]:
        return results(0, fused("reference"), torch.float64)

    def error(found: Any) -> float:
        return max(relative_error(a, b) for a, b in zip(found, exact(), strict=True))

    operations = 2.0 * n * sum(o * i for o, i in shapes) * (1 if direction == FORWARD else 3)
    # Minimum bytes: positions, indices, cells, outputs and the table; backward moves all again, and the features twice.
    moved = n * 4.0 * (3 + 1 + 1 + 4) + parameters[0].nbytes
    if direction == BACKWARD:
        moved = 2 * moved + n * 4.0 * 2 * grid.out_features
    return Work(
        lambda backend: Contender(functools.partial(results, network=fused(backend))),
        {"native, encoded before": lambda: Contender(functools.partial(results, network=separate))},
        error,
        3e-2,  # rounding may switch a ReLU near its kink
        operations,
        "float32",
        moved=moved,
    )
