"""Cases of routed_mlp, the whole route: from unsorted positions to outputs in the same order. n samples, k cells.

The alternatives in torch look up the cells by the fastest installed method. Then they sort and loop over cells, or loop
over boolean masks like Mega-NeRF, or, for few samples, gather a copy of the cell's parameters for each sample. All
alternatives encode the positions themselves, cell by cell or, after sorting, all at once.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from ops.alternatives import PIECE, Parameters, evaluate, join, row_pieces
from ops.case import BACKWARD, Contender, Work, uniform_points
from ops.cases_lookup import LOOKUPS
from ops.networks import NETS, Batch, cost, make_batch, network_error, with_gradients
from voronerf import ops

FEW = 1 << 10
"""The largest number of samples for which parameters are gathered per sample."""


def route_work(
    name: str, n: int, k: int, dtype: torch.dtype, direction: str, tolerance: float, device: torch.device
) -> Work:
    """Builds the case of a network from ``NETS``."""
    net, centres = NETS[name], uniform_points(k, 1000, device)
    batch, price = make_batch(net, n, k, dtype, direction, device, centres=centres), cost(net)
    training = direction == BACKWARD
    lookup: list[tuple[str, Callable[[Tensor], Any]]] = []

    def find() -> Callable[[Tensor], Any]:
        if not lookup:
            lookup.append(fastest_lookup(centres, batch.positions[0]))
        return lookup[0][1]

    types = (dtype,) if dtype == torch.float32 else (dtype, torch.float32)
    alternatives: dict[str, Callable[[], Contender]] = {}
    for kind in types:
        suffix = "" if kind == dtype else ", float32"
        for piece in (None, PIECE):
            rows = f", {piece} rows" if piece else ""
            alternatives[f"torch sort + loop{rows}{suffix}"] = functools.partial(sorted_loop, batch, find, kind, piece)
        alternatives[f"torch sort + encode + loop{suffix}"] = functools.partial(encoded_loop, batch, find, kind)
        alternatives[f"torch masks{suffix}"] = functools.partial(masked_loop, batch, find, kind)
        if n <= FEW:
            alternatives[f"torch gather + bmm{suffix}"] = functools.partial(gathered, batch, find, kind)
    cells = ops.nearest_centre(batch.positions[0], centres)
    return Work(
        functools.partial(ours, batch, centres),
        alternatives,
        network_error(batch, cells),
        tolerance,
        (price.forward + (price.backward if training else 0.0)) * n,
        str(dtype).removeprefix("torch."),
        (price.forward + price.backward + price.again) * n if training else None,
    )


def ours(batch: Batch, centres: Tensor, backend: str) -> Contender:
    """Returns routed_mlp on a backend."""

    def forward(call: int) -> Tensor:
        out, _ = ops.routed_mlp(
            batch.positions[call % len(batch.positions)],
            batch.weights,
            batch.biases,
            layers=batch.net,
            centres=centres,
            directions=batch.directions,
            direction_index=batch.direction_index,
            backend=backend,
        )
        return out

    return Contender(with_gradients(batch, forward, batch.parameters))


def fastest_lookup(centres: Tensor, points: Tensor) -> tuple[str, Callable[[Tensor], Any]]:
    """Returns the fastest lookup of ``LOOKUPS`` for these points, measured by two runs of each."""
    found = []
    for name, make in LOOKUPS.items():
        try:
            find = make(centres)
            find(points[: max(1, points.shape[0] // 8)])
        except Exception:  # skips lookups that fail or are not installed
            continue
        synchronise(points)
        start = time.perf_counter()
        find(points)
        synchronise(points)
        found.append((time.perf_counter() - start, name, find))
    _, name, find = min(found, key=lambda entry: entry[0])
    return name, find


def synchronise(points: Tensor) -> None:
    """Waits for the device of the points."""
    if points.is_cuda:
        torch.cuda.synchronize(points.device)


@functools.cache
def frequencies(octaves: int, device: torch.device) -> Tensor:
    """Returns the frequencies of the octaves, [octaves, 1, 1]."""
    return (2.0 ** torch.arange(octaves, device=device))[:, None, None]


def torch_encode(x: Tensor, octaves: int, dtype: torch.dtype) -> Tensor:
    """Encodes all octaves at once: the input, then a sine and a cosine block for each octave."""
    angles = x[:, None, None, :] * frequencies(octaves, x.device)
    waves = torch.cat([angles.sin(), angles.cos()], 2)
    return torch.cat([x, waves.flatten(1)], 1).to(dtype)


def encoded_directions(batch: Batch, dtype: torch.dtype) -> Tensor | None:
    """Returns the encoded direction of each ray, or None."""
    octaves = batch.net.direction_octaves
    return None if batch.directions is None or octaves is None else torch_encode(batch.directions, octaves, dtype)


def _of_rows(batch: Batch, directions: Tensor | None, rows: Tensor) -> Tensor | None:
    """Returns the encoded directions of the samples that an index or a mask selects."""
    return None if directions is None or batch.direction_index is None else directions[batch.direction_index[rows]]


def sorting(batch: Batch, lookup: Callable[[Tensor], Any]) -> Callable[[Tensor], tuple[list[int], Tensor]]:
    """Returns a function that sorts points by cell, with keys of the narrowest dtype: (bounds of the cells, order)."""
    key = torch.uint8 if batch.k <= 256 else torch.int16
    bounds = torch.arange(batch.k + 1, device=batch.positions[0].device)

    def sort(points: Tensor) -> tuple[list[int], Tensor]:
        keys, order = torch.sort(torch.as_tensor(lookup(points)).to(key), stable=True)
        return torch.searchsorted(keys.int(), bounds).tolist(), order

    return sort


def encoded_loop(batch: Batch, find: Callable[[], Any], dtype: torch.dtype) -> Contender:
    """Returns a loop over sorted cells that encodes all points at once, and scatters all results at once."""
    sort, own = sorting(batch, find()), Parameters(batch, dtype)
    cells, octaves = own.cells(), batch.net.position_octaves or 0

    def parts(call: int) -> Iterator[tuple[Tensor, Tensor]]:
        points, directions = batch.positions[call % len(batch.positions)], encoded_directions(batch, dtype)
        edges, order = sort(points)
        x, d = torch_encode(points[order], octaves, dtype), _of_rows(batch, directions, order)
        yield (
            order,
            torch.cat(
                [
                    own.network(cells[cell], x[first:last], None if d is None else d[first:last])
                    for cell, first, last in row_pieces(edges, None)
                ]
            ),
        )

    return _contender(batch, parts, own, dtype)


def sorted_loop(batch: Batch, find: Callable[[], Any], dtype: torch.dtype, piece: int | None) -> Contender:
    """Returns a loop over sorted cells, which runs each cell and scatters its results."""
    sort, own = sorting(batch, find()), Parameters(batch, dtype)
    cells, octaves = own.cells(), batch.net.position_octaves or 0

    def parts(call: int) -> Iterator[tuple[Tensor, Tensor]]:
        points, directions = batch.positions[call % len(batch.positions)], encoded_directions(batch, dtype)
        edges, order = sort(points)
        for cell, first, last in row_pieces(edges, piece):
            rows = order[first:last]
            x = torch_encode(points[rows], octaves, dtype)
            yield rows, own.network(cells[cell], x, _of_rows(batch, directions, rows))

    return _contender(batch, parts, own, dtype)


def masked_loop(batch: Batch, find: Callable[[], Any], dtype: torch.dtype) -> Contender:
    """Returns a loop over boolean masks of the cells, as in Mega-NeRF's code."""
    lookup, own = find(), Parameters(batch, dtype)
    cells, octaves = own.cells(), batch.net.position_octaves or 0

    def parts(call: int) -> Iterator[tuple[Tensor, Tensor]]:
        points, directions = batch.positions[call % len(batch.positions)], encoded_directions(batch, dtype)
        located = torch.as_tensor(lookup(points))
        for number, cell in enumerate(cells):
            mask = located == number
            x = points[mask]
            if x.shape[0] == 0:
                continue
            yield mask, own.network(cell, torch_encode(x, octaves, dtype), _of_rows(batch, directions, mask))

    return _contender(batch, parts, own, dtype)


