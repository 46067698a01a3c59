"""Territories: where they are, what of space they reach, where rays go, and the loss of rays that cross them."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import refuses, seeded

from voronerf import NeRF, OccupancyGrid, VoronoiDiagram, VoronoiRouter
from voronerf.app.scenes import builtin_scene, city_scene
from voronerf.nerf import Batch, Rays, Renderer, Stratified
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.rays import intersect_box
from voronerf.town.distributed.group import Group
from voronerf.town.distributed.territories import Territories, cut_space, halve
from voronerf.town.ray_runs import LINKS, JointLoss, Map, Territory, see_together

BOX = torch.tensor([[0.0, 0, 0], [4.0, 2, 2]])


def line(count=2):
    """Territories side by side along x, in a box of 4 x 2 x 2."""
    middles = (torch.arange(count) + 0.5) * 4 / count
    centres = torch.stack((middles, torch.ones(count), torch.ones(count)), 1)
    boxes = torch.stack([torch.tensor([[m - 2 / count, 0, 0], [m + 2 / count, 2, 2]]) for m in middles.tolist()])
    return Territories(centres, boxes, torch.zeros(0), torch.zeros(0))


@pytest.fixture(scope="module")
def city():
    return city_scene(2, blocks=(2, 3), train_views=6, test_views=2)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_views_of_a_city_are_shared_out(city, count):
    scene = city
    found = cut_space(scene, count, None)
    sizes = torch.bincount(found.train, minlength=count)
    assert len(found) == count and int(sizes.max()) - int(sizes.min()) <= 1
    assert len(found.test) == 12 and 0 <= int(found.test.min()) <= int(found.test.max()) < count
    points = torch.lerp(scene.box[0], scene.box[1], torch.rand(20_000, 3, generator=seeded()))
    owner = VoronoiDiagram(found.centres).locate(points).long()
    low, high = found.boxes[owner].unbind(1)
    assert ((points >= low - 1e-4) & (points <= high + 1e-4)).all(), "a point is in the box of its territory"
    for number in range(count):
        place, inside = found.place(number), found.boxes[number]
        own = points[((points >= inside[0]) & (points <= inside[1])).all(1)]
        mine = place.own[place.cells(own, "auto").long()] == 0
        assert torch.equal(mine, VoronoiDiagram(found.centres).locate(own) == number)


def test_a_cut_that_cannot_be_made():
    scene = builtin_scene(8, train_views=3, test_views=1)
    refuses("--territories must be at most the 3 training views of builtin, got 4", cut_space, scene, 4, None)
    refuses("needs a scene with a box or --contraction", cut_space, replace(scene, box=None), 2, None)
    poses = scene.train.cameras.poses[:1].repeat(3, 1, 1)
    still = replace(scene.train, cameras=replace(scene.train.cameras, poses=poses))
    refuses("at most the places that views of builtin look at", cut_space, replace(scene, train=still), 2, None)
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
    assert not outside[grid.cells(points[mine]).long()].any()
    assert outside.view(8, 4, 4)[0].all() and not outside.view(8, 4, 4)[3:5].any()
    grid.occupied.zero_()
    assert (territories.place(1).bounds(grid)[0] > territories.place(1).bounds(grid)[1]).all()
    grid.occupied[2, 1, 3] = grid.occupied[4, 2, 3] = True
    assert territories.place(1).bounds(grid).tolist() == [[1.0, 0.5, 1.5], [2.5, 1.5, 2.0]]


def test_which_territories_a_ray_meets():
    known = Map.of(line(4).boxes, line(4).centres)
    assert known.links.shape == (4, LINKS) and known.links[0, :4].tolist() == [1, 2, 3, -1]
    origins = torch.tensor([[-1.0, 1, 1], [1.5, 1, 5], [1.5, 1, 1], [9.0, 9, 9]])
    directions = torch.tensor([[1.0, 0, 0], [0.0, 0, -1], [1.0, 0, 0], [1.0, 0, 0]])
    near, far = torch.zeros(4), torch.tensor([10.0, 10, 1, 10])
    rays = Rays(origins, directions)
    assert pairs(known.met(rays, near, far)) == [(0, 0), (0, 1), (1, 1), (2, 1), (0, 2), (2, 2), (0, 3)]
    bounds = known.bounds.clone()
    bounds[2] = torch.tensor([[torch.inf] * 3, [-torch.inf] * 3])
    bounds[3] = torch.tensor([[-torch.inf] * 3, [torch.inf] * 3])
    known = replace(known, bounds=bounds)
    assert pairs(known.met(rays, near, far)) == [(0, 0), (0, 1), (1, 1), (2, 1), (0, 3), (1, 3), (2, 3), (3, 3)]


def pairs(met):
    return list(zip(met[0].tolist(), met[1].tolist(), strict=True))


@pytest.mark.parametrize("count", [1, 16, 17, 300])
def test_a_tree_of_bounds_finds_what_each_of_them_meets(count):
    low = 10 * torch.rand(count, 3, generator=seeded())
    bounds = torch.stack((low, low + torch.rand(count, 3, generator=seeded())), 1)
    bounds[::7] = torch.tensor([[torch.inf] * 3, [-torch.inf] * 3])
    links, lit = torch.full((count, LINKS), -1), torch.zeros(count, dtype=torch.int64)
    known = Map(bounds, links, lit, torch.ones(count, dtype=torch.float64))
    origins, directions = 10 * torch.rand(2, 50, 3, generator=seeded())
    rays, near, far = Rays(origins, directions - 5), torch.zeros(50), 5 * torch.rand(50, generator=seeded())
    expected = []
    for number, box in enumerate(bounds):
        first, last, _ = intersect_box(rays.origins, rays.directions, box, 0.0, math.inf)
        hit = torch.maximum(first, near) < torch.minimum(last, far)
        expected += [(ray, number) for ray in hit.nonzero()[:, 0].tolist() if number % 7]
    assert pairs(known.met(rays, near, far)) == expected and (len(expected) > 10 or count < 300)


def test_all_territories_evaluate_as_many_samples():
    """One that gets rays of others draws fewer of its own, and the mean stays."""
    loss = joint(3)
    for _ in range(20):
        for number, others in enumerate((0, 50, 25)):
            loss.counts[number][-2:] = torch.tensor((1000 * float(loss.map.shares[number]), 10 * others))
        loss.survey(SURVEYED)
    assert loss.map.shares.tolist() == pytest.approx([1.25, 0.75, 1.0], abs=2e-3), "1,250 samples each"


def test_rays_go_to_territories_that_bring_no_light_now_and_then():
    """So it is known when these bring light again."""
    loss = joint(3)
    batch = rays_through(200)
    fill(loss, (0.1, 0.1, 1e-6), torch.full((3, 3), 0.5))
    loss.run({0: batch})
    assert loss.counts[0].tolist()[:8] == [0, 200, 200, 0, 200, 0, 200, 200]
    loss.survey(SURVEYED)
    assert loss.map.links[0, :3].tolist() == [1, 2, -1] and loss.map.lit[0] == 1
    found = loss.run({0: batch})
    assert (found[0].error > 0).all() and len(found[1].weights) and not len(found[2].weights)
    assert loss.counts[0].tolist()[:8] == [0, 200, 200, 0, 0, 0, 200, 0]
    loss.survey(SURVEYED - 1)
    fill(loss, (0.1, 0.1, 0.1), torch.full((3, 3), 0.5))
    assert len(loss.run({0: batch})[2].weights) and loss.counts[0].tolist()[3:6] == [0, 200, 200]
    loss.survey(SURVEYED)
    assert loss.map.lit[0] == 2


def joint(count):
    """A loss over territories in a line, each with networks of its own."""
    territories, members = line(count), {}
    for number in range(count):
        torch.manual_seed(number)
        router = VoronoiRouter(NeRF(width=16, depth=2, density_scale=1.0), torch.zeros(1, 3), coords="first3")
        renderer = Renderer({"field": router}, Stratified(64))
        members[number] = Territory(territories.place(number), renderer, torch.Generator())
    group = Group(torch.device("cpu"))
    return JointLoss(group, members, [0] * count, Map.of(territories.boxes, territories.centres), 0.0)


def fill(loss, densities, colours):
    """Makes every territory a fog."""
    for number, member in loss.territories.items():
        field = member.renderer.field.module
        with torch.no_grad():
            for p in field.parameters():
                p.zero_()
            biases = {tuple(p.shape[1:]): p for name, p in field.named_parameters() if name.endswith("bias")}
            biases[1,].fill_(math.log(math.expm1(densities[number])) if densities[number] < 50 else densities[number])
            biases[3,].copy_(torch.logit(colours[number]))


def rays_through(count):
    """Rays from the left through all of the box."""
    generator = seeded()
    origins = torch.stack((torch.full((count,), -1.0), *(torch.rand(2, count, generator=generator) + 0.5)), 1)
    aim = torch.stack((torch.full((count,), 5.0), *(torch.rand(2, count, generator=generator) + 0.5)), 1)
    directions = torch.nn.functional.normalize(aim - origins, dim=1)
    return Batch(Rays(origins, directions), torch.full((count,), 0.5), torch.full((count,), 9.0), torch.rand(count, 3))


def test_gradients_are_those_of_the_loss():
    """Along random directions of all parameters, the change of the sum of the losses is what the gradients say."""
    loss = joint(3)
    batches = {0: rays_through(20), 2: rays_through(12)}
    routers = [member.renderer.field for member in loss.territories.values()]
    parameters = [p for router in routers for p in router.parameters()]

    def found():
        for member in loss.territories.values():
            member.generator.manual_seed(3)
        return loss.run(batches)

    total = sum(each.loss for each in found().values())
    gradients = torch.autograd.grad(total, parameters)
    assert all(bool(gradient.any()) for gradient in gradients[-2:]), "rays from elsewhere teach a territory"
    for seed in range(3):
        ways = [torch.randn(p.shape, generator=torch.Generator().manual_seed(seed)) for p in parameters]
        slope = float(sum((way * gradient).sum() for way, gradient in zip(ways, gradients, strict=True)))
        ends = []
        for side in (-1, 1):
            with torch.no_grad():
                for p, way in zip(parameters, ways, strict=True):
                    p.add_(way, alpha=side * 2e-3)
                ends.append(float(sum(each.loss.detach() for each in found().values())))
                for p, way in zip(parameters, ways, strict=True):
                    p.sub_(way, alpha=side * 2e-3)
        assert (ends[1] - ends[0]) / 4e-3 == pytest.approx(slope, rel=0.03, abs=2e-4)


def test_colours_are_those_of_all_territories_in_turn():
    """A fog of one colour in each: the light of a ray is that of the formula, whoever draws it."""
    loss, densities = joint(2), (0.3, 0.7)
    colours = torch.tensor([[0.9, 0.1, 0.2], [0.2, 0.8, 0.4]])
    fill(loss, densities, colours)
    origins, directions = torch.tensor([[-1.0, 1, 1], [5.0, 1, 1]]), torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    near, far, white = torch.zeros(2), torch.full((2,), 9.0), torch.ones(3)
    seen = see_together(loss, Rays(origins, directions), near, far, white)
    light = [math.exp(-2 * density) for density in densities]
    own = [(1 - through) * colour for through, colour in zip(light, colours, strict=True)]
    expected = torch.stack((own[0] + light[0] * own[1], own[1] + light[1] * own[0])) + light[0] * light[1]
    assert torch.allclose(seen.colour, expected, atol=1e-5)
    assert torch.allclose(seen.opacity, torch.full((2,), 1 - light[0] * light[1]), atol=1e-5)
    batch = Batch(Rays(origins, directions), near, far, expected, white)
    found = loss.run({0: batch})
    assert float(found[0].loss.detach()) < 1e-5 and len(found[1].weights) == 128
    none = torch.empty(0)
    assert len(see_together(loss, Rays(torch.empty(0, 3), torch.empty(0, 3)), none, none, None).colour) == 0


def test_a_ray_that_has_ended_goes_no_further():
    loss = joint(3)
    fill(loss, (100.0,) * 3, torch.full((3, 3), 0.5))
    batch = rays_through(30)
    found = loss.run({0: batch})
    assert loss.counts[0].tolist()[:7] == [0] * 6 + [30] and len(found[1].weights) == 0
    loss.survey(SURVEYED)
    assert (loss.map.links[0] < 0).all()


def test_rays_to_where_few_go_are_not_learnt_from():
    """The others are; and once more rays go there, these are learnt from, too."""
    loss = joint(3)
    loss.map.links[0] = -1
    loss._chart()
    batch = rays_through(10)
    away = replace(batch, far=torch.where(torch.arange(10) < 5, 1.2, 9.0))
    found = loss.run({0: away})
    assert (found[0].error[:5] > 0).all() and (found[0].error[5:] == 0).all()
    assert loss.counts[0].tolist()[:7] == [0, 5, 5, 0, 0, 0, 10]
    loss.survey(SURVEYED)
    assert loss.map.links[0, :2].tolist() == [1, 2]
    assert (loss.run({0: away})[0].error > 0).all()


#: A step at which territories tell what they know.
SURVEYED = 64
