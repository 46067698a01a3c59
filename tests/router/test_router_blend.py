"""Blended routing against a loop over the entries, and where it leaves things alone."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from router_fields import Heads, SkipNet, perturb, tensors
from torch import Tensor, nn

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.diagram.blending import blend_cells

MARGIN = 0.3


def nested() -> VoronoiDiagram:
    generator = torch.Generator().manual_seed(3)
    diagram = VoronoiDiagram(torch.randn(4, 3, generator=generator))
    return diagram.refine({1: torch.randn(3, 3, generator=generator), 2: torch.randn(2, 3, generator=generator)})[0]


def by_entries(
    router: VoronoiRouter, positions: Tensor, args: tuple[Any, ...], method: str = "forward"
) -> list[Tensor]:
    """Each sample in each of its leaves, one by one cell, and the weighted sum; flat arguments."""
    weights = torch.zeros(len(positions), router.num_cells, dtype=torch.float64)
    weights[torch.arange(len(positions)), router.diagram.locate(positions).long()] = 1
    blend = blend_cells(router.diagram, positions, router.blend)
    weights[blend.rows] = 0
    weights[blend.rows, blend.cells.long()] = blend.weights.double()
    totals: list[Tensor] = []
    for cell in range(router.num_cells):
        found = [t.detach().double() for t in tensors(getattr(router.cell(cell), method)(*args))]
        totals = totals or [torch.zeros_like(t) for t in found]
        for total, part in zip(totals, found):
            total += part * weights[:, cell].reshape(-1, *[1] * (part.dim() - 1))
    return totals


def near(found: list[Tensor], expected: list[Tensor]) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected):
        assert a.shape == b.shape and torch.allclose(a.detach().double(), b, rtol=1e-4, atol=2e-5)


def test_one_sample_and_none() -> None:
    generator = torch.Generator().manual_seed(5)
    router = perturb(VoronoiRouter(SkipNet(), nested(), coords="first3", blend=MARGIN), generator).eval()
    seen = 0
    for _ in range(20):
        x = torch.randn(1, 15, generator=generator)
        near([router(x)], by_entries(router, x[:, :3], (x,)))
        seen += blend_cells(router.diagram, x[:, :3], MARGIN).rows.numel()
    assert seen > 10
    assert router(torch.zeros(0, 15)).shape == (0, 4)


class Kinds(nn.Module):
    """A result of numbers and one of flags."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(3, 2)

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"inside": h[:, 0] > 0, "h": h}


def test_what_is_no_number_stays_the_nearest_cells() -> None:
    generator = torch.Generator().manual_seed(5)
    router = perturb(VoronoiRouter(Kinds(), nested(), coords="first3", blend=MARGIN), generator).eval()
    plain = copy.deepcopy(router)
    plain.blend = 0.0
    x = torch.randn(200, 3, generator=generator)
    mixed, own = router(x), plain(x)
    assert torch.equal(mixed["inside"], own["inside"])
    assert not torch.equal(mixed["h"], own["h"])


def layered(diagram: VoronoiDiagram | None = None) -> VoronoiRouter:
    field = NeRF(width=8, depth=2, position_octaves=2, direction_octaves=1)
    return perturb(VoronoiRouter(field, diagram or nested()), torch.Generator().manual_seed(5)).eval()


@pytest.mark.parametrize("index", [False, True])
def test_a_layer_table(index: bool) -> None:
    router = layered()
    router.blend = MARGIN
    x = torch.randn(400, 3)
    directions = nn.functional.normalize(torch.randn(40 if index else 400, 3), dim=1)
    ray_index = torch.arange(40, dtype=torch.int32).repeat_interleave(10) if index else None
    spread = directions if ray_index is None else directions[ray_index.long()]
    near(list(router(x, directions, ray_index)), by_entries(router, x, (x, spread)))
    at = torch.randn(400, 3)
    near(list(router(x, directions, ray_index, coords=at)), by_entries(router, at, (x, spread)))


@pytest.mark.parametrize("kind", ["table", "module"])
def test_other_samples_are_as_without(kind: str) -> None:
    router = layered() if kind == "table" else VoronoiRouter(Heads(), nested(), coords="first3")
    perturb(router, torch.Generator().manual_seed(1)).eval()
    x, d = torch.randn(3000, 3), nn.functional.normalize(torch.randn(3000, 3), dim=1)
    own = router(x, d)
    router.blend = 0.1
    mixed = router(x, d)
    margin = torch.zeros(3000, dtype=torch.bool)
    margin[blend_cells(router.diagram, x, 0.1).rows] = True
    assert 100 < int(margin.sum()) < 2000
    for a, b in zip(own, mixed):
        assert torch.equal(a[~margin], b[~margin])
        assert not torch.equal(a[margin], b[margin])
    for case in ("training", "zero"):
        router.train(case == "training")
        router.blend = 0.1 if case == "training" else 0.0
        assert all(torch.equal(a, b) for a, b in zip(own, router(x, d)))


def test_nothing_jumps_across_borders() -> None:
    router = layered(VoronoiDiagram(torch.randn(6, 3)))
    count = 20_000
    x = torch.lerp(
        torch.tensor([[-2.0, 0.3, 0.1]]), torch.tensor([[2.0, -0.2, 0.4]]), torch.linspace(0, 1, count)[:, None]
    )
    d = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3)
    borders = int((router.diagram.locate(x).diff() != 0).sum())
    assert borders >= 2
    jumps = []
    for router.blend in (0.0, 0.2):
        colour, density = router(x, d)
        jumps.append(float(torch.cat([colour, density[:, None]], 1).detach().diff(dim=0).abs().max()))
    assert jumps[0] > 0.05 and jumps[1] < 0.05 * jumps[0]


def test_the_setting() -> None:
    router = VoronoiRouter(nn.Linear(3, 2), torch.randn(3, 3), coords="first3", blend=0.25)
    assert copy.deepcopy(router).blend == 0.25 and "blend" not in "".join(router.state_dict())
