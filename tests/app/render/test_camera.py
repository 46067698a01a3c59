"""Tests of rendering photographed scenes: holes are filled with neighbouring colours."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import pytest
import torch

from voronerf.app.render.camera import fill_holes, render_camera
from voronerf.app.scenes import builtin_scene
from voronerf.nerf import Cameras, Renderer, Stratified, orbit_cameras


@pytest.mark.parametrize("size", [(1, 1), (7, 12), (33, 5)])
def test_what_is_opaque_stays_as_it_is_and_a_picture_of_nothing_is_black(size):
    colour = torch.rand(*size, 3)
    assert torch.equal(fill_holes(colour, torch.ones(size)), colour)
    assert not fill_holes(torch.zeros(*size, 3), torch.zeros(size)).any()


def test_a_hole_has_the_colour_of_what_lies_beside_it():
    colour = torch.tensor([0.2, 0.4, 0.8]).expand(20, 30, 3).clone()
    colour[:, 15:] = torch.tensor([0.9, 0.1, 0.1])
    opacity = torch.ones(20, 30)
    opacity[5:9, 3:7], opacity[5:9, 20:28] = 0, 0.25
    filled = fill_holes(colour * opacity[..., None], opacity)
    torch.testing.assert_close(filled[:, :10], colour[:, :10])
    torch.testing.assert_close(filled[:, 20:], colour[:, 20:])


def test_a_gradient_goes_on_through_a_hole():
    colour = torch.linspace(0, 1, 32)[None, :, None].expand(32, 32, 3)
    opacity = torch.ones(32, 32)
    opacity[12:18, 12:18] = 0
    filled = fill_holes(colour * opacity[..., None], opacity)
    assert float((filled - colour).abs().max()) < 0.1


def test_photographs_alone_are_filled():
    """Holes are filled if the scene has no background colour and no box, except in the viewer (fill=False)."""

    def wall(positions, directions, ray_index):
        inside = (positions[:, 2] < 0) & (positions[:, :2].norm(dim=-1) > 0.3)
        return torch.full_like(positions, 0.75), torch.where(inside, 1e4, 0.0)

    cameras = orbit_cameras(1, radius=2.0, elevation=90.0, width=24, height=24, focal=24.0)
    scene = replace(builtin_scene(8, train_views=2, test_views=1), background=None, box=None, near=0.5, far=4.0)
    renderer = Renderer({"field": wall}, Stratified(64))
    filled = render_camera(renderer, scene, cameras, 0).colour
    torch.testing.assert_close(filled, torch.full_like(filled, 0.75))
    boxed = replace(scene, box=torch.tensor([[-2.0, -2, -2], [2, 2, 2]]))
    white = replace(scene, background="white")
    for other, options, hole in ((white, {}, 1), (boxed, {}, 0), (scene, {"fill": False}, 0)):
        seen = render_camera(renderer, other, cameras, 0, **options).colour[12, 12]
        assert seen.tolist() == [hole] * 3

    inside = torch.ones(24, 24, dtype=torch.bool)
    inside[:4] = False
    with mock.patch.object(Cameras, "has_ray", return_value=inside):
        seen = render_camera(renderer, scene, cameras, 0).colour
    assert torch.equal(seen, filled * inside[..., None])
