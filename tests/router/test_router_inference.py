"""Later calls with gradients can use all that a router keeps of a call or a change under inference mode."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import all_pairs
from ops.foreign_fields import Heads
from router_loop import masked_loop, tensors
from torch import Tensor

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.diagram import SampleReservoir

pytestmark = pytest.mark.filterwarnings("ignore:VoronoiRouter")


def points(n: int, seed: int = 0) -> Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))


def nested() -> VoronoiDiagram:
    return VoronoiDiagram(points(3, 1)).refine({1: points(4, 2)})[0]


#: Routers by name: with a search index of the centres, with a tree of centres, and with methods in each way.
ROUTERS: dict[str, Callable[[], VoronoiRouter]] = {
    "index": lambda: VoronoiRouter(NeRF(width=8, depth=2, view_directions=False), points(2048, 1)),
    "tree": lambda: VoronoiRouter(NeRF(width=8, depth=2, view_directions=False), nested()),
    "fused": lambda: VoronoiRouter(Heads(), points(5, 1), coords="first3", methods=["density"], fuse=True),
    "grouped": lambda: VoronoiRouter(Heads(), points(5, 1), coords="first3", methods=["density"], way="grouped"),
}


def called(router: VoronoiRouter) -> VoronoiRouter:
    router(points(60))
    return router


def loaded(router: VoronoiRouter, cells: int | None = None) -> VoronoiRouter:
    other = copy.deepcopy(router)
    if cells is not None:
        other.subdivide(VoronoiDiagram(points(cells, 3)))
    router.load_state_dict(other.state_dict())
    return router


def subdivided(router: VoronoiRouter) -> VoronoiRouter:
    router.subdivide(router.diagram.refine({0: points(2, 4)})[0])
    return router


def split(router: VoronoiRouter) -> VoronoiRouter:
    few = router.num_cells < 50  # each cell is drawn
    router.subdivide(2, points=points(400, 5), cells="worst", inherit=not few)
    return router


def frozen(router: VoronoiRouter) -> VoronoiRouter:
    router.freeze([0, 1])
    router.unfreeze([1])
    return router


def cell_loaded(router: VoronoiRouter) -> VoronoiRouter:
    router.load_cell(1, router.cell(0))
    if router.num_cells < 50:
        router.apply(lambda module: [p.mul_(0.9) for p in module.parameters(recurse=False)])
    return router


def wrapped(router: VoronoiRouter) -> VoronoiRouter:
    return VoronoiRouter(router.cell(0), VoronoiDiagram.from_state(router.diagram.state_dict()), coords="first3")


#: Calls and changes under inference mode.
CHANGES: dict[str, Callable[[VoronoiRouter], VoronoiRouter]] = {
    "call": called,
    "load": loaded,
    "load of other cells": lambda router: loaded(router, 7),
    "subdivide": subdivided,
    "split": split,
    "freeze": frozen,
    "load_cell": cell_loaded,
    "part": lambda router: router.part([0, 2, 3]),
    "deepcopy": lambda router: copy.deepcopy(router),
    "wrap": wrapped,
}


def train(router: VoronoiRouter) -> None:
    """Makes an optimiser's step for each method; for fewer than 50 cells, compares it with the loop over masks."""
    optimizer, x = torch.optim.Adam(router.parameters()), points(60)
    router.unfreeze()
    for method in (*router.methods, "forward", *router.methods):
        results = tensors(getattr(router, method)(x))
        if router.num_cells < 50:
            torch.testing.assert_close(results, masked_loop(router, x, method=method))
        optimizer.zero_grad()
        torch.stack([result.square().sum() for result in results]).sum().backward()
        before = [parameter.detach().clone() for parameter in router.parameters()]
        optimizer.step()
        assert not all(map(torch.equal, before, router.parameters()))


def freeze(router: VoronoiRouter) -> None:
    router.freeze([0, 2], optimizer=(optimizer := torch.optim.Adam(router.parameters())))
    before = router.cell(2).state_dict()
    torch.stack([result.sum() for result in tensors(router(points(60)))]).sum().backward()
    optimizer.step()
    torch.testing.assert_close(router.cell(2).state_dict(), before, rtol=0, atol=0)


def run_cell(router: VoronoiRouter) -> None:
    tensors(router.cell(1)(points(4)))[0].sum().backward()


def write(router: VoronoiRouter) -> None:
    for buffer in router.buffers():
        buffer.copy_(buffer.clone())


#: Uses outside of inference mode.
USES: dict[str, Callable[[VoronoiRouter], None]] = {
    "train": train,
    "freeze": freeze,
    "subdivide": lambda router: train(subdivided(router)),
    "split": lambda router: train(split(router)),
    "load": lambda router: train(loaded(router)),
    "deepcopy": lambda router: train(copy.deepcopy(router)),
    "cell": run_cell,
    "buffers": write,
}


NAMES, ROWS = all_pairs({"name": ROUTERS, "change": CHANGES, "use": USES})
ROWS += [row for row in ((name, "call", use) for name in ROUTERS for use in USES) if row not in ROWS]


@pytest.mark.parametrize(NAMES, ROWS)
def test_uses_after_inference_mode(name: str, change: str, use: str) -> None:
    router = ROUTERS[name]()
    with torch.inference_mode():
        router = CHANGES[change](router)
    USES[use](router)


@pytest.mark.parametrize("name", ["fused", "grouped"])
def test_labels_of_methods_are_not_the_callers(name: str) -> None:
    """Labels that the caller overwrites after a call affect the next method only if they are passed to it."""
    options: Any = {"fuse": True} if name == "fused" else {"way": "grouped"}
    router, x = VoronoiRouter(Heads(), 3, methods=["density"], **options), points(60)
    with torch.no_grad():
        router.module.net[0].bias.add_(torch.arange(3.0)[:, None])
    labels = torch.arange(60, dtype=torch.int32) % 3
    one, other = (router.density(x, cells=cells)["sigma"] for cells in (labels, torch.zeros_like(labels)))
    for _ in range(2):
        for overwrites in (True, False):
            passed = labels.clone()
            router(x, cells=passed)
            passed.zero_()
            found = router.density(x, cells=passed if overwrites else labels)["sigma"]
            torch.testing.assert_close(found, other if overwrites else one)


def test_a_reservoir_of_inference_mode_takes_samples() -> None:
    with torch.inference_mode():
        reservoir = SampleReservoir(4, 2)
    for backend in ("auto", "reference"):
        reservoir.add(points(6), torch.ones(6), backend=backend)
    assert len(reservoir) == 4
