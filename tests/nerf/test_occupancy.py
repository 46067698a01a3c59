"""Tests of the occupancy grid, and of rendering with it: images must not change where space is skipped."""

import math

import pytest
import torch
from helpers import refuses, render_image, renderer_of, seeded

from voronerf import HashGridField, NeRF, VoronoiRouter
from voronerf.app.scenes import builtin_scene
from voronerf.nerf import (
    Adam,
    Batch,
    Cameras,
    Contraction,
    Occupancy,
    OccupancyGrid,
    Perspective,
    RayBatches,
    RayLoss,
    Rays,
    Renderer,
    Stratified,
    TrainingStep,
    intersect_box,
    orbit_cameras,
    render_rays,
)
from voronerf.nerf.radiance import radiance_of
from voronerf.nerf.samplers import SETTLING_PART
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.volume import RenderOutput, Space

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
WHITE = torch.ones(3)


class Ball:
    """A field with a coloured ball of radius 0.5 in empty space; it counts the queried positions."""

    def __init__(self, density=60.0):
        self.density, self.asked = density, 0

    def __call__(self, positions, directions, ray_index):
        assert len(ray_index) == len(positions) and (not len(ray_index) or int(ray_index.max()) < len(directions))
        self.asked += len(positions)
        return (positions + 1) / 2, self.density * (positions.norm(dim=-1) < 0.5)


def cameras(size=24):
    return orbit_cameras(2, radius=3.0, elevation=20.0, width=size, height=size, focal=size * 1.1)


def grid_of(field, resolution=8, looks=3):
    grid = OccupancyGrid(BOX, resolution, threshold=0.1)
    generator = seeded(0)
    for look in range(looks):
        grid.update(field, decay=float(look > 0), generator=generator)
    return grid


def tight_grid(resolution=24):
    """Returns a grid in which all voxels that intersect the ball are occupied, and few others."""
    grid = OccupancyGrid(BOX, resolution, threshold=0.1)
    middles = grid.points(torch.arange(resolution**3)).norm(dim=-1)
    grid.occupied = (middles < 0.5 + 3**0.5 / resolution).reshape(grid.occupied.shape)
    return grid


def test_a_grid_finds_what_is_empty():
    grid = OccupancyGrid(BOX, (8, 10, 12), threshold=0.1)
    assert grid.share == 1 and grid.occupied.shape == (8, 10, 12)
    for look in range(20):
        grid.update(Ball(), decay=float(look > 0), generator=seeded(look))
    middles = grid.points(torch.arange(960)).norm(dim=-1).reshape(8, 10, 12)
    half = (torch.tensor([2 / 8, 2 / 10, 2 / 12]) / 2).norm()
    assert bool(grid.occupied[middles < 0.5 - half].all())
    assert not bool(grid.occupied[middles > 0.5 + half].any())


def test_cells_that_are_looked_at_fade_and_the_others_stay():
    grid = OccupancyGrid(BOX, 4, threshold=0.1)
    grid.update(lambda p, d, i: (p, torch.full((len(p),), 8.0)))
    seen = torch.arange(0, 64, 2)
    grid.update(lambda p, d, i: (p, torch.full((len(p),), torch.nan)), seen[:3])
    grid.update(lambda p, d, i: (p, torch.zeros(len(p))), seen[3:], decay=0.01)
    density = grid.density.reshape(-1)
    assert density[seen[:3]].tolist() == [torch.inf] * 3
    assert bool((density[seen[3:]] == torch.tensor(8.0) * 0.01).all()) and not bool(
        grid.occupied.reshape(-1)[seen[3:]].any()
    )
    assert bool((density[1::2] == 8).all())


