"""Tests of several passes along a ray, against slow loops and known images."""

import math

import pytest
import torch
from helpers import refuses, renderer_of, seeded
from torch import Tensor

from voronerf.nerf import (
    Batch,
    Contraction,
    Hierarchical,
    Occupancy,
    OccupancyGrid,
    RayLoss,
    Rays,
    Renderer,
    Space,
    Stratified,
)
from voronerf.nerf.sampling import PADDING, blurred_weights, stratified_edges, union_depths

WHITE = torch.ones(3)


class Slab:
    """A field of red fog between two heights, which records the queried positions."""

    def __init__(self, low=-0.05, high=0.05, density=30.0):
        self.low, self.high, self.density = low, high, density
        self.asked: list[Tensor] = []

    def __call__(self, positions, directions, ray_index):
        self.asked.append(positions)
        inside = (positions[:, 2] > self.low) & (positions[:, 2] < self.high)
        return torch.tensor((0.9, 0.2, 0.1)).expand(len(positions), 3), self.density * inside


def rays(count=3):
    """Returns parallel rays straight down from height 2."""
    origins = torch.tensor((0.0, 0.0, 2.0)).repeat(count, 1)
    origins[:, 0] = torch.arange(count)
    return Rays(origins, torch.tensor((0.0, 0.0, -1.0)).repeat(count, 1), torch.full((count,), 0.01))


def test_a_second_pass_finds_a_thin_surface():
    """With 16 strata, a slab as thick as a fortieth of the ray has a wrong opacity; a second pass corrects it."""
    expected = 1 - math.exp(-30 * 0.1)
    one = renderer_of({"field": Slab()}, samples=17).render(rays(), 0.0, 4.0)
    assert len(one) == 1 and abs(float(one[0].opacity[0]) - expected) > 0.04
    for fields, cones in (({"field": Slab(), "coarse": Slab()}, False), ({"field": Slab()}, True)):
        passes = renderer_of(fields, samples=17, fine_samples=64, cones=cones).render(rays(), 0.0, 4.0)
        assert len(passes) == 2
        assert abs(float(passes[1].opacity[0]) - expected) < 0.02
        # Fog of density 30 reaches from 1.95 to 2.05: its depth is the mean of a truncated exponential distribution.
        within = 1 / 30 - 0.1 * math.exp(-3) / expected
        assert float(passes[1].depth[0]) == pytest.approx(1.95 + within, abs=0.005)


def test_who_is_asked_about_what():
    for first, options, of_first, of_field in (
        ("coarse", {"fine_samples": 4}, [[3 * 8, 3]], [[3 * 12, 3]]),
        (None, {"fine_samples": 4, "cones": True}, [], [[3 * 8, 6], [3 * 4, 6]]),
        (None, {}, [], [[3 * 8, 3]]),
    ):
        field, other = Slab(), Slab()
        fields = {"field": field} if first is None else {"field": field, first: other}
        renderer_of(fields, samples=8, **options).render(rays(), 0.0, 4.0)
        assert [list(p.shape) for p in other.asked] == of_first
        assert [list(p.shape) for p in field.asked] == of_field


def test_union_against_slow_loop():
    generator = seeded(0)
    edges = torch.rand(5, 9, generator=generator).cumsum(1)
    weights = torch.rand(5, 8, generator=generator)
    weights[3] = 0
    depths = (edges[:, 1:] + edges[:, :-1]) / 2
    every, ends = union_depths(depths, edges, weights, 4)
    for ray in range(5):
        mass = weights[ray] if ray != 3 else torch.ones(8)
        cumulative = torch.cat((torch.zeros(1), mass.cumsum(0))) / mass.sum()
        new = []
        for i in range(4):
            u = (i + 0.5) / 4
            b = max(j for j in range(8) if float(cumulative[j]) <= u)
            inside = (u - cumulative[b]) / (cumulative[b + 1] - cumulative[b])
            new.append(edges[ray, b] + inside * (edges[ray, b + 1] - edges[ray, b]))
        expected = torch.stack([*new, *depths[ray]]).sort().values
        torch.testing.assert_close(every[ray], expected)
        for i in range(11):
            assert float(ends[ray, i + 1]) == pytest.approx(float(expected[i] + expected[i + 1]) / 2, abs=1e-6)
        assert ends[ray, 0] == edges[ray, 0] and ends[ray, -1] == edges[ray, -1]


