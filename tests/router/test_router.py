"""VoronoiRouter equals a loop over cells; subdivisions inherit parameters and moments, and keep state."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
import torch.nn.functional as F
from router_loop import masked_loop, perturb
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.fields import NeRF
from voronerf.router import VoronoiRouter
from voronerf.router.cells import draw_parameters


@pytest.fixture
def field() -> NeRF:
    return NeRF(width=10, depth=3, skips=(1,))


def samples(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    return torch.randn(n, 3, generator=generator), F.normalize(torch.randn(n, 3, generator=generator), dim=-1)


def trained(field: NeRF, generator: torch.Generator) -> tuple[VoronoiRouter, torch.optim.Optimizer]:
    """Returns a router of three cells after a few steps of Adam, and the optimiser."""
    router = VoronoiRouter(field, torch.randn(3, 3, generator=generator))
    optimizer = torch.optim.Adam(router.parameters(), lr=1e-3)
    for _ in range(3):
        rgb, sigma = router(*samples(50, generator))
        optimizer.zero_grad()
        (rgb.square().sum() + sigma.sum()).backward()
        optimizer.step()
    return router, optimizer


def test_results_from_before_a_split_that_are_still_held_do_not_disturb(
    field: NeRF, generator: torch.Generator
) -> None:
    """A split changes the shapes of the same parameter objects; a graph from before the split needs the old values."""
    router, _ = trained(field, generator)
    positions, directions = samples(200, generator)
    held = router(positions, directions)
    diagram, parents = router.diagram.refine({0: torch.randn(4, 3, generator=generator)})
    router.subdivide(diagram, parents)
    fresh = copy.deepcopy(router)
    for routed in (router, fresh):
        rgb, sigma = routed(positions, directions)
        (rgb.square().sum() + sigma.sum()).backward()
    for a, b in zip(router.parameters(), fresh.parameters(), strict=True):
        assert a.grad.shape == a.shape and torch.equal(a.grad, b.grad)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        held[0].sum().backward()


def test_random_initialisation_is_fresh_and_reproducible(field: NeRF, generator: torch.Generator) -> None:
    weights = []
    for _ in range(2):
        router, optimizer = trained(field, torch.Generator().manual_seed(1))
        router.generator = torch.Generator().manual_seed(5)
        diagram, parents = router.diagram.refine({0: torch.tensor([[0.0, 0, 0], [1, 0, 0]])})
        router.subdivide(diagram, parents, optimizer=optimizer, inherit=False)
        weights.append(router.module.trunk[0].weight.detach().clone())
        state = optimizer.state[router.module.trunk[0].weight]
        assert state["exp_avg"][:2].abs().sum() == 0 and state["exp_avg"][2:].abs().sum() > 0
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0][0], weights[0][1])
    shared = VoronoiRouter(field, torch.zeros(1, 3), share=["trunk.0.weight"]).module
    names = {name for name, _ in field.named_parameters()} - {"trunk.0.weight"}
    assert draw_parameters(shared, 2, None).keys() == names  # a large shared table is not drawn


def test_copies_and_the_wrapped_field_are_independent(field: NeRF, generator: torch.Generator) -> None:
    router = VoronoiRouter(field, torch.randn(3, 3, generator=generator))
    positions, directions = samples(20, generator)
    before = router(positions, directions)[0]
    for other in (copy.deepcopy(router), pickle.loads(pickle.dumps(router))):
        perturb(other, generator)
        assert not torch.equal(other(positions, directions)[0], before)
    assert torch.equal(router(positions, directions)[0], before)
    perturb(router, generator)
    torch.testing.assert_close(field(positions, directions)[0], before)


@pytest.mark.parametrize("kind", ["one", "flat", "nested"])
def test_every_kind_of_diagram_equals_the_loop(kind: str, field: NeRF, generator: torch.Generator) -> None:
    diagram = VoronoiDiagram(torch.randn(1 if kind == "one" else 4, 3, generator=generator))
    if kind == "nested":
        diagram, _ = diagram.refine({1: torch.randn(3, 3, generator=generator)})
    router = perturb(VoronoiRouter(field, diagram), generator)
    positions, directions = samples(50, generator)
    positions.requires_grad_()
    result, expected = router(positions, directions), masked_loop(router, positions, directions)
    torch.testing.assert_close(list(result), expected)
    ours, theirs = (torch.autograd.grad(c.sum() + d.sum(), positions) for c, d in (result, expected))
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    shifted, _ = router(positions, directions, coords=positions + 1)
    assert torch.allclose(shifted, result[0]) == (kind == "one")


def test_stochastic_assignment_is_for_training_only(field: NeRF, generator: torch.Generator) -> None:
    router = VoronoiRouter(field, torch.randn(8, 3, generator=generator), assignment="stochastic", temperature=0.3)
    router.generator = torch.Generator().manual_seed(0)
    positions, _ = samples(500, generator)
    nearest = router.diagram.locate(positions)
    drawn = router.assign(positions)
    assert 0.1 < (drawn != nearest).float().mean() < 0.9
    assert not torch.equal(router.assign(positions), drawn)
    assert torch.equal(router.eval().assign(positions), nearest)
