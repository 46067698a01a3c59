"""A router over ranks gives what it gives in one process: three processes, of which two have a group of their own.

Every case runs in each of them, with a batch of its own; the processes are started once.
"""

from __future__ import annotations

import copy
import json
import os
import socket
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
import torch.distributed as dist
from convention_harness import EXAMPLES
from helpers import script
from router_fields import perturb, tensors
from torch import Tensor, nn

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter

WORLD = 3
CASES: dict[str, Callable[[Any], None]] = {}
CENTRES = torch.tensor([[0.1, 0.2, 0.3], [0.8, 0.2, 0.1], [0.2, 0.9, 0.6], [0.7, 0.7, 0.9], [0.4, 0.5, 0.5]])


def case(function: Callable[[Any], None]) -> Callable[[Any], None]:
    CASES[function.__name__] = function
    return function


class Views(nn.Module):
    """Points [.., 3] and directions of rays; a dict with a flag of each sample."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.c = nn.Linear(3, 8), nn.Linear(11, 4), nn.Linear(3, 8)
        self.register_buffer("scale", torch.tensor([2.0, 1.0, 1.0, 0.5]))

    def density(self, x: Tensor) -> Tensor:
        return torch.sin(self.a(x)).sum(-1)

    def forward(self, x: Tensor, d: Tensor, gain: float = 1.0, code: Tensor | None = None) -> dict[str, Any]:
        h = torch.sin(self.a(x))
        h = h if code is None else h + self.c(code)
        d = d if d.shape == x.shape else d[..., None, :].expand_as(x)
        raw = self.b(torch.cat([h, d], -1)) * self.scale * gain
        return {"raw": raw, "inside": raw[..., 0] > 0, "name": "views"}


class Loop(nn.Module):
    """Reads a parameter as a number, which is not one for all cells."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 4), nn.Linear(4, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.b(torch.sin(self.a(x)) * float(self.a.bias[0]))


def plain() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 8), nn.Softplus(), nn.Linear(8, 4))


def nerf() -> nn.Module:
    return NeRF(width=16, depth=2)


def arguments(module: type | Callable[[], nn.Module], counts: list[int], dtype: torch.dtype) -> list[list[Tensor]]:
    """For each rank."""
    found = []
    for n in counts:
        if module is Views:
            found.append([torch.rand(n, 5, 3, dtype=dtype), torch.randn(n, 3, dtype=dtype)])
        elif module is nerf:
            directions = nn.functional.normalize(torch.randn(4, 3, dtype=dtype), dim=1)
            found.append([torch.rand(n, 3, dtype=dtype), directions, torch.randint(4, (n,)).int()])
        else:
            found.append([torch.rand(n, 3, dtype=dtype)])
    return found


def same(found: Tensor, expected: Tensor) -> None:
    bound = 1e-12 if found.dtype == torch.float64 else 1e-6
    size = float(expected.detach().abs().max()) if expected.numel() and expected.is_floating_point() else 1.0
    torch.testing.assert_close(found, expected, rtol=bound, atol=bound * max(1.0, size))


def slopes(results: list[Tensor], given: list[Tensor], second: bool) -> Tensor:
    """A number that depends on all results, and for ``second`` on their derivatives."""
    total = torch.stack([t.sin().sum() * (i + 1) for i, t in enumerate(results) if t.requires_grad]).sum()
    if second:
        (gradient,) = torch.autograd.grad(total, given[0], create_graph=True)
        total = total + gradient.square().sum()
    return total


