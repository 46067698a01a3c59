"""Cameras and colours of pictures that learn with the field."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_runs import assert_resumes, small

import voronerf.app.train.appearance as appearance_module
import voronerf.app.train.trainer as trainer_module
from voronerf import HashGridField, VoronoiRouter, open_run
from voronerf.app.scenes.record import with_refined
from voronerf.app.train.appearance import Appearance
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.refinement import Refinement, rotation
from voronerf.app.train.renderers import through_grid
from voronerf.app.train.trainer import Trainer
from voronerf.nerf import Batch, Contraction, Perspective, Rays, Renderer, Space, Step, Stratified
from voronerf.nerf.cameras import Cameras, look_at, orbit_cameras
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.sampling import colour_loss
from voronerf.nerf.volume import render_samples

SPHERE = Contraction(torch.tensor([0.1, 0.0, 0.0]), 0.7)
AHEAD = Perspective(torch.tensor([0.0, -3.0, 0.0]), torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), 1.0, (0.5, 0.5))


@pytest.mark.parametrize("contraction", [None, SPHERE, AHEAD], ids=["none", "sphere", "ndc"])
def test_rays_have_gradients(contraction):
    """Those of a rendering by torch, at the same samples."""
    torch.manual_seed(0)
    field = HashGridField(width=16, levels=3, log2_entries=10, box=((-2.0,) * 3, (2.0,) * 3))
    torch.nn.init.normal_(field.features)
    router = VoronoiRouter(field, torch.rand(4, 3) - 0.5, share=["features"])
    box = torch.tensor([[-2.0] * 3, [2.0] * 3])
    grid = OccupancyGrid(box, 4, threshold=1e-6, contraction=contraction)
    sampler = through_grid(Stratified(16, space=Space(contraction)), grid)
    renderer = Renderer({"field": router}, sampler)
    poses = look_at(torch.tensor([[0.0, -3.0, 0.2]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    cameras = Cameras(poses, torch.tensor([[9.0, 9.0, 4.0, 4.0]]), 8, 8)
    batch = Batch(cameras.image_rays(0), torch.ones(64), torch.full((64,), 5.0), torch.rand(64, 3))
    asked = Refinement.asked(replace(batch, view=torch.zeros(64, dtype=torch.int64)))
    found = Step(renderer).run(asked, torch.Generator().manual_seed(1), backward=True)
    origins, directions = (tensor.clone().requires_grad_() for tensor in (batch.rays.origins, batch.rays.directions))
    ray = found.samples.ray_index.long()
    points = origins[ray] + found.samples.depths[:, None] * directions[ray]
    samples = found.samples._replace(inputs=points if contraction is None else contraction.points(points))
    seen = render_samples(router, Rays(origins, directions), batch.far, samples, Space())
    colour_loss(seen.colour, batch.target).backward()
    for mine, theirs in ((asked.rays.origins, origins), (asked.rays.directions, directions)):
        assert theirs.grad.abs().max() > 1e-5
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-3, atol=1e-3 * float(theirs.grad.abs().max()))


def opaque(scene):
    """A scene of photographs: without an alpha channel."""
    parts = (replace(part, images=part.images[..., :3].contiguous()) for part in (scene.train, scene.test))
    train, test = parts
    return replace(scene, train=train, test=test)


LEARNT = {"appearance": True, "refine_cameras": True}
GRID = {"field": "hashgrid", "width": 8, "depth": 1, "occupancy": True, "samples": None}


@pytest.fixture
def early(monkeypatch):
    """Gains and cameras change from the third step on."""
    monkeypatch.setattr(appearance_module, "START", 2)
    monkeypatch.setattr(trainer_module, "START", 2)


def test_resume_is_bit_for_bit_and_runs_open_with_refined_cameras(tmp_path, scene, early):
    scene = opaque(scene)
    ends = assert_resumes(tmp_path, scene, 11, **GRID, **LEARNT)
    assert bool((ends["appearance.gains"] != 1).any())
    moved = ends["cameras.poses"]
    assert not torch.equal(moved, scene.train.cameras.poses)
    run = open_run(tmp_path / "whole", scene=scene)
    assert torch.equal(run.scene.train.cameras.poses, moved)
    assert torch.equal(run.scene.test.cameras.poses, scene.test.cameras.poses)
    torch.testing.assert_close(run.scene.train.cameras.intrinsics, ends["cameras.intrinsics"])
    smaller = replace(scene, train=replace(scene.train, cameras=scene.train.cameras.downscaled(2)))
    lens = with_refined(smaller, tmp_path / "whole").train.cameras.intrinsics
    torch.testing.assert_close(lens, ends["cameras.intrinsics"] / 2)


def test_what_pictures_learn_is_refused_where_it_cannot_work(tmp_path, scene):
    with pytest.raises(ConfigError, match="--appearance must be off for pictures with transparent pixels"):
        Trainer(small(tmp_path, appearance=True), scene)
    with pytest.raises(
        ConfigError, match="--refine-cameras must be off where a step is not one operation: empty space"
    ):
        Trainer(small(tmp_path, refine_cameras=True), opaque(scene))
    with pytest.raises(ConfigError, match="--refine-cameras must be off with --precision"):
        TrainConfig(refine_cameras=True, precision="bf16")


def test_gains_of_dark_and_bright_pictures_are_found():
    """The gains are known up to a factor of all, and their geometric mean is 1."""
    torch.manual_seed(0)
    known = torch.tensor([[0.5, 0.6, 0.7], [1.5, 1.2, 1.0], [1.0, 1.1, 0.9]])
    appearance = Appearance(3, torch.device("cpu"))
    for _ in range(appearance_module.START + 1):
        colour, view = torch.rand(300, 3) * 0.6, torch.randint(3, (300,))
        batch = Batch(Rays(colour, colour), view, view, colour * known[view], view=view)
        appearance.learn(appearance.neutral(batch), colour)
    expected = known / known.log().mean(0).exp()
    torch.testing.assert_close(appearance.gains, expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(appearance.neutral(batch).target, colour * known[view] / expected[view])


def test_cameras_return_to_where_a_known_scene_was_seen_from():
    """Colours are a smooth function of the place on a wall around the cameras: what is off by a degree comes back."""
    true = orbit_cameras(6, radius=1.0, elevation=20.0, width=32, height=32, focal=40.0)
    generator = torch.Generator().manual_seed(0)
    turn, move = torch.nn.functional.normalize(torch.randn(2, 6, 3, generator=generator), dim=-1).unbind(0)
    poses = true.poses.clone()
    poses[:, :3, :3] = rotation(turn * math.radians(1)) @ poses[:, :3, :3]
    poses[:, :3, 3] += 0.01 * move
    refinement = Refinement(replace(true, poses=poses, intrinsics=true.intrinsics * torch.tensor([1.01, 1.01, 1, 1])))

    def seen(origins, directions):
        along, inside = (origins * directions).sum(-1), origins.square().sum(-1) - 1.5**2
        depth = (along.square() - inside).sqrt() - along
        return 0.5 + 0.5 * torch.sin(4 * (origins + depth[:, None] * directions))

    def degrees():
        turned = refinement.cameras.poses[:, :3, :3] @ true.poses[:, :3, :3].mT
        return float(((turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1).acos().rad2deg().mean())

    losses = []
    for step in range(400):
        view, pixels = torch.randint(6, (600,), generator=generator), torch.rand(2, 600, generator=generator) * 32
        truth, rays = true.rays(view, *pixels), refinement.cameras.rays(view, *pixels)
        batch = Refinement.asked(Batch(rays, view, view, seen(truth.origins, truth.directions), view=view))
        loss = (seen(batch.rays.origins, batch.rays.directions) - batch.target).square().mean()
        loss.backward()
        refinement.learn(batch, 1 - step / 400)
        losses.append(float(loss.detach()))
    assert degrees() < 0.35 and losses[-1] < 0.01 * losses[0], (degrees(), losses[0], losses[-1])
    torch.testing.assert_close(refinement.cameras.intrinsics, true.intrinsics, rtol=3e-3, atol=0)
    # Not all cameras together were moved: their places have the same mean.
    torch.testing.assert_close(refinement.cameras.origins.mean(0), poses[:, :3, 3].mean(0), rtol=0, atol=1e-4)
