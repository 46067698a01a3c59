"""Tests of the angle between a test view and the nearest training camera."""

import math

import pytest
import torch

from voronerf.app.evaluate import ViewScore, mean_scores, nearest_angle
from voronerf.nerf.cameras import Cameras, look_at, orbit_cameras
from voronerf.nerf.renderer import RenderedImage

SIDE = 20


def shown(depth, opacity=1.0):
    colours, depths = torch.zeros(SIDE, SIDE, 3), torch.full((SIDE, SIDE), float(depth))
    return RenderedImage(colours, torch.full_like(depths, opacity), depths, colours)


def at(angles, *, focal=200.0, height=0.0, **options):
    """Returns cameras on a circle around the origin, at ``angles`` in degrees, which look at the origin."""
    turns = torch.tensor(angles, dtype=torch.float32).deg2rad()
    origins = torch.stack((2 * turns.cos(), 2 * turns.sin(), torch.full_like(turns, height)), dim=-1)
    poses = torch.cat([look_at(each[None], torch.zeros(3), torch.tensor([0.0, 0, 1])) for each in origins])
    lens = torch.tensor([focal, focal, SIDE / 2, SIDE / 2]).repeat(len(poses), 1)
    return Cameras(poses, lens, SIDE, SIDE, **options)


@pytest.mark.parametrize("angle", [0.0, 3.0, 40.0, 170.0])
def test_the_angle_is_the_one_at_the_surface(angle):
    assert nearest_angle(shown(2), at([0.0]), 0, at([angle, 179.0])) == pytest.approx(angle, abs=0.5)
    # Seen from a surface twice as far away, behind the origin, the two cameras are closer together.
    if angle == 40:
        behind = nearest_angle(shown(4), at([0.0], focal=2000), 0, at([angle], focal=20))
        turn = math.radians(40)
        a, b = torch.tensor([4.0, 0]), torch.tensor([2 + 2 * math.cos(turn), 2 * math.sin(turn)])
        expected = math.degrees(math.acos(float(torch.nn.functional.cosine_similarity(a, b, dim=0))))
        assert behind == pytest.approx(expected, abs=0.2)


def test_only_cameras_count_whose_image_has_the_surface():
    away = at([10.0])
    away.poses[:, :3, :2] *= -1  # turned by 180 degrees around its axis: sees the same
    assert nearest_angle(shown(2), at([0.0]), 0, away) == pytest.approx(10, abs=0.2)
    away.poses[:, :3, 1:3] *= -1  # looks outwards
    assert nearest_angle(shown(2), at([0.0]), 0, away) == 180
    away = Cameras(torch.cat((away.poses, at([30.0]).poses)), away.intrinsics.repeat(2, 1), SIDE, SIDE)
    assert nearest_angle(shown(2), at([0.0]), 0, away) == pytest.approx(30, abs=0.2)


def test_lenses_of_all_directions_see_what_is_behind_them():
    for model, sees in ((1, False), (3, True)):  # a narrow fisheye, and a panorama
        kind = {"distortion": torch.zeros(1, 8), "models": torch.tensor([model], dtype=torch.int32)}
        training = at([10.0], **kind)
        training.poses[:, :3, 1:3] *= -1
        angle = nearest_angle(shown(2), at([0.0]), 0, training)
        assert (angle == pytest.approx(10, abs=0.2)) == sees and (angle == 180) != sees


def test_a_view_of_nothing_has_no_angle_and_far_views_are_counted():
    cameras = orbit_cameras(4, radius=2.0, elevation=0.0, width=SIDE, height=SIDE, focal=200.0)
    assert nearest_angle(shown(2, opacity=0.2), cameras, 0, cameras) is None
    scores = [ViewScore(str(angle), 20.0, 0.5, angle=angle) for angle in (None, 3.0, 15.0, 15.5, 180.0)]
    assert mean_scores(scores)["far_views"] == 2
