"""A run brought up to date: what has changed learns, everything else keeps its bits, the source is never touched."""

import functools
import hashlib
import itertools
import math
from dataclasses import replace

import pytest
import torch
from helpers import refuses

import voronerf
from voronerf.app.cli.main import main
from voronerf.app.scenes import SceneError, city_scene
from voronerf.app.scenes.record import placed, read_scene
from voronerf.app.scenes.scene import Sightings
from voronerf.app.train.checkpoint import last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.trainer import Trainer
from voronerf.nerf import Cameras
from voronerf.nerf.renderer import render_camera
from voronerf.router import VoronoiRouter
from voronerf.town import changes, updating
from voronerf.town.editing import moved_cameras
from voronerf.town.parts import Similarity, Solid

SIZE, VIEWS = 24, 16
BLOCK = torch.tensor([[0.0, 0, 0], [1.0, 1, 0.7]])  # number 3 of 2 x 2


@pytest.fixture(scope="module")
def city():
    return city_scene(SIZE, blocks=2, train_views=VIEWS, test_views=2)


@pytest.fixture(scope="module")
def rebuilt():
    return city_scene(SIZE, blocks=2, train_views=VIEWS, test_views=2, rebuilt=3)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, city):
    """A run of the default field, and one of small networks without a table that cells share."""
    folder = tmp_path_factory.mktemp("runs")
    common = {"evaluations": 1, "final_views": 1, "panels": 0, "steps": 500, "cells": (8,), "rays": 256}
    made = {}
    # A regular grid of centres: where the others come to lie depends on the processor's rounding.
    nerf = {"field": "nerf", "width": 16, "depth": 1, "steps": 300, "centres": "uniform"}
    for name, options in {"hashgrid": {}, "nerf": nerf}.items():
        config = TrainConfig(out=folder / name, data="builtin-city:2x2", **{**common, **options})
        Trainer(config, city).run()
        made[name] = folder / name
    return made


def ticking(step=0.01):
    """A clock that goes on by so many seconds whenever it is read."""
    return functools.partial(next, itertools.count(0.0, step))