def test_a_visit_raises_what_it_meets_and_leaves_the_rest():
    grid = OccupancyGrid(BOX, 4, threshold=0.1, remembered=1.0)
    fixed = torch.rand(4, 4, 4, generator=seeded(0)) < 0.5
    seed, ball = torch.tensor([5], dtype=torch.int32), Ball(8.0)
    grid.revisit(ball, 2000, seed, fixed=fixed)
    assert ball.asked == 2000
    near = grid.points(torch.arange(64)).norm(dim=1).view(4, 4, 4) < 0.5
    assert grid.density[near & ~fixed].tolist() == [8.0] * int((near & ~fixed).sum())
    assert bool((grid.density[fixed | (grid.density != 8)] == 0.1).all()) and bool((near & fixed).any())
    other = OccupancyGrid(BOX, 4, threshold=0.1, remembered=1.0)
    other.revisit(ball, 2000, seed, fixed=fixed)
    assert torch.equal(grid.density, other.density)
    # A NaN density counts as dense.
    grid.revisit(lambda p, d, i: (p, torch.full((len(p),), torch.nan)), 2000, seed)
    assert bool((grid.density == torch.inf).all())


def test_voxels_of_a_sampler_stay_empty():
    empty = torch.rand(8, 8, 8, generator=seeded(1)) < 0.5
    sampler = Occupancy(OccupancyGrid(BOX, 8, threshold=0.1), 16, empty=empty.flatten())
    sampler.grid = OccupancyGrid(BOX, 8, threshold=0.1)
    ball, random = Ball(), seeded(0)
    rays = Rays(torch.tensor([[0.0, 0, -3]]).expand(50, 3), torch.tensor([[0.0, 0, 1]]).expand(50, 3))
    for step in range(sampler.settling_steps, sampler.settling_steps + GROUP):
        sampler.step_pre_backward(ball, step, random)
        result = render_rays(ball, rays, 0.0, 6.0, samples=sampler, jitter=True, generator=random)
        none = torch.zeros(())
        sampler.step_post_backward(RenderOutput(none, none, result.weights, result.density, result.samples, none))
        assert not bool(sampler.grid.occupied[empty].any()) and not bool(sampler.grid.density[empty].any())
    assert ball.asked > 64 and bool(sampler.grid.occupied[~empty].any())


