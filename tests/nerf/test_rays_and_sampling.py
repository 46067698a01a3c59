"""Tests of box intersection and stratified sampling, against slow loops and known properties."""

import pytest
import torch
from helpers import refuses, seeded

from voronerf.nerf import RayBatches, orbit_cameras
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.sampling import stratified_depths

BOX = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.5, 2.0]])


def slow_interval(origin, direction, box, near, far):
    """Finds the interval in the box by small steps along the ray."""
    steps = torch.linspace(near, far, 20001, dtype=torch.float64)
    points = origin.double() + steps[:, None] * direction.double()
    inside = ((points >= box[0].double()) & (points <= box[1].double())).all(-1)
    return (float(steps[inside][0]), float(steps[inside][-1])) if inside.any() else None


def test_box_against_slow_loop():
    generator = seeded(0)
    origins = torch.randn(60, 3, generator=generator) * 2
    origins[:5] *= 0.1  # some start inside
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator) - 0.5 * origins, dim=-1)
    near, far, hit = intersect_box(origins, directions, BOX, 0.25, 6.0)
    assert 10 < int(hit.sum()) < 60
    for i in range(60):
        expected = slow_interval(origins[i], directions[i], BOX, 0.25, 6.0)
        if expected is None:
            assert not hit[i] or float(far[i] - near[i]) < 1e-3
        else:
            assert hit[i] or expected[1] - expected[0] < 1e-3
            assert (float(near[i]), float(far[i])) == pytest.approx(expected, abs=1e-3)


def test_box_axis_parallel_rays_and_origin_on_a_face():
    origins = torch.tensor([[-3.0, 0, 1], [-3, 0.6, 1], [-1, 0, 1], [0, 0.5, 1], [-3, 0.5, 2], [0, 0, -1]])
    directions = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0], [0, -0.0, 1]])
    near, far, hit = intersect_box(origins, directions, BOX, 0.0, 10.0)
    assert hit.tolist() == [True, False, True, True, True, True]
    assert near[hit].tolist() == [2, 0, 0, 2, 1]
    assert far[hit].tolist() == [4, 0.5, 1, 4, 3]
    assert near[1] == far[1]
    assert not near.isnan().any() and not far.isnan().any()


def test_box_that_is_behind_or_beyond_is_missed():
    origins, directions = torch.tensor([[5.0, 0, 1], [-9, 0, 1]]), torch.tensor([[1.0, 0, 0], [1, 0, 0]])
    near, far, hit = intersect_box(origins, directions, BOX, 1.0, 6.0)
    assert not hit.any()
    assert torch.equal(near, far)


def test_no_box_no_rays_and_errors():
    origins = torch.zeros(4, 3)
    near, far, hit = intersect_box(origins, origins + 1, None, 2.0, 6.0)
    assert near.tolist() == [2] * 4 and far.tolist() == [6] * 4 and hit.all()
    assert intersect_box(origins[:0], origins[:0], BOX, 2.0, 6.0)[0].shape == (0,)
    refuses("0 <= near < far, got 3 and 3", intersect_box, origins, origins, BOX, 3, 3)
    refuses("same shape [r, 3]", intersect_box, origins, origins[:2], BOX, 1, 3)
    refuses("box must have shape [2, 3], got [3, 2]", intersect_box, origins, origins, BOX.T, 1, 3)


@pytest.mark.parametrize("spacing", ["linear", "disparity"])
@pytest.mark.parametrize("samples", [1, 7, 64])
def test_strata(spacing, samples):
    near = torch.tensor([2.0, 0.05, 1.0, 3.0])
    far = torch.tensor([6.0, 20.0, 1.0, 3.5])
    generator = seeded(1)
    depths, deltas, edges = stratified_depths(near, far, samples, jitter=True, spacing=spacing, generator=generator)
    assert depths.shape == deltas.shape == (4, samples) and edges.shape == (4, samples + 1)
    torch.testing.assert_close(deltas.sum(-1), far - near, atol=1e-5, rtol=1e-5)
    assert torch.equal(edges[:, 0], near) and torch.equal(edges[:, -1], far)
    assert (depths >= edges[:, :-1]).all() and (depths <= edges[:, 1:]).all()
    assert (deltas >= 0).all()
    middle, _, same_edges = stratified_depths(near, far, samples, jitter=False, spacing=spacing)
    assert torch.equal(edges, same_edges)
    assert torch.equal(middle, stratified_depths(near, far, samples, jitter=False, spacing=spacing)[0])


