"""Tests of territories: their places and regions, the routing of rays, and the loss of rays that cross territories."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import refuses, seeded

from voronerf import NeRF, OccupancyGrid, VoronoiDiagram, VoronoiRouter
from voronerf.app.scenes import builtin_scene, city_scene
from voronerf.nerf import Adam, Batch, Occupancy, RayLoss, Rays, Renderer, TrainingStep
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.samplers import SETTLING_PART
from voronerf.town.group import Group
from voronerf.town.rays import Territory, meet, step_together
from voronerf.town.territories import LATTICE, Territories, cut_space, halve

BOX = torch.tensor([[0.0, 0, 0], [4.0, 2, 2]])


def line(count=2):
    """Returns territories side by side along x, in a box of 4 x 2 x 2."""
    middles = (torch.arange(count) + 0.5) * 4 / count
    centres = torch.stack((middles, torch.ones(count), torch.ones(count)), 1)
    boxes = torch.stack([torch.tensor([[m - 2 / count, 0, 0], [m + 2 / count, 2, 2]]) for m in middles.tolist()])
    return Territories(centres, boxes, torch.zeros(0))


@pytest.fixture(scope="module")
def city():
    return city_scene(2, blocks=(2, 3), train_views=6, test_views=2)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_views_of_a_city_are_shared_out(city, count):
    scene = city
    territories = cut_space(scene, count, None)
    sizes = torch.bincount(territories.train, minlength=count)
    assert len(territories) == count and int(sizes.max()) - int(sizes.min()) <= 1
    points = torch.lerp(scene.box[0], scene.box[1], torch.rand(20_000, 3, generator=seeded()))
    owner = VoronoiDiagram(territories.centres).locate(points).long()
    low, high = territories.boxes[owner].unbind(1)
    assert ((points >= low - 1e-4) & (points <= high + 1e-4)).all(), "a point is in the box of its territory"
    for number in range(count):
        place, inside = territories.place(number), territories.boxes[number]
        box_points = points[((points >= inside[0]) & (points <= inside[1])).all(1)]
        mine = place.own[place.cells(box_points, "auto").long()] == 0
        assert torch.equal(mine, VoronoiDiagram(territories.centres).locate(box_points) == number)


def test_a_cut_that_cannot_be_made():
    scene = builtin_scene(8, train_views=3, test_views=1)
    refuses("--territories must be at most the 3 training views of builtin, got 4", cut_space, scene, 4, None)
    refuses("needs a scene with a box or --contraction", cut_space, replace(scene, box=None), 2, None)
    poses = scene.train.cameras.poses[:1].repeat(3, 1, 1)
    still = replace(scene.train, cameras=replace(scene.train.cameras, poses=poses))
    refuses("at most the number of different places that the views", cut_space, replace(scene, train=still), 2, None)
    bent = cut_space(replace(scene, box=None), 2, Contraction(torch.zeros(3), 2.0))
    assert bent.boxes.abs().max() <= 4.0


def test_halves_are_even_and_compact():
    places = torch.rand(103, 3, generator=seeded())
    part = halve(places, 8)
    assert set(torch.bincount(part).tolist()) <= {12, 13}
    spread = torch.stack([places[part == number].var(0).sum() for number in range(8)])
    assert float(spread.mean()) < 0.6 * float(places.var(0).sum())


def test_voxels_outside_of_a_territory():
    territories = line(3)
    grid = OccupancyGrid(BOX, (8, 4, 4), threshold=1.0)
    outside = territories.place(1).outside(grid)
    points = torch.lerp(BOX[0], BOX[1], torch.rand(50_000, 3, generator=seeded()))
    mine = VoronoiDiagram(territories.centres).locate(points) == 1
    assert not outside[grid.voxels(points[mine]).long()].any()
    assert outside.view(8, 4, 4)[0].all() and not outside.view(8, 4, 4)[3:5].any()
    grid.occupied.zero_()
    assert (territories.place(1).bounds(grid)[0] > territories.place(1).bounds(grid)[1]).all()
    grid.occupied[2, 1, 3] = grid.occupied[4, 2, 3] = True
    assert territories.place(1).bounds(grid).tolist() == [[1.0, 0.5, 1.5], [2.5, 1.5, 2.0]]


def test_which_territories_a_ray_meets():
    bounds = torch.cat(
        (line(4).boxes, torch.tensor([[[math.inf] * 3, [-math.inf] * 3], [[-math.inf] * 3, [math.inf] * 3]]))
    )
    origins = torch.tensor([[-1.0, 1, 1], [1.5, 1, 5], [1.5, 1, 1], [9.0, 9, 9]])
    directions = torch.tensor([[1.0, 0, 0], [0.0, 0, -1], [1.0, 0, 0], [1.0, 0, 0]])
    met = meet(bounds, Rays(origins, directions), torch.zeros(4), torch.tensor([10.0, 10, 1, 10]))
    expected = [[1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1]]
    assert met.int().tolist() == expected


def members(count):
    """Returns {number: territory} for a line of territories, each with its own networks."""
    result = {}
    for number in range(count):
        torch.manual_seed(number)
        router = VoronoiRouter(NeRF(width=16, depth=2, density_scale=1.0), torch.zeros(1, 3), coords="first3")
        grid = OccupancyGrid(line(count).boxes[number], 4, threshold=1e-6)
        loss = RayLoss(Renderer({"field": router}, Occupancy(grid, 64 * SETTLING_PART)))
        optimizer = Adam.of({"field": router}, lr=0.0)  # parameters do not move
        step = TrainingStep(Drawn(), loss, optimizer, generator=torch.Generator())
        result[number] = Territory(line(count).place(number), step)
    return result


class Drawn:
    """A stub of `RayBatches` with the same rays in each step."""

    device = place = torch.device("cpu")
    fetch = None

    def draw(self, rays, generator):
        return self.batch


def run(territories, batches):
    """Runs a step of all territories with the same random samples in each call; returns their results."""
    miss = torch.tensor([[-1.0, 1, 1]]), torch.tensor([[-1.0, 0, 0]])  # a ray that misses, for territories without rays
    none = Batch(Rays(*miss), torch.zeros(1), torch.full((1,), 9.0), torch.zeros(1, 3))
    for number, member in territories.items():
        member.step.generator.manual_seed(3)
        member.step.batches.batch = batches.get(number, none)
    rays = {number: len(member.step.batches.batch.near) for number, member in territories.items()}
    return step_together(
        Group(torch.device("cpu")),
        territories,
        [0] * len(territories),
        line(len(territories)).boxes,
        rays,
        dict.fromkeys(territories, 1),
    )


def fill(territories, densities, colours):
    """Gives every territory a constant density and colour."""
    for number, member in territories.items():
        field = member.renderer.field.module
        with torch.no_grad():
            for p in field.parameters():
                p.zero_()
            biases = {tuple(p.shape[1:]): p for name, p in field.named_parameters() if name.endswith("bias")}
            biases[1,].fill_(math.log(math.expm1(densities[number])) if densities[number] < 50 else densities[number])
            biases[3,].copy_(torch.logit(colours[number]))


def rays_through(count):
    """Returns a batch of rays that cross the whole box from the left."""
    generator = seeded()
    origins = torch.stack((torch.full((count,), -1.0), *(torch.rand(2, count, generator=generator) + 0.5)), 1)
    aim = torch.stack((torch.full((count,), 5.0), *(torch.rand(2, count, generator=generator) + 0.5)), 1)
    directions = torch.nn.functional.normalize(aim - origins, dim=1)
    return Batch(Rays(origins, directions), torch.full((count,), 0.5), torch.full((count,), 9.0), torch.rand(count, 3))


def test_gradients_are_those_of_the_loss():
    """The gradients match finite differences of the summed losses along random directions of all parameters."""
    territories, batches = members(3), {0: rays_through(20), 1: rays_through(1), 2: rays_through(12)}
    parameters = [p for member in territories.values() for p in member.renderer.field.parameters()]
    run(territories, batches)
    gradients = [p.grad.clone() for p in parameters]
    assert all(bool(gradient.any()) for gradient in gradients[-2:]), "rays from elsewhere teach a territory"
    for seed in range(3):
        ways = [torch.randn(p.shape, generator=seeded(seed)) for p in parameters]
        slope = float(sum((way * gradient).sum() for way, gradient in zip(ways, gradients, strict=True)))
        ends = []
        for side in (-1, 2):
            with torch.no_grad():
                for p, way in zip(parameters, ways, strict=True):
                    p.add_(way, alpha=side * 2e-3)
            ends.append(float(sum(result.loss for result in run(territories, batches).values())))
        with torch.no_grad():
            for p, way in zip(parameters, ways, strict=True):
                p.sub_(way, alpha=2e-3)
        assert (ends[1] - ends[0]) / 4e-3 == pytest.approx(slope, rel=0.03, abs=2e-4)


def test_colours_are_those_of_all_territories_in_turn():
    """Rays through constant fog in two territories have the formula's colours, whichever territory owns the rays."""
    territories, densities = members(2), (0.3, 0.7)
    colours = torch.tensor([[0.9, 0.1, 0.2], [0.2, 0.8, 0.4]])
    fill(territories, densities, colours)
    origins, directions = torch.tensor([[-1.0, 1, 1], [5.0, 1, 1]]), torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    light = [math.exp(-2 * density) for density in densities]
    mine = [(1 - through) * colour for through, colour in zip(light, colours, strict=True)]
    expected = torch.stack((mine[0] + light[0] * mine[1], mine[1] + light[1] * mine[0])) + light[0] * light[1]
    batch = Batch(Rays(origins, directions), torch.zeros(2), torch.full((2,), 9.0), expected, torch.ones(3))
    results = run(territories, {0: batch})
    assert float(results[0].loss) < 1e-5 and results[1].samples == 128
    whole = results[0].whole().output
    assert torch.allclose(whole.colour, expected, atol=1e-3)
    assert torch.allclose(whole.weights, torch.full((2,), 1 - light[0] * light[1]), atol=1e-3)