def gathered(batch: Batch, find: Callable[[], Any], dtype: torch.dtype) -> Contender:
    """Returns a contender that gathers a copy of the cell's parameters for each sample; fast for few samples."""
    lookup, net, training = find(), batch.net, batch.direction == BACKWARD
    leaves = [tensor.detach().to(dtype).requires_grad_(training) for tensor in batch.parameters]

    def linear(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
        y = torch.baddbmm(bias[:, :, None], weight, x[:, :, None])[:, :, 0]
        return y.relu_() if activation == "relu" else y

    def forward(call: int) -> Tensor:
        points, directions = batch.positions[call % len(batch.positions)], encoded_directions(batch, dtype)
        cells = torch.as_tensor(lookup(points)).long()
        own, count = [leaf[cells] for leaf in leaves], len(batch.weights)
        x, d = torch_encode(points, net.position_octaves or 0, dtype), directions
        if d is not None and batch.direction_index is not None:
            d = d[batch.direction_index]
        return join(evaluate(net, x, d, own[:count], own[count:], linear))

    return Contender(with_gradients(batch, forward, leaves))


def _contender(
    batch: Batch, parts: Callable[[int], Iterator[tuple[Tensor, Tensor]]], own: Parameters, dtype: torch.dtype
) -> Contender:
    """Returns a contender that scatters the results of some rows at a time into one output.

    ``parts`` is a function of the call's number that yields (row indices, result) pairs. The incoming gradient belongs
    to the complete output.
    """

    def empty() -> Tensor:
        return torch.empty(batch.n, batch.net.out_features, dtype=dtype, device=batch.positions[0].device)

    def forward(call: int) -> Tensor:
        out = empty()
        with torch.no_grad():
            for rows, result in parts(call):
                out[rows] = result
        return out

    def both(call: int) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        results, gradient = list(parts(call)), batch.gradient(call).to(dtype)
        out = empty()
        with torch.no_grad():
            for rows, result in results:
                out[rows] = result
        pieces = [gradient[rows] for rows, _ in results]
        found = torch.autograd.grad([result for _, result in results], own.leaves, pieces, allow_unused=True)
        return out, found

    if batch.direction != BACKWARD:
        return Contender(forward)
    return Contender(both, lambda result: (result[0], own.stack(result[1])))