def compared(
    group: Any,
    module: Any,
    counts: list[int],
    *,
    call: Callable[..., Any] | None = None,
    dtype: torch.dtype = torch.float64,
    train: bool = True,
    second: bool = False,
    leaves: Callable[[int], bool] = lambda rank: True,
    **options: Any,
) -> VoronoiRouter:
    """Values and gradients of a router over ranks, against one in one process with the batches of all ranks."""
    rank, size, generator = dist.get_rank(group), dist.get_world_size(group), torch.Generator().manual_seed(1)
    torch.manual_seed(1)
    options = options if module is nerf else {"coords": "first3", **options}
    whole = VoronoiRouter(module().to(dtype), VoronoiDiagram(CENTRES), **options).train(train)
    perturb(whole, generator)
    router = copy.deepcopy(whole)
    router.shard(group)
    batches = arguments(module, counts[:size], dtype)
    for other, batch in enumerate(batches):
        for tensor in batch:
            tensor.requires_grad_(leaves(other) and tensor.is_floating_point())
    call = call or (lambda router, *given: router(*given))
    found, expected = tensors(call(router, *batches[rank])), [tensors(call(whole, *batch)) for batch in batches]
    for ours, theirs in zip(found, expected[rank], strict=True):
        assert ours.requires_grad == theirs.requires_grad
        same(ours, theirs)

    mine = [tensor for tensor in batches[rank] if tensor.requires_grad]
    total = torch.stack([slopes(results, batch, second) for results, batch in zip(expected, batches)]).sum()
    theirs = torch.autograd.grad(total, [*mine, *whole.parameters()], materialize_grads=True)
    slopes(found, batches[rank], second).backward()
    router.sum_gradients()
    own = slice(router.own_cells.start, router.own_cells.stop)
    for leaf, expected_gradient in zip([*mine, *router.parameters()], theirs, strict=True):
        found_gradient = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        same(found_gradient, expected_gradient if leaf.shape == expected_gradient.shape else expected_gradient[own])
    return router


# Calls ----------------------------------------------------------------------------------------------------------------

COUNTS = [40, 25, 33]


@case
def ways(group: Any) -> None:
    ways = {"grouped": (plain, {}), "fused": (plain, {"fuse": True}), "cell by cell": (Loop, {})}
    for way, (module, options) in ways.items():
        for second, dtype in ((True, torch.float64), (False, torch.float32)):
            router = compared(group, module, COUNTS, second=second, dtype=dtype, **options)
        own, rank = router.own_cells, dist.get_rank(group)
        cells = f"cells {own[0]} to {own[-1]}" if len(own) > 1 else f"cell {own[0]}"
        said = f"sharded: rank {rank} of {dist.get_world_size(group)} has {cells} of 5"
        assert router.explain().endswith(said) and (len(own) == 1 or f"forward: {way}" in router.explain())


@case
def rays(group: Any) -> None:
    for layout in ("rays", "flat"):
        compared(group, Views, COUNTS, layout=layout, second=True)
        compared(group, Views, COUNTS, layout=layout, call=lambda router, x, d: router(d=d, x=x, gain=1.5))
    code = torch.ones(3, dtype=torch.float64)
    compared(group, Views, COUNTS, shared=["code"], call=lambda router, x, d: router(x, d, code=code))
    compared(
        group, Views, COUNTS, methods=["density"], call=lambda router, x, d: [router.density(x), router(x, d)["raw"]]
    )


@case
def tables(group: Any) -> None:
    for dtype in (torch.float64, torch.float32):
        router = compared(group, nerf, COUNTS, dtype=dtype)
        compared(group, nerf, COUNTS, dtype=dtype, call=lambda router, *given: router.raw(*given))
        compared(group, nerf, [9, 0, 0], dtype=dtype)
    assert router.explain().startswith("forward: fused, by the layer table of the field\nsharded: ")


@case
def empty(group: Any) -> None:
    for counts in ([30, 0, 7], [0, 3, 0], [0, 0, 0], [1, 1, 1]):
        compared(group, plain, counts, second=True)
        compared(group, Views, counts)

    def far(router: VoronoiRouter, x: Tensor) -> Any:  # all in the first cell, so that one rank evaluates everything
        return router(x, coords=torch.zeros_like(x))

    compared(group, plain, COUNTS, call=far)


@case
def gradients_of_one_rank(group: Any) -> None:
    compared(group, plain, COUNTS, leaves=lambda rank: rank == 1)
    compared(group, plain, COUNTS, leaves=lambda rank: False)


@case
def shared_parameters(group: Any) -> None:
    router = compared(group, plain, COUNTS, share=["0.*"])
    assert [len(p) for p in router.parameters()] == [8, 8, len(router.own_cells), len(router.own_cells)]


@case
def blended(group: Any) -> None:
    for module in (plain, Views, nerf):
        compared(group, module, [40, 0, 33], train=False, blend=0.2)