def digest(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [(path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files]


def error_of(run, scene, before):
    """Mean squared errors of the pixels of test views that have changed, and of the others."""
    inside, outside, white = [], [], torch.ones(3)
    for i in range(len(scene.test)):
        truth = scene.test.truth(i, white)
        changed = (truth - before.test.truth(i, white)).abs().amax(-1) > 0.05
        image = render_camera(run.renderer, scene, scene.test.cameras, i, heaviest=False).colour
        error = (image - truth).square().mean(-1)
        inside.append(error[changed])
        outside.append(error[~changed])
    return float(torch.cat(inside).mean()), float(torch.cat(outside).mean())


@pytest.mark.parametrize("kind", ["hashgrid", "nerf"])
def test_what_has_changed_learns_and_the_rest_keeps_its_bits(tmp_path, runs, city, rebuilt, kind):
    before, said = digest(runs[kind]), []
    run = voronerf.open_run(runs[kind], scene=city)
    made = run.update(
        rebuilt, tmp_path / "made", seconds=3.0, clock=ticking(), say=said.append, data="builtin-city:2x2,rebuilt=3"
    )
    assert digest(runs[kind]) == before
    part = made.router[0]
    assert len(made.router) == 1 and len(part.routers) == 2 and "cells learn" in said[0]
    # The cells that learnt lie on the block; all others have the parameters of the run, shared tables too.
    new = part.diagram.leaf_centres[part.owner == 1]
    assert ((new[:, :2] > BLOCK[0, :2] - 0.5) & (new[:, :2] < BLOCK[1, :2] + 0.5)).all(1).any()
    kept = (part.owner == 0).nonzero()[:, 0]
    parents = run.router.assign(part.diagram.leaf_centres).long()[kept]  # cells are divided, so that some of one stays
    other = dict(run.router.module.named_parameters())
    for name, parameter in part[0].module.named_parameters():
        whole = other[name].shape[0] != run.router.num_cells
        assert torch.equal(parameter, other[name] if whole else other[name][parents]), name
    # Space outside of these cells is seen as before, bit for bit. Each cell is asked alone: the number of rows that a
    # kernel is called with decides in which order it adds.
    points = torch.rand(4000, 3) * (city.box[1] - city.box[0]) + city.box[0]
    leaf, direction = part.diagram.locate(points).long(), torch.tensor([[0.0, 0.6, -0.8]])
    assert 0.5 < torch.isin(leaf, kept).float().mean() < 1
    for cell in kept.tolist():
        own = points[leaf == cell]
        index = torch.zeros(len(own), dtype=torch.int32)
        with torch.no_grad():
            for ours, theirs in zip(made.router(own, direction, index), run.router(own, direction, index), strict=True):
                assert torch.equal(ours, theirs)
    grids = [r.renderer.occupancy for r in (run, made)]
    every = grids[0].points(torch.arange(grids[0].occupied.numel()))
    same = torch.isin(part.diagram.locate(every).long(), kept)
    for name in ("density", "occupied"):
        assert torch.equal(*(getattr(grid, name).view(-1)[same] for grid in grids))
    (was, around), (now, after) = (error_of(r, rebuilt, city) for r in (run, made))
    assert now < 0.7 * was and after < 1.1 * around, (was, now, around, after)
    again = voronerf.open_run(tmp_path / "made", scene=rebuilt)
    assert error_of(again, rebuilt, city) == (now, after)
    if kind == "hashgrid":  # What was updated can be updated again.
        third = again.update(city, tmp_path / "third", seconds=1.0, clock=ticking())
        assert all(router.num_cells for router in third.router.routers)


def test_a_cell_that_has_changed_in_part_is_divided(runs, city):
    """The parts look the same; of the cells in its place those learn that have some of what has changed."""
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    source = voronerf.town.editing.join([run.source], [Similarity()])
    voxels = updating.space_voxels(city.box)
    every = replace(voxels, chosen=~voxels.chosen).centres()
    voxels = replace(voxels, chosen=((every > BLOCK[0]) & (every < BLOCK[1])).all(1).reshape(voxels.chosen.shape))
    k = run.router.num_cells
    counts = run.router.assign(voxels.centres()).long().bincount(minlength=k)
    none, rebuilt = torch.zeros(k, dtype=torch.bool), counts > 20
    assert rebuilt.any()
    changes = updating.Changes(none, rebuilt, voxels, 0.1, 1.0, torch.zeros(k))
    parts, cells = updating.divide(source, changes, torch.Generator().manual_seed(0))
    assert parts.num_cells > k and cells.any() and (~cells).any()
    points = torch.rand(3000, 3) * (city.box[1] - city.box[0]) + city.box[0]
    for cell in range(parts.num_cells):
        inside = points[parts.assign(points) == cell]
        asked = inside, torch.tensor([[0.0, 0.6, -0.8]]), torch.zeros(len(inside), dtype=torch.int32)
        with torch.no_grad():
            for ours, theirs in zip(parts.eval()(*asked), source.parts.eval()(*asked), strict=True):
                assert torch.equal(ours, theirs)
    own = cells[parts.assign(voxels.centres()).long()]
    assert own[rebuilt[run.router.assign(voxels.centres()).long()]].float().mean() > 0.9
    before = run.router.assign(points).long()
    assert not (cells[parts.assign(points).long()] & ~rebuilt[before]).any()


def test_a_shadow_is_found_though_no_ray_is_off(runs, city):
    """A place that all pictures show a little darker has changed; without it nothing has."""
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    low, high = torch.tensor([-0.4, -0.4, -0.1]), torch.tensor([0.4, 0.4, 0.1])
    images = [city.train.images.clone() for _ in range(2)]
    for view in range(VIEWS):
        image = render_camera(run.renderer, city, city.train.cameras, view)
        shade = ((image.heaviest > low) & (image.heaviest < high)).all(-1) & (image.opacity > 0.9)
        for pictures, dark in zip(images, (0.12, 0.0), strict=True):  # the run itself, so that nothing else differs
            colour = (image.colour - dark * shade[..., None]).clamp(0, 1)
            pictures[view, ..., :3], pictures[view, ..., 3:] = (colour * 255).round().to(pictures.dtype), 255
    darker, shown = (replace(city, train=replace(city.train, images=pictures)) for pictures in images)
    source, usual = run.source, torch.full((run.router.num_cells + 1,), 0.2)
    batches = [updating.RayBatches(scene, torch.device("cpu")) for scene in (darker, shown)]
    space = updating.space_voxels(city.box)
    found = updating.find_changes(run.renderer, source.parts, batches[0], usual, space, batches[1])
    assert found.off < 0.01 and found.rebuilt.any() and not found.worse.any()
    places = found.voxels.centres()
    assert ((places > low - 0.2) & (places < high + 0.2)).all()


def test_surfaces_are_found_of_which_a_part_is_off(runs, city, monkeypatch):
    """Two of five rays that end in a place are off: too few for a voxel, but more than of the old pictures."""
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    low, high = torch.tensor([-0.4, -0.4, -0.1]), torch.tensor([0.4, 0.4, 0.1])
    generator = torch.Generator().manual_seed(0)
    images = [city.train.images.clone() for _ in range(2)]
    for view in range(VIEWS):
        image = render_camera(run.renderer, city, city.train.cameras, view)
        here = ((image.heaviest > low) & (image.heaviest < high)).all(-1) & (image.opacity > 0.9)
        here &= torch.rand(here.shape, generator=generator) < 0.4
        for pictures, changed in zip(images, (here, here & False), strict=True):
            colour = torch.where(changed[..., None], torch.tensor([1.0, 0, 1]), image.colour).clamp(0, 1)
            pictures[view, ..., :3], pictures[view, ..., 3:] = (colour * 255).round().to(pictures.dtype), 255
    speckled, shown = (replace(city, train=replace(city.train, images=pictures)) for pictures in images)
    source, usual = run.source, torch.full((run.router.num_cells + 1,), 0.1)
    new, old = (updating.RayBatches(scene, torch.device("cpu")) for scene in (speckled, shown))
    monkeypatch.setattr(changes, "TONE", 2.0)
    given = run.renderer, source.parts, new, usual, updating.space_voxels(city.box)
    assert not updating.find_changes(*given).rebuilt.any()
    found = updating.find_changes(*given, old)
    assert found.rebuilt.any()
    places = found.voxels.centres()
    assert ((places > low - 0.2) & (places < high + 0.2)).all()


def test_more_pictures_of_the_same_scene_let_all_cells_learn(tmp_path, runs, city):
    """Nothing is divided, and old pictures count as new ones do, also where the run shows them badly."""
    images = city.train.images.clone()
    images[..., :3] = 255 - images[..., :3]
    other = replace(city, train=replace(city.train, images=images))
    run, before = voronerf.open_run(runs["hashgrid"], scene=city), digest(runs["hashgrid"])
    refuses("shows another scene", run.update, other, tmp_path / "made", seconds=1.0, error=ConfigError)
    made = run.update(other, tmp_path / "made", seconds=4.0, clock=ticking(), more=True)
    assert made.router.num_cells == run.router.num_cells and digest(runs["hashgrid"]) == before
    for name, parameter in made.router.module.named_parameters():
        now, was = (values.flatten(1) for values in (parameter, dict(run.router.module.named_parameters())[name]))
        assert (now != was).any(1).all() or "table" in name, name
    # Pictures and their negatives agree on a mean: grey.
    seen, grey = (render_camera(opened.renderer, city, city.train.cameras, 0) for opened in (run, made))
    was, now = ((image.colour - 0.5).abs()[seen.opacity > 0.9].mean() for image in (seen, grey))
    assert now < 0.5 * was


def test_more_pictures_are_learnt_as_in_a_training(tmp_path, city):
    """In contracted space as well: through the occupancy grid, on cameras of all pictures; a second time, too."""
    options = {"evaluations": 1, "final_views": 1, "panels": 0, "rays": 64, "contraction": "sphere"}
    config = TrainConfig(out=tmp_path / "run", data="builtin-city:2x2", steps=40, cells=(), **options)
    trainer = Trainer(config, city)
    trainer.run()
    run = voronerf.open_run(tmp_path / "run", scene=city)
    for name in ("more", "again"):
        run = run.update(city, tmp_path / name, seconds=1.0, clock=ticking(), more=True)
        assert isinstance(run.router, VoronoiRouter) and run.renderer.occupancy is not None
        step, trained = (last_checkpoint(run.path).values[key] for key in ("step", "seconds"))
        assert step > 40 and 1 <= trained < 1.1
        assert run.config.out == run.path and len(read_scene(run.path / "scene.json").train.names) == 2 * len(
            city.train
        )


def test_more_pictures_open_what_was_found_empty(tmp_path, runs, city, monkeypatch):
    """What the first pictures did not see is empty in their grid; the first step on others samples all of it."""
    run, seen = voronerf.open_run(runs["hashgrid"], scene=city), []
    empty = ~run.renderer.occupancy.occupied
    step = Trainer.train_step
    monkeypatch.setattr(Trainer, "train_step", lambda self: seen.append(self.occupancy.occupied.clone()) or step(self))
    made = run.update(city, tmp_path / "more", seconds=1.0, clock=ticking(), more=True)
    assert empty.any() and seen[0].all()
    assert not seen[-1].all() and not made.renderer.occupancy.occupied.all()  # it is found empty again


def test_training_keeps_the_errors_of_cells(runs, city):
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    usual = last_checkpoint(runs["hashgrid"]).group("errors")["usual"]
    assert usual.shape == (run.router.num_cells + 1,) and bool((usual > 0).all())


def test_pictures_that_show_nothing_new_are_told(tmp_path, runs, city):
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    refuses("--data shows nothing new", run.update, city, tmp_path / "made", seconds=2.0, error=ConfigError)
    assert not (tmp_path / "made").exists()


def turned(scene, pose):
    cameras = replace(scene.train.cameras, poses=pose @ scene.train.cameras.poses)
    return replace(scene, train=replace(scene.train, cameras=cameras))


def test_bad_pictures_are_a_line(tmp_path, runs, city, rebuilt):
    run, out = voronerf.open_run(runs["hashgrid"], scene=city), tmp_path / "made"
    away = torch.eye(4)
    away[2, 3] = 50.0
    refuses("must show the scene of the run", run.update, turned(rebuilt, away), out, seconds=1.0, error=ConfigError)
    middle = city.box.mean(0)
    for degrees in (90, 180):
        turn = Similarity(translation=middle) @ Similarity.of(degrees=(0, 0, degrees)) @ Similarity(translation=-middle)
        moved = replace(rebuilt, train=replace(rebuilt.train, cameras=moved_cameras(rebuilt.train.cameras, turn)))
        refuses("shows another scene, or this one in", run.update, moved, out, seconds=1.0, error=ConfigError)
    black = replace(rebuilt, background=None)
    refuses("background must be that of", run.update, black, out, seconds=1.0, error=SceneError)
    moved = replace(rebuilt, transform=torch.eye(4, dtype=torch.float64))
    refuses("must be in the frame of", run.update, moved, out, seconds=1.0, error=SceneError)
    for seconds in (0.0, -1.0, math.nan, math.inf):
        refuses("--budget must be positive", run.update, rebuilt, out, seconds=seconds, error=ConfigError)
    refuses("--out must not hold a run already", run.update, rebuilt, runs["nerf"], seconds=1.0, error=ConfigError)
    assert not out.exists() and not list(tmp_path.iterdir())
    cut = run.cut(Solid.box((-1, -1, -1), (1, 1, 1)), tmp_path / "cut")  # which has no errors of a training
    refuses("leave out --no-use-old", cut.update, rebuilt, out, seconds=1.0, old=False, error=ConfigError)


def test_an_interrupted_update_leaves_nothing(tmp_path, runs, city, rebuilt, monkeypatch):
    run = voronerf.open_run(runs["hashgrid"], scene=city)

    def interrupted(self, pool, number, done):
        if number == 3:
            raise KeyboardInterrupt
        return step(self, pool, number, done)

    step = updating.Session.step
    monkeypatch.setattr(updating.Session, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.update(rebuilt, tmp_path / "made", seconds=3.0, clock=ticking())
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    assert run.update(rebuilt, tmp_path / "made", seconds=0.3, clock=ticking()).path == tmp_path / "made"


def test_a_ray_is_the_light_before_of_and_behind_the_cells_that_learn(tmp_path, runs, city, rebuilt):
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    source = voronerf.town.editing.join([run.source], [voronerf.router.Similarity()])
    cells = torch.zeros(run.router.num_cells, dtype=torch.bool)
    cells[:3] = True
    parts, learners = updating.split_off(source.parts, cells)
    voxels, generator = updating.space_voxels(city.box), torch.Generator().manual_seed(0)
    own = updating.voxels_of(source.grid, parts, cells)
    session = updating.Session(replace(source, parts=parts), source.parts, cells, learners, own, voxels, generator)
    pool = session.pool(updating.RayBatches(city, torch.device("cpu")), 2000)
    assert len(pool) > 100
    sampler = session.renderer.sampler
    samples = sampler.sample(pool.rays, pool.near, pool.far)
    shown = samples.depths < pool.end[samples.ray_index.long()]
    own = samples.part(shown & session.learns(samples.positions))
    # A step, which takes samples near these cells alone, has the same.
    near = session.learning.sampler.sample(pool.rays, pool.near, pool.far)
    assert len(near.depths) < len(samples.depths)
    near = near.part(near.depths < pool.end[near.ray_index.long()])
    assert torch.equal(near.part(session.learns(near.positions)).positions, own.positions)
    with torch.no_grad():
        seen = updating.render_samples(session.parts, pool.rays, pool.far, own, sampler.space, background=pool.behind)
        whole = updating.render_samples(source.parts, pool.rays, pool.far, samples, sampler.space)
    colour = pool.before + pool.light * seen.colour
    # The background is in `behind`: without it the two differ by what passes all samples.
    through = (1 - whole.opacity)[:, None]
    assert float(((colour - whole.colour) - through.clamp(max=1)).amax()) < 0.06
    assert float((whole.colour - colour).amax()) < 0.06


def test_what_was_empty_is_opened_where_it_has_changed(runs, city):
    """Of the empty voxels those in and around changed space are learnt from, and all of a cell that learns whole."""
    run = voronerf.open_run(runs["hashgrid"], scene=city)
    source = voronerf.town.editing.join([run.source], [Similarity()])
    voxels = updating.space_voxels(city.box)
    chosen = torch.zeros_like(voxels.chosen)
    chosen[4:8, 4:8, 4:8] = True
    voxels, grid, k = replace(voxels, chosen=chosen), source.grid, run.router.num_cells
    every = torch.arange(grid.occupied.numel())
    points, empty = grid.points(every), ~grid.occupied.view(-1)
    size = (city.box[1] - city.box[0]) / torch.tensor(chosen.shape)
    low, high = (city.box[0] + size * edge for edge in (4, 8))
    away = torch.maximum(low - points, points - high).div(size).amax(1)  # in voxels
    none = torch.zeros(k, dtype=torch.bool)
    for whole in (none, none.index_fill(0, torch.tensor([5]), True)):
        changes = updating.Changes(whole, ~whole, voxels, 0.1, 1.0, torch.zeros(k))
        found = updating.may_fill(source, every, changes)
        own = whole[run.router.assign(points).long()]
        assert found[~empty].all() and found[away < 0.99].all() and found[own].all() and own.any() == whole.any()
        assert not found[empty & ~own & (away > 1.01)].any() and (empty & (away < 0.99)).any()


def test_rays_are_drawn_by_their_errors():
    """Half of them by chance, the others by the root of the squared error; a step keeps it, a search too."""
    count, near = 1000, torch.arange(1000.0)
    line = near[:, None].expand(-1, 3)
    error = torch.zeros(count)
    error[:2] = torch.tensor([0.01, 0.09])
    pool = updating.Pool(updating.Rays(line, line), near, near, line, line, near[:, None], line, near, error)
    chosen = pool.draw(8000, torch.Generator().manual_seed(0))
    often = chosen.bincount(minlength=count)
    assert abs(int(often[0]) - 1008) < 120 and abs(int(often[1]) - 3008) < 120  # one to three, and eight by chance
    assert int((often > 0).sum()) > 900
    more = updating.Pool.joined([pool, pool], 1500)
    assert len(more) == 1500 and torch.equal(more.near, torch.cat((near[500:], near)))
    assert torch.equal(more.error, torch.cat((error[500:], error))) and torch.equal(more.rays.origins[:, 0], more.near)


def test_cameras_and_sightings_move_from_one_frame_to_another(city):
    angle = 0.3
    move = torch.eye(4, dtype=torch.float64)
    move[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    move[:3, :3] *= 2.0
    move[:3, 3] = torch.tensor([1.0, 2, 3])
    ours = replace(city, transform=move)
    seen = replace(city.train, sightings=Sightings(torch.tensor([7]), torch.tensor([3.0])))
    theirs = replace(city, train=seen, transform=torch.eye(4, dtype=torch.float64))
    train = placed(theirs, ours).train
    found = train.cameras
    torch.testing.assert_close(train.sightings.distances, torch.tensor([6.0]))  # the move doubles all lengths
    points = city.train.cameras.origins.double() @ move[:3, :3].T + move[:3, 3]
    torch.testing.assert_close(found.origins, points.float())
    lengths = found.poses[:, :3, :3].norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    assert isinstance(found, Cameras) and placed(city, city).train.cameras is city.train.cameras


def test_command(tmp_path, runs, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = str(runs["hashgrid"])
    assert main(["update", run, "--data", "builtin-city:2x2", "--budget", "-1"]) != 0
    assert "--budget must be positive" in capsys.readouterr().err
    assert main(["update", run, "--data", "nowhere"]) != 0
    assert main(["update", run, "--data", "builtin-city:2x2", "--old", "x", "--no-use-old"]) != 0
    assert not list(tmp_path.iterdir())