def test_spacing_is_the_formula():
    near, far, samples = 0.5, 8.0, 5
    formulas = {"linear": lambda f: near + f * (far - near), "disparity": lambda f: 1 / ((1 - f) / near + f / far)}
    for spacing, formula in formulas.items():
        ends = torch.tensor([near]), torch.tensor([far])
        depths, _, edges = stratified_depths(*ends, samples, jitter=False, spacing=spacing)
        assert edges[0].tolist() == pytest.approx([formula(i / samples) for i in range(samples + 1)], rel=1e-6)
        assert depths[0].tolist() == pytest.approx([formula((i + 0.5) / samples) for i in range(samples)], rel=1e-6)


def test_disparity_from_distance_0_is_finite():
    near, far = torch.zeros(3), torch.tensor([4.0, 1e-6, 0.0])
    depths, deltas, edges = stratified_depths(near, far, 5, jitter=True, spacing="disparity")
    for part in (depths, deltas, edges):
        assert part.isfinite().all() and (part >= 0).all()
    assert torch.equal(edges[:, -1], far) and torch.equal(edges[:, :-1], torch.zeros(3, 5))


def test_jitter_is_uniform_and_reproducible():
    near, far = torch.zeros(4000), torch.full((4000,), 4.0)
    first = stratified_depths(near, far, 4, jitter=True, generator=seeded(3))[0]
    again = stratified_depths(near, far, 4, jitter=True, generator=seeded(3))[0]
    assert torch.equal(first, again)
    inside = first - torch.arange(4.0)
    assert float(inside.mean()) == pytest.approx(0.5, abs=0.01)
    assert float(inside.var()) == pytest.approx(1 / 12, abs=0.003)


def test_a_generator_of_another_device_draws_there():
    one = torch.ones(4, device="meta")
    generator = seeded(3)
    parts = stratified_depths(one, one, 2, jitter=True, generator=generator)
    assert all(part.device.type == "meta" for part in parts)
    drawn = generator.get_state()
    torch.rand(4, 2, generator=generator.manual_seed(3))
    assert torch.equal(drawn, generator.get_state())


@pytest.mark.cuda
def test_a_generator_of_the_cpu_gives_cuda_rays_the_same_jitter():
    near, far = torch.zeros(40), torch.full((40,), 4.0)
    expected = stratified_depths(near, far, 4, jitter=True, generator=seeded(3))[0]
    depths = stratified_depths(near.cuda(), far.cuda(), 4, jitter=True, generator=seeded(3))[0]
    assert depths.is_cuda
    torch.testing.assert_close(depths.cpu(), expected)
    own = torch.Generator("cuda").manual_seed(3)
    assert stratified_depths(near.cuda(), far.cuda(), 4, jitter=True, generator=own)[0].is_cuda


def test_no_rays_and_errors():
    none = torch.zeros(0)
    assert [tuple(t.shape) for t in stratified_depths(none, none, 3, jitter=True)] == [(0, 3), (0, 3), (0, 4)]
    one = torch.ones(1)
    refuses("samples must be >= 1, got 0", stratified_depths, one, one, 0, jitter=False)
    spacings = "spacing must be one of linear, disparity, got 'log'"
    refuses(spacings, stratified_depths, one, one, 2, jitter=False, spacing="log")
    refuses("same shape [r], got [1] and [2]", stratified_depths, one, torch.ones(2), 2, jitter=False)


def test_the_last_rays_of_a_batch_may_be_triples_from_elsewhere():
    cameras = orbit_cameras(2, radius=2.0, elevation=0.0, width=40, height=30, focal=50.0)
    images = torch.zeros(2, 30, 40, 3, dtype=torch.uint8)
    usual, other = (RayBatches(cameras, images, near=1.0, far=3.0, unseen=far) for far in (0.0, 0.3))
    usual, other = usual.draw(120, seeded(0)), other.draw(120, seeded(0))
    assert (usual.unseen, other.unseen) == (0, 10)
    assert torch.equal(usual.rays.origins[:90], other.rays.origins[:90])
    moved = (usual.rays.origins - other.rays.origins)[90:100].abs().amax(1)
    assert float(moved.min()) > 0 and 0.15 < float(moved.max()) < 0.3
    assert torch.equal(other.rays.origins[90:100], other.rays.origins[110:])
    apart = (other.rays.directions[90:100] - other.rays.directions[110:]).norm(dim=1)
    assert float(apart.min()) > 0 and float(apart.max()) < 0.15 * 3**0.5
    message = "RayBatches: unseen must be 0 with a box, since unseen rays may miss it, got 0.3"
    refuses(message, RayBatches, cameras, images, near=1.0, far=3.0, box=BOX, unseen=0.3)
    nothing = torch.zeros(2, 30, 40, dtype=torch.bool)
    refuses("masks and boxes must leave pixels", RayBatches, cameras, images, near=1.0, far=3.0, masks=nothing)