@case
def bytes_sent(group: Any) -> None:
    """How many samples each cell gets; positions and directions there, outputs back, their gradients there."""
    size, rank = dist.get_world_size(group), dist.get_rank(group)
    torch.manual_seed(4)
    router = VoronoiRouter(nerf(), VoronoiDiagram(CENTRES))
    router.shard(group)
    batches = [torch.rand(n, 3) for n in COUNTS[:size]]
    own = torch.tensor(router.own_cells)
    here = [int(torch.isin(router.diagram.locate(batch), own).sum()) for batch in batches]
    away, asked = COUNTS[rank] - here[rank], sum(here) - here[rank]
    sent, exchange = [], dist.all_to_all_single

    def counted(output: Tensor, given: Tensor, came: list[int], there: list[int], **options: Any) -> Any:
        sent.append((sum(there) - there[rank]) * given.element_size())
        return exchange(output, given, came, there, **options)

    with mock.patch.object(dist, "all_to_all_single", counted):
        colour, density = router(batches[rank], nn.functional.normalize(batches[rank], dim=1))
        (colour.sum() + density.sum()).backward()
    assert sent == [8 * (5 - len(own) + 2 * (size - 1)), 24 * away, 16 * asked, 16 * away]


# Cells ----------------------------------------------------------------------------------------------------------------


def trained(router: VoronoiRouter, optimizer: torch.optim.Optimizer, points: list[Tensor], group: Any = None) -> None:
    """Three steps with the batches of all ranks, or this one's."""
    batches = points if group is None else [points[dist.get_rank(group)]]
    for _ in range(3):
        optimizer.zero_grad()
        torch.stack([router(batch).square().sum() for batch in batches]).sum().backward()
        router.sum_gradients()
        optimizer.step()


def equal(router: VoronoiRouter, optimizer: Any, whole: VoronoiRouter, expected: Any) -> None:
    """Parameters and moments of a router over ranks, put together, are those of one in one process."""
    state, moments = router.gather_state_dict(), router.gather_optimizer_state_dict(optimizer)
    if router.own_cells.start:
        assert state == moments == {}
        return
    assert state.keys() == whole.state_dict().keys()
    for name, value in whole.state_dict().items():
        same(state[name], value)
    for number, values in expected.state_dict()["state"].items():
        for key, value in values.items():
            same(moments["state"][number][key], value)


@case
def splits_and_states(group: Any) -> None:
    size, rank, generator = dist.get_world_size(group), dist.get_rank(group), torch.Generator().manual_seed(2)
    torch.manual_seed(2)
    module = plain().double()
    whole = VoronoiRouter(module, CENTRES, coords="first3", share=["0.bias"])
    perturb(whole, generator)
    expected = torch.optim.Adam(whole.parameters(), lr=0.01)
    points = [torch.rand(60, 3, dtype=torch.float64) for _ in range(size)]
    trained(whole, expected, points)
    router = VoronoiRouter(module, CENTRES, coords="first3", share=["0.bias"])
    router.load_state_dict(whole.state_dict())
    optimizer = torch.optim.Adam(router.parameters(), lr=0.01)
    optimizer.load_state_dict(copy.deepcopy(expected.state_dict()))
    router.shard(group, weights=torch.tensor([9.0, 1, 1, 1, 1]), optimizer=optimizer)
    assert len(router.own_cells) == ([1, 4] if size == 2 else [1, 2, 2])[rank]
    trained(whole, expected, points)
    trained(router, optimizer, points, group)
    equal(router, optimizer, whole, expected)

    router.shard(group, weights=torch.tensor([0.0, 0, 0, 1, 9]), optimizer=optimizer)  # cells move
    equal(router, optimizer, whole, expected)
    seeds = {"generator": torch.Generator().manual_seed(3)}, {"generator": torch.Generator().manual_seed(3)}
    weights = [batch[:, 0] + rank for rank, batch in enumerate(points)]
    given = {"points": torch.cat(points), "weights": torch.cat(weights), "optimizer": expected, "min_samples": 30}
    parents = whole.subdivide(3, **given, **seeds[0])
    given |= {"points": points[rank], "weights": weights[rank], "optimizer": optimizer}
    assert torch.equal(router.subdivide(3, **given, **seeds[1]), parents) and whole.num_cells > 5
    trained(whole, expected, points)
    trained(router, optimizer, points, group)
    equal(router, optimizer, whole, expected)

    stored, alone = router.state_dict(), copy.deepcopy(whole)
    finer, parents = whole.diagram.refine({0: CENTRES[:2] / 9})
    for one, held in ((whole, expected), (router, optimizer)):
        one.subdivide(finer, parents, optimizer=held)
    equal(router, optimizer, whole, expected)
    with pytest.raises(ValueError, match="state_dict must be whole, as gather_state_dict"):
        router.load_state_dict(stored)
    router.load_state_dict(alone.state_dict(), optimizer=optimizer)  # other cells
    same(router(points[rank]), alone(points[rank]))
    router.load_state_dict(router.state_dict())
    own = router.own_cells
    for cell in (own[0], own[-1]):
        same(router.cell(cell)(points[0]), alone.cell(cell)(points[0]))
    router.load_cell(own[0], router.cell(own[-1]))
    same(router.cell(own[0])(points[0]), alone.cell(own[-1])(points[0]))
    other = 0 if own[0] else len(alone.module[0].weight) - 1
    with pytest.raises(IndexError, match=f"got {other}, which rank {0 if own[0] else size - 1} has"):
        router.cell(other)