def test_a_ray_has_a_part_of_its_strata_while_the_grid_settles():
    sampler, rays = Occupancy(OccupancyGrid(BOX, 8, threshold=0.1), 16), Rays(torch.zeros(1, 3), torch.eye(3)[:1])
    for step, strata in ((sampler.settling_steps - 1, 16 // SETTLING_PART), (sampler.settling_steps, 16)):
        sampler.step_pre_backward(Ball(), step, seeded(0))
        assert len(sampler.sample(rays, torch.zeros(1), torch.ones(1), jitter=True).depths) == sampler.strata == strata


def fog_with(density, ball=0.0):
    """Returns a field of the ``density`` that rises by a tenth along x, with a ball of another density."""

    def field(positions, directions, ray_index):
        fog = density * (1 + 0.05 * positions[:, 0])
        return positions, torch.where(positions.norm(dim=-1) < 0.7, ball, fog) if ball else fog

    return field


def test_a_grid_learns_only_from_a_field_that_tells_empty_space():
    grid, inside = OccupancyGrid(BOX, 8, threshold=1.0), torch.ones(8, 8, 8, dtype=torch.bool)
    inside[2:6, 2:6, 2:6] = False
    cases = [(0.0, 0.0, False), (0.5, 0.0, False), (1.0, 0.0, False), (2.0, 0.0, False)]  # almost uniform
    cases += [(0.1, 0.9, False), (0.5, 2.0, False), (0.1, 4.0, True)]  # the ball, or most of it, is below the threshold
    cases += [(0.1, torch.nan, True), (0.1, torch.inf, True)]
    for density, ball, learns in cases:
        assert grid.can_learn_from(fog_with(density, ball)) is learns, (density, ball)
    assert grid.can_learn_from(Ball()) and not grid.can_learn_from(Ball(), fixed=~inside)
    sampler = Occupancy(grid, 16, empty=~inside)
    sampler.step_pre_backward(Ball(), sampler.settling_steps, seeded(0))
    assert sampler.settling and grid.settled is None
    sphere = OccupancyGrid.for_training(None, 16, contraction=Contraction(torch.zeros(3), 1.0))
    assert not sphere.can_learn_from(fog_with(0.1)) and sphere.can_learn_from(fog_with(0.1, 4.0))


def test_a_grid_waits_for_a_field_with_a_low_learning_rate():
    """Regression: after a fixed number of steps, the grid became empty, and the field learnt nothing."""
    scene = builtin_scene(16, train_views=20, test_views=1)
    side = float((scene.box[1] - scene.box[0]).max())
    densities = {"density_scale": 200 / side, "initial_density": 2 / side}
    torch.manual_seed(0)
    field = HashGridField(16, levels=4, log2_entries=12, finest=32, box=tuple(scene.box.tolist()), **densities)
    router = VoronoiRouter(field, torch.zeros(1, 3), share=["features"])
    sampler = Occupancy(OccupancyGrid.for_training(scene.box, 256, resolution=16), 256)
    where = {"near": scene.near, "far": scene.far, "box": scene.box, "background": WHITE}
    batches = RayBatches(scene.train.cameras, scene.train.images, **where)
    loss, optimizer = RayLoss(Renderer({"field": router}, sampler)), Adam.of({"field": router}, lr=1e-3)
    step = TrainingStep(batches, loss, optimizer, generator=seeded(0))
    losses = [float(step(64, GROUP, at=at).loss) for at in range(0, 640, GROUP)]
    assert sampler.grid.settled > 100 and 0.1 < sampler.grid.share < 0.6
    assert sum(losses[-5:]) < sum(losses[:5]) / 2


@pytest.mark.parametrize(
    "field", [HashGridField(width=8, log2_entries=10), NeRF(width=8, depth=2), NeRF(width=8, view_directions=False)]
)
def test_the_density_of_a_router_is_found_without_its_colour(field):
    router = VoronoiRouter(field, torch.rand(5, 3), share=[n for n, _ in field.named_parameters() if n == "features"])
    networks = radiance_of(router).networks
    every, alone = (sum(step.op == "linear" for step in part.steps) for part in (networks.program, networks.density))
    assert alone < every and not networks.density.rays


def test_points_lie_in_their_cells():
    grid = OccupancyGrid(torch.tensor([[0.0, 10.0, -4.0], [2.0, 13.0, 0.0]]), (2, 3, 4), threshold=1)
    every = torch.arange(24)
    assert grid.points(every)[0].tolist() == [0.5, 10.5, -3.5]
    for _ in range(4):
        points = grid.points(every, torch.rand(24, 3))
        place = (points - grid.box[0]).long()
        assert torch.equal((place[:, 0] * 3 + place[:, 1]) * 4 + place[:, 2], every)
        assert torch.equal(grid.voxels(points), every.int())
    border = torch.tensor([[-1.0, 10.5, -3.5], [2.0, 13.0, 0.0], [9.0, 99.0, torch.nan]])
    assert grid.voxels(border).tolist() == [0, 23, 20] and grid.voxels(border).dtype == torch.int32


def test_samples_of_a_batch_teach_what_is_empty_and_what_is_hidden():
    """Rays from all directions keep a ball's shell occupied; the air and most of the hidden interior become empty."""
    grid, ball = OccupancyGrid(BOX, 16, threshold=0.1), Ball(200.0)
    random = seeded(0)
    for _ in range(60):
        origins = 3 * torch.nn.functional.normalize(torch.randn(300, 3, generator=random), dim=1)
        towards = torch.rand(300, 3, generator=random) * 1.6 - 0.8
        rays = Rays(origins, torch.nn.functional.normalize(towards - origins, dim=1))
        near, far, hit = intersect_box(rays.origins, rays.directions, BOX, 0.0, 9.0)
        arguments = {"samples": Occupancy(grid, 64), "jitter": True, "generator": random}
        seen = render_rays(ball, rays[hit], near[hit], far[hit], **arguments)
        grid.observe(seen.samples.positions, seen.density, seen.samples.deltas, seen.weights, decay=0.8)
    distance = grid.points(torch.arange(16**3)).norm(dim=-1).reshape(16, 16, 16)
    half = 3**0.5 / 16
    corners = grid.points(torch.arange(16**3)).abs().amax(-1).reshape(16, 16, 16) > 0.8
    assert not bool(grid.occupied[(distance > 0.5 + half) & ~corners].any())
    # Single voxels inside become occupied again, since rays pass through corners of the shell.
    assert float(grid.occupied[distance < 0.5 - 2.5 * half].float().mean()) < 0.2
    options = {"near": 1.0, "far": 5.0, "box": BOX, "samples": 64, "background": WHITE}
    plain, quick = (
        render_image(ball, cameras(), 0, occupancy=occupancy, **options).colour for occupancy in (None, grid)
    )
    assert float((plain - quick).abs().mean()) < 2e-3
    before = ball.asked
    render_rays(ball, rays[hit], near[hit], far[hit], samples=Occupancy(grid, 64))
    assert (ball.asked - before) * 5 < 64 * int(hit.sum())
    # An update restores the density of a voxel inside the ball.
    inside = grid.voxels(torch.zeros(1, 3))
    grid.update(ball, inside, decay=1.0)
    assert float(grid.density.reshape(-1)[inside]) == 200.0
    # A NaN density counts as dense.
    grid.observe(torch.full((1, 3), 0.95), torch.tensor([torch.nan]), torch.ones(1), torch.ones(1), decay=0.0)
    assert bool(grid.occupied[15, 15, 15])
    refuses("observe: decay must lie in 0..1, got -1", grid.observe, torch.zeros(1, 3), *[torch.zeros(1)] * 3, decay=-1)


def test_holes_in_a_surface_are_filled_where_the_field_is_dense():
    """Emptied voxels in a dense ball become occupied; separate voxels, thin balls and air stay empty."""
    radius = torch.stack(torch.meshgrid(*[torch.linspace(-15 / 16, 15 / 16, 16)] * 3, indexing="ij")).norm(dim=0)

    def emptied(density, contraction=None):
        grid = OccupancyGrid(BOX, 16, threshold=1.0, contraction=contraction)
        grid.occupied = radius < 0.5
        grid.occupied[8, 8, 8] = grid.occupied[10, 8, 8] = False
        grid.density = 60.0 * grid.occupied
        before = grid.occupied.clone()

        def field(positions, directions, ray_index):
            ball, alone = positions.norm(dim=-1) < 0.5, positions[:, 0] > 0.7
            return positions, torch.where(ball, density, torch.where(alone, 60.0, 0.0))

        grid.fill_holes(field, generator=seeded(0))
        assert torch.equal(grid.occupied, grid.density >= grid.threshold)
        assert bool(grid.occupied[before].all())
        return grid, grid.occupied & ~before

    grid, filled = emptied(60.0)
    assert bool(filled[8, 8, 8]) and bool(filled[10, 8, 8]) and float(grid.density[8, 8, 8]) == 4.0
    assert bool((radius[filled] < 0.5 + 3**0.5 / 16).all())
    assert not bool(emptied(3.0)[1].any())  # the density is below four times the threshold
    # Thresholds apply to density per contracted unit, which is longer in the world away from the centre.
    contracted = emptied(3.0, Contraction(torch.zeros(3), 0.2))[1]
    assert bool(contracted[10, 8, 8]) and not bool(contracted[8, 8, 8])


def test_what_few_cameras_see_is_dropped_inside_the_sphere():
    """A wall that four cameras see stays, also beyond the sphere; a cloud before one of them is dropped."""
    contraction = Contraction(torch.zeros(3), 1.0)
    grid = OccupancyGrid.for_training(None, 64, contraction=contraction, resolution=32)
    x, y, z = grid.points(torch.arange(32**3)).T.view(3, 32, 32, 32)
    cloud = (x - 0.5).square() + y.square() + (z - 0.3).square() < 0.2**2

    def field(positions, directions, ray_index):
        wall = positions[:, 2] < -0.5
        near_cloud = (positions - positions.new_tensor([0.5, 0, 0.3])).norm(dim=-1) < 0.2
        return torch.ones_like(positions), torch.where(wall | near_cloud, 1e3, 0.0)

    views = []
    for place in (-0.5, -0.2, 0.2, 0.5):
        across = torch.linspace(-0.4, 0.4, 40)
        ends = torch.stack(
            (*torch.meshgrid(across + 0.4 * (place > 0.4), across, indexing="ij"), torch.full((40, 40), -0.5)), -1
        )
        origin = torch.tensor([place, 0.0, 0.9])
        views.append(Rays(origin.expand(1600, 3), torch.nn.functional.normalize(ends.view(-1, 3) - origin, dim=-1)))
    sampler = Occupancy(grid, 64, space=Space(contraction=contraction))
    sampler.drop_floaters(field, views, near=0.05, far=4.0)
    outside = x.square() + y.square() + z.square() >= 1
    assert not bool(grid.occupied[cloud].any()) and bool(grid.occupied[outside].all())
    assert bool(grid.occupied[(z < -0.5) & (z > -0.56) & (x.abs() < 0.3) & (y.abs() < 0.3)].all())
    assert torch.equal(grid.occupied, grid.density >= grid.threshold)


def test_pictures_have_more_strata_in_contracted_space():
    for contraction, strata in ((None, {40: 80, 256: 384, 500: 500}), (Contraction(torch.zeros(3), 1.0), {384: 576})):
        grid = OccupancyGrid(BOX, 4, threshold=0.1, contraction=contraction)
        space = Space(contraction=contraction)
        assert {n: Occupancy(grid, n, space=space).picture_samples for n in strata} == strata


def test_specks_are_dropped_and_thin_things_stay():
    """Groups of one or two voxels that touch (at a corner suffices) are dropped as dust; a line of three is kept."""
    grid = OccupancyGrid(BOX, 12, threshold=1.0)
    grid.occupied = torch.zeros(12, 12, 12, dtype=torch.bool)
    kept = [(0, 0, 0), (1, 1, 1), (2, 2, 2), *((8, y, z) for y in (4, 5, 6) for z in (4, 5))]
    for voxel in [*kept, (0, 11, 11), (5, 9, 1), (6, 10, 2), (11, 0, 5)]:
        grid.occupied[voxel] = True
    grid.density = 3.0 * grid.occupied
    Occupancy(grid, 8).finish(Ball(), seed=0)
    assert sorted(map(tuple, grid.occupied.nonzero().tolist())) == sorted(kept)
    assert torch.equal(grid.density, 3.0 * grid.occupied)


def test_a_grid_that_is_mostly_full_at_the_end_is_emptied_by_its_field():
    """A field empties a grid that is more than half full, unless the field cannot tell empty space."""

    def fog(positions, directions, ray_index):
        return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)

    shares = []
    for field, occupied in ((Ball(), 1.0), (fog, 1.0), (Ball(), 0.5)):
        grid = OccupancyGrid(BOX, 16, threshold=1.0)
        grid.density[int(16 * occupied) :] = grid.occupied[int(16 * occupied) :] = 0
        Occupancy(grid, 8).finish(field, seed=0)
        assert torch.equal(grid.occupied, grid.density >= grid.threshold)
        shares.append(grid.share)
    assert shares[0] < 0.2 and shares[1:] == [1.0, 0.5]


def test_images_are_the_same_with_a_fraction_of_the_samples():
    dense, sparse = Ball(), Ball()
    options = {"near": 1.0, "far": 5.0, "box": BOX, "samples": 96, "background": WHITE}
    plain = render_image(dense, cameras(), 0, **options)
    grid = tight_grid()
    quick = render_image(sparse, cameras(), 0, occupancy=grid, **options)
    assert sparse.asked * 8 < dense.asked
    torch.testing.assert_close(quick.colour, plain.colour, atol=5e-3, rtol=0)
    torch.testing.assert_close(quick.opacity, plain.opacity, atol=5e-3, rtol=0)
    solid = plain.opacity > 0.5
    assert solid.any() and not solid.all()
    torch.testing.assert_close(quick.depth[solid], plain.depth[solid], atol=2e-2, rtol=0)
    torch.testing.assert_close(quick.heaviest[solid], plain.heaviest[solid], atol=1e-5, rtol=0)
    chunked = render_image(Ball(), cameras(), 0, occupancy=grid, chunk=50, **options)
    torch.testing.assert_close(chunked.colour, quick.colour)
    bare = render_image(Ball(), cameras(), 0, occupancy=grid, heaviest=False, **options)
    assert torch.equal(bare.colour, quick.colour) and not torch.equal(bare.heaviest, quick.heaviest)
    refuses("chunk must be >= 1, got 0", render_image, Ball(), cameras(), 0, occupancy=grid, chunk=0, **options)


@pytest.mark.parametrize(
    "space",
    [
        Contraction(torch.zeros(3), 1.0),
        Perspective(torch.tensor([0.0, 0.0, 3.0]), torch.diag(torch.tensor([1.0, 1.0, -1.0])), 1.0, (0.7, 0.7)),
    ],
)
def test_the_empty_space_of_a_contracted_scene_is_skipped(space):
    """A distant wall, as thin as fog, stands behind a ball: the grid keeps both, and images do not change."""
    asked, random = [0], seeded(0)

    def scene(positions, directions, ray_index):
        asked[0] += len(positions)
        world = space.inverse(positions)
        return (positions + 2) / 4, 60.0 * (world.norm(dim=-1) < 0.5) + 0.4 * (world[:, 2] < -20)

    poses = torch.eye(4)[None].clone()
    poses[0, 2, 3] = 3.0
    camera = Cameras(poses, torch.tensor([[24.0, 24.0, 12.0, 12.0]]), 24, 24)
    grid = OccupancyGrid(space.cube, 16, threshold=1.0, contraction=space)
    rays, options = camera.image_rays(0), {"samples": 96, "spacing": "disparity"}
    ends = torch.full((len(rays),), 1.0), torch.full((len(rays),), 60.0)
    for _ in range(40):
        renderer = renderer_of({"field": scene}, contraction=space, occupancy=grid, **options)
        seen = renderer.render(rays, *ends, jitter=True, generator=random)[-1]
        grid.observe(seen.samples.positions, seen.density, seen.samples.deltas, seen.weights, decay=0.8)
        cells = torch.randint(16**3, (256,), generator=random)
        grid.update(scene, cells, decay=1.0, generator=random)
    pictures, counts = [], []
    for occupancy in (None, grid):
        asked[0] = 0
        renderer = renderer_of({"field": scene}, contraction=space, occupancy=occupancy, **options)
        pictures.append(renderer.image(camera, 0, near=1.0, far=60.0))
        counts.append(asked[0])
    assert counts[1] * 3 < counts[0]
    plain, quick = pictures
    torch.testing.assert_close(quick.colour, plain.colour, atol=2e-2, rtol=0)
    assert bool((plain.opacity > 0.95).all())  # the ball or the wall is opaque
    torch.testing.assert_close(quick.heaviest[12, 12], plain.heaviest[12, 12], atol=1e-5, rtol=0)
    same = OccupancyGrid.from_state(grid.state_dict(), contraction=space)
    again = renderer_of({"field": scene}, contraction=space, occupancy=same, **options)
    assert torch.equal(again.image(camera, 0, near=1.0, far=60.0).colour, quick.colour)


def test_a_translucent_field_is_walked_to_its_end():
    """Rays that never become opaque are sampled to their end, a few samples at a time (in waves)."""
    options = {"near": 1.0, "far": 5.0, "box": BOX, "samples": 128, "background": WHITE}
    plain = render_image(Ball(0.7), cameras(), 1, **options)
    quick = render_image(Ball(0.7), cameras(), 1, occupancy=tight_grid(), **options)
    torch.testing.assert_close(quick.colour, plain.colour, atol=1e-5, rtol=0)
    torch.testing.assert_close(quick.opacity, plain.opacity, atol=1e-5, rtol=0)
    assert 0.2 < float(plain.opacity.max()) < 0.9


def test_a_ray_that_ends_has_the_colour_before_its_end():
    """A ray that ends early in fog of one colour has this colour: the background gets none of the remaining light."""
    asked = [0]

    def fog(positions, directions, ray_index):
        asked[0] += len(positions)
        return torch.full_like(positions, 0.25), torch.full_like(positions[:, 0], 8.0)

    rays = Rays(torch.tensor([[0.0, 0, -1], [0, 0, 0.9]]), torch.tensor([[0.0, 0, 1]]).expand(2, 3))
    sampler = Occupancy(OccupancyGrid(BOX, 4, threshold=0.1), 200, picture_samples=200)
    ends = torch.zeros(2), torch.tensor([2.0, 0.1])
    seen = sampler.render_colours(fog, rays, *ends, background=WHITE, heaviest=True)
    left = math.exp(-0.8)  # light from behind the second ray, which is not ended early
    torch.testing.assert_close(seen.colour[:, 0], torch.tensor([0.25, 0.25 * (1 - left) + left]))
    torch.testing.assert_close(seen.opacity, torch.tensor([1.0, 1 - left]))
    # The opacity 1 - exp(-8 t) is 0.98 at t = 0.49; the depth is the mean distance of the fog up to this t.
    assert asked[0] < 200 + 64 and 0.1 < float(seen.depth[0]) < 0.125


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_training_samples_and_gradients_are_those_of_the_dense_form(backend):
    rays = cameras(9).image_rays(0)
    near, far, hit = intersect_box(rays.origins, rays.directions, BOX, 1.0, 5.0)
    rays, near, far = rays[hit], near[hit], far[hit]
    background = torch.rand(len(rays), 3)
    grid = OccupancyGrid(BOX * 1.01, 6, threshold=0.1)
    results = []
    for sampler in (Stratified(20, backend=backend), Occupancy(grid, 20, backend=backend)):
        scale = torch.tensor(2.0, requires_grad=True)
        field = lambda p, d, i, scale=scale: ((p * scale).sigmoid(), p.square().sum(-1) * scale)  # noqa: E731
        result = render_rays(field, rays, near, far, samples=sampler, background=background)
        result.colour.square().sum().backward()
        results.append((result.colour, result.opacity, result.depth, result.weights, scale.grad))
        assert result.samples.positions.shape == (20 * len(rays), 3)
    for a, b in zip(*results):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)