def test_a_ray_that_has_ended_goes_no_further():
    territories = members(3)
    fill(territories, (100.0,) * 3, torch.full((3, 3), 0.5))
    results = run(territories, {0: rays_through(30)})
    assert [result.samples > 0 for result in results.values()] == [True, False, False]


def test_pixels_that_do_not_count_place_no_view():
    """If only one pixel of a view counts, the view is placed at the middle of this pixel's ray in the scene."""
    scene = builtin_scene(LATTICE, train_views=3, test_views=1)
    masks = torch.zeros(3, LATTICE, LATTICE, dtype=torch.bool)
    row, column = LATTICE // 2, LATTICE // 2 + 2
    masks[:, row, column] = True
    centres = cut_space(replace(scene, train=replace(scene.train, masks=masks)), 3, None).centres
    places = []
    for view in range(3):
        rays = scene.train.cameras.rays(view, torch.tensor([column]), torch.tensor([row]))
        near, far, hit = intersect_box(rays.origins, rays.directions, scene.box, scene.near, scene.far)
        width = float((scene.box[1] - scene.box[0]).prod() / 3) ** (1 / 3)
        depth = near + torch.minimum((far - near) / 2, torch.full_like(near, width / 2))
        assert hit.all()
        places.append(rays.origins + depth[:, None] * rays.directions)
    apart = torch.cdist(torch.cat(places), centres)
    assert float(apart.amin(1).max()) < 1e-5