def test_blurred_weights_against_slow_loop():
    weights = torch.rand(4, 7, generator=seeded(0))
    got = blurred_weights(weights)
    for ray in range(4):
        w = [float(x) for x in weights[ray]]
        for k in range(7):
            left, right = w[max(k - 1, 0)], w[min(k + 1, 6)]
            expected = (max(left, w[k]) + max(w[k], right)) / 2 + PADDING
            assert float(got[ray, k]) == pytest.approx(expected, rel=1e-5)
    assert (got > weights).all()
    assert float(blurred_weights(torch.ones(1, 1))) == pytest.approx(1 + PADDING)


def test_losses():
    target, higher = torch.rand(3, 3), Slab(0.2, 0.8)
    near, far = torch.zeros(3), torch.full((3,), 4.0)
    for others, cones, share in (({}, True, 0.1), ({"coarse": higher}, False, 1.0)):
        renderer = renderer_of({"field": Slab(), **others}, samples=6, fine_samples=5, cones=cones)
        first, last = renderer.render(rays(), near, far, background=WHITE, jitter=True, generator=seeded(2))
        expected = (last.colour - target).square().mean() + share * (first.colour - target).square().mean()
        actual = RayLoss(renderer)(Batch(rays(), near, far, target, WHITE), seeded(2))
        torch.testing.assert_close(actual.loss, expected)
        torch.testing.assert_close(actual.error, (last.colour - target).square().sum(1))


@pytest.mark.parametrize("spacing", ["linear", "disparity"])
@pytest.mark.parametrize("samples", [1, 2, 33])
def test_jittered_edges_cover_the_ray(spacing, samples):
    near, far = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 2.0, 30.0])
    even = stratified_edges(near, far, samples, jitter=False, spacing=spacing)
    edges = stratified_edges(near, far, samples, jitter=True, spacing=spacing, generator=seeded(0))
    assert edges.shape == even.shape == (3, samples + 1)
    assert torch.equal(edges[:, 0], near) and torch.equal(edges[:, -1], far)
    assert (edges.diff(dim=1) >= 0).all() and torch.equal(edges, even) == (samples == 1)


def test_training_draws_differ_and_pictures_do_not():
    for fields, cones in (({"field": Slab(), "coarse": Slab()}, False), ({"field": Slab()}, True)):
        renderer = renderer_of(fields, samples=8, fine_samples=8, cones=cones)
        seeds = [seeded(seed) for seed in (0, 0, 1)]
        a, b, c = (renderer.render(rays(), 0.0, 4.0, jitter=True, generator=seed)[-1] for seed in seeds)
        assert torch.equal(a.samples.depths, b.samples.depths) and not torch.equal(a.samples.depths, c.samples.depths)
        still = [renderer.render(rays(), 0.0, 4.0)[-1].samples.depths for _ in range(2)]
        assert torch.equal(*still)


def test_contracted_positions_are_what_the_field_sees():
    space = Contraction(torch.zeros(3), 0.5)
    for cones in (False, True):
        field = Slab()
        passes = renderer_of({"field": field}, samples=8, cones=cones, contraction=space).render(rays(), 0.0, 400.0)
        assert torch.equal(passes[0].samples.positions, field.asked[0][:, :3])
        assert float(passes[0].samples.positions.norm(dim=-1).max()) < 1


def test_refusals():
    grid, sphere = (
        OccupancyGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), 2, threshold=1.0),
        Contraction(torch.zeros(3), 1.0),
    )
    refuses("fields must be field, got ['coarse']", Renderer, {"coarse": Slab()}, Stratified(3))
    refuses("fields must be field and coarse, got ['field']", Renderer, {"field": Slab()}, Hierarchical(3, 3))
    refuses("Stratified: samples must be >= 1, got 0", Stratified, 0)
    refuses("Hierarchical: fine_samples must be >= 1, got 0", Hierarchical, 3, 0)
    for space in (Space(sphere), Space(cones=True)):
        refuses("grid requires point samples and the same contraction as the space", Occupancy, grid, 3, space=space)