def test_rays_that_meet_nothing_show_the_background():
    grid = grid_of(lambda p, d, i: (p, torch.zeros(len(p))))
    assert grid.share == 0
    rays = Rays(torch.zeros(3, 3), torch.eye(3))
    ends = torch.full((3,), 0.1), torch.full((3,), 0.9)
    asked = Ball()
    sampler = Occupancy(grid, 8, picture_samples=8)
    seen = sampler.render_colours(asked, rays, *ends, background=WHITE, heaviest=True)
    assert asked.asked == 0
    assert torch.equal(seen.colour, torch.ones(3, 3)) and torch.equal(seen.depth, ends[1])
    assert torch.equal(seen.heaviest, 0.9 * torch.eye(3))
    parameter = torch.ones((), requires_grad=True)
    field = lambda p, d, i: (p * parameter, p[:, 0] * parameter)  # noqa: E731
    marched = render_rays(field, rays, *ends, samples=Occupancy(grid, 8))
    marched.colour.sum().backward()
    assert torch.equal(marched.colour.detach(), torch.zeros(3, 3)) and parameter.grad == 0


def test_state_goes_round():
    grid = grid_of(Ball(), resolution=(3, 4, 5))
    other = OccupancyGrid.from_state(grid.state_dict())
    for name, value in grid.state_dict().items():
        assert torch.equal(value, other.state_dict()[name])
    # A grid changes its own tensors in place, but not the tensors that it was made from.
    arguments = grid.state_dict()
    other = OccupancyGrid.from_state(arguments)
    other.observe(torch.zeros(1, 3), *(torch.ones(1) for _ in range(3)), decay=0.5)
    assert torch.equal(arguments["density"], grid.density) and not torch.equal(other.density, grid.density)
    state = grid.state_dict()
    del state["density"]
    rule = "OccupancyGrid: state must hold density, got box, occupied, threshold"
    refuses(rule, OccupancyGrid.from_state, state)
    rule = "density and occupied of one shape [x, y, z], got [3] and [3, 4, 5]"
    refuses(rule, OccupancyGrid.from_state, state | {"density": torch.zeros(3)})