@case
def refusals(group: Any) -> None:
    size, rank = dist.get_world_size(group), dist.get_rank(group)

    def router(centres: Tensor = CENTRES) -> VoronoiRouter:
        return VoronoiRouter(plain(), centres, coords="first3")

    with pytest.raises(ValueError, match=f"at most 1 ranks, one for each cell, got {size}"):
        router(CENTRES[:1]).shard(group)
    with pytest.raises(ValueError, match="diagram must be the same on all ranks, but rank 1 has another"):
        router(CENTRES + 0.1 * (rank == 1)).shard(group)
    for weights, got in ((torch.ones(4), r"\[4\]"), (-torch.ones(5), "-1.0 to -1.0")):
        with pytest.raises(ValueError, match=rf"weights must be \[5\], finite and at least 0, got {got}"):
            router().shard(group, weights=weights)
    own = router()
    own.shard(group)
    with pytest.raises(ValueError, match="all ranks must call the same method"):
        own(torch.rand(9, 3, dtype=torch.float64 if rank == 1 else torch.float32))
    with pytest.raises(ValueError, match="needs points and weights"):
        own.subdivide(2)


# Processes ------------------------------------------------------------------------------------------------------------


def run_rank(rank: int, folder: str, port: int) -> None:
    """All cases, two of them in a group of two as well; what went wrong is written to a file.

    Then two of them run the example, as torchrun would start it.
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    store, told = dist.FileStore(f"{folder}/store", WORLD), {}
    dist.init_process_group("gloo", store=store, rank=rank, world_size=WORLD, timeout=timedelta(seconds=20))
    pair = dist.new_group([0, 1])
    for name, function in CASES.items():
        try:
            function(dist.group.WORLD)
            if rank < 2 and function in (ways, splits_and_states):
                function(pair)
            told[name] = ""
        except Exception:
            told[name] = traceback.format_exc()
            break
    dist.destroy_process_group()
    if rank < 2:
        os.environ.update(RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
        told["example"] = script(EXAMPLES / "sharded_nerf.py")
    Path(folder, f"{rank}.json").write_text(json.dumps(told))


@pytest.fixture(scope="module")
def told() -> Iterator[list[dict[str, str]]]:
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        method = "spawn" if torch.cuda.is_initialized() else "fork"  # which need not import torch again
        torch.multiprocessing.start_processes(run_rank, (folder, port), nprocs=WORLD, start_method=method)
        yield [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(WORLD)]


@pytest.mark.parametrize("name", CASES)
def test_over_ranks(name: str, told: list[dict[str, str]]) -> None:
    wrong = [
        f"rank {rank}: {found.get(name, 'a case before failed')}"
        for rank, found in enumerate(told)
        if found.get(name) != ""
    ]
    assert not wrong, "\n".join(wrong)


def test_example(told: list[dict[str, str]]) -> None:
    assert [found.get("example") for found in told] == ["8 cells on 2 ranks, of which rank 0 has 4\n", "", None]


def test_needs_a_process_group() -> None:
    with pytest.raises(RuntimeError, match=r"torch.distributed must be initialised; start the script by torchrun"):
        VoronoiRouter(plain(), CENTRES, coords="first3").shard()