def test_refuses_what_is_no_grid():
    for box, resolution, options, message in (
        (BOX.flip(0), 8, {}, "box must be finite corners"),
        (BOX * torch.inf, 8, {}, "box must be finite corners"),
        (BOX, (3, 0, 3), {}, "resolution must be one or three numbers >= 1, got (3, 0, 3)"),
        (BOX, 8, {"threshold": 0}, "threshold must be positive and finite, got 0"),
        (BOX, 8, {"remembered": 0.5}, "remembered must be at least 1 and finite, got 0.5"),
    ):
        refuses(message, OccupancyGrid, box, resolution, **{"threshold": 1, **options})
    # As a 32-bit index, 2**32 would be voxel 0.
    update = OccupancyGrid(BOX, 4, threshold=0.1).update
    for cell in (-1, 64, 2**32):
        refuses("voxels must lie in 0 to 63, got", update, Ball(), torch.tensor([cell]))
    refuses("decay must lie in 0..1, got 2", update, Ball(), decay=2)


def test_pictures_have_samples_of_their_own():
    arguments = {"near": 1.0, "far": 5.0, "box": BOX, "background": WHITE}
    pictures = [
        renderer_of({"field": Ball()}, samples=samples, picture_samples=own, occupancy=tight_grid()).image(
            cameras(), 0, **arguments
        )
        for samples, own in ((48, None), (24, 48), (24, None))
    ]
    assert torch.equal(pictures[0].colour, pictures[1].colour)
    assert not torch.equal(pictures[0].colour, pictures[2].colour)


def test_samples_that_no_light_reaches_have_no_gradient():
    """Samples behind a solid surface have no gradient; the gradient of the other samples is right to a thousandth."""
    field = HashGridField(width=16, levels=2, log2_entries=10)
    torch.nn.init.constant_(field.density.bias, 10.0)
    router = VoronoiRouter(field, torch.rand(4, 3) - 0.5, **field.router_options)
    rays, gradients = cameras().image_rays(0), []
    for of in (router, lambda *arguments: router(*arguments)):  # the second field has no layer table
        renderer = renderer_of({"field": of}, samples=96, occupancy=tight_grid())
        batch = Batch(rays, torch.ones(len(rays)), torch.full((len(rays),), 5.0), torch.zeros(len(rays), 3))
        result = RayLoss(renderer)(batch, torch.Generator().manual_seed(3))
        gradients.append(torch.autograd.grad(result.loss, router.module.features)[0])
    some, every = gradients
    assert 0 < some.count_nonzero() < every.count_nonzero()
    assert (some - every).norm() < 1e-3 * every.norm()
