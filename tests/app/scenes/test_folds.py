"""Tests of detecting ambiguous matches and folded models, on simulated matches of cameras on a circle."""

import itertools
import math

import numpy as np
import pytest
import torch

from voronerf.app.scenes.colmap import ColmapCamera, ColmapImage
from voronerf.app.scenes.folds import (
    WIDE_MATCHES,
    Matches,
    contradicted_pairs,
    epipolar_angles,
    is_folded,
    spreads,
    still_pairs,
    strong_pairs,
    trusted_pairs,
    wide_pairs,
)
from voronerf.app.scenes.lenses import colmap_lens
from voronerf.nerf.cameras import orbit_cameras
from voronerf.nerf.lenses import distort

COUNT, WIDTH, HEIGHT, FOCAL = 12, 400, 300, 300.0
NAMES = [f"{index:02}.png" for index in range(COUNT)]
LENS = colmap_lens("SIMPLE_RADIAL", (FOCAL, WIDTH / 2, HEIGHT / 2, 0.05))


def images(turned=()):
    """Returns images of cameras on a circle; the cameras with `turned` indices are moved to the opposite side."""
    poses = orbit_cameras(COUNT, radius=4.0, elevation=20.0, width=WIDTH, height=HEIGHT, focal=FOCAL).poses.double()
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    result = []
    for index, name in enumerate(NAMES):
        pose = torch.eye(4).double()
        pose[:3] = half_turn @ poses[index, :3] if index in turned else poses[index, :3]
        camera = ColmapCamera("SIMPLE_RADIAL", LENS, WIDTH, HEIGHT)
        result.append(ColmapImage(name, camera, pose.numpy(), np.zeros(0, dtype=np.int64)))
    return result


def matches():
    """Returns matches of 200 points: neighbours match all points, other pairs only the 40 points in the middle."""
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
    points[:40] *= 0.2
    features = {}
    for image in images():
        x, y, z = ((points - torch.from_numpy(image.pose[:3, 3])) @ torch.from_numpy(image.pose[:3, :3])).unbind(-1)
        u, v = distort(x / -z, y / z, torch.tensor(LENS.coefficients), LENS.model)
        features[image.name] = (torch.stack((u, v), -1) * FOCAL + torch.tensor((WIDTH / 2, HEIGHT / 2))).numpy()
    pairs = {}
    for a, b in itertools.combinations(range(COUNT), 2):
        rows = np.arange(200 if (b - a) % COUNT in (1, COUNT - 1) else 40)
        pairs[NAMES[a], NAMES[b]] = np.stack((rows, rows), 1)
    return Matches(features, pairs)


def test_a_background_that_stands_still_is_seen_in_pairs_that_differ_by_a_shift():
    data = matches()
    assert still_pairs(data) == (0, len(data.pairs))
    generator = np.random.default_rng(0)
    background = generator.uniform((0, 0), (WIDTH, HEIGHT), (250, 2))
    for name, places in data.features.items():  # the background shifts in each image
        data.features[name] = np.concatenate((places, background + generator.uniform(-30, 30, 2)))
    behind = np.arange(200, 450)[:, None].repeat(2, 1)
    moved = {pair: np.concatenate((rows, behind)) for pair, rows in data.pairs.items()}
    assert still_pairs(Matches(data.features, moved)) == (len(moved), len(moved))
    few = {pair: rows[: WIDE_MATCHES - 1] for pair, rows in moved.items()}
    assert still_pairs(Matches(data.features, few)) == (0, 0)


def neighbours():
    return {tuple(sorted((NAMES[index - 1], NAMES[index]))) for index in range(COUNT)}


def test_pairs_that_match_over_much_of_both_images_are_wide():
    data = matches()
    assert set(wide_pairs(data, spreads(data))) == neighbours()
    few = {pair: rows[:29] if pair == (NAMES[0], NAMES[1]) else rows for pair, rows in data.pairs.items()}
    assert set(wide_pairs(Matches(data.features, few), spreads(data))) == neighbours() - {(NAMES[0], NAMES[1])}
    bare = {"a": np.zeros((0, 2)), "b": np.ones((40, 2))}
    assert spreads(Matches(bare, {("a", "b"): np.zeros((0, 2), dtype=np.int64)})) == {("a", "b"): 0}


def test_an_image_without_strong_pairs_keeps_its_best_pairs():
    pairs = {  # number of matches, and the fraction of the image that they span
        ("a", "b"): (200, 0.5),
        ("a", "c"): (100, 0.5),
        ("b", "d"): (49, 0.5),  # wide, but few matches
        ("a", "d"): (190, 0.02),
        ("c", "d"): (90, 0.1),
        ("b", "c"): (90, 0.03),
        ("d", "e"): (29, 0.1),
    }
    data = Matches(dict.fromkeys("abcdef"), {pair: np.zeros((n, 2)) for pair, (n, _) in pairs.items()})
    spread = {pair: share for pair, (_, share) in pairs.items()}
    wide = wide_pairs(data, spread)
    assert wide == [("a", "b"), ("a", "c"), ("b", "d")] and strong_pairs(data, wide) == wide[:2]
    assert trusted_pairs(data, spread) == {*wide, ("c", "d"), ("a", "d")}


def test_a_model_contradicts_the_pairs_that_a_fold_tears_apart():
    data = matches()
    strong = strong_pairs(data, wide_pairs(data, spreads(data)))
    assert contradicted_pairs(data, strong, images()) == (0, COUNT)
    folded = images(turned=range(3, 9))
    assert contradicted_pairs(data, strong, folded) == (2, COUNT)  # one pair at each end of the moved arc
    assert contradicted_pairs(data, strong, folded[:6]) == (1, 5)
    assert contradicted_pairs(data, strong, []) == (0, 0)
    assert [is_folded(*counts) for counts in ((2, 12), (3, 12), (3, 300), (4, 300), (0, 0))] == [0, 1, 0, 1, 0]


@pytest.mark.parametrize("missed", [0.0, 0.003, 0.05])
def test_rays_miss_each_other_by_the_angle_to_the_epipolar_plane(missed):
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5
    left, right = torch.tensor([0.0, -1.0, 8.0]).double(), torch.tensor([0.0, 1.0, 8.0]).double()
    a, b = (torch.nn.functional.normalize(points - origin, dim=-1) for origin in (left, right))
    across = torch.nn.functional.normalize(torch.linalg.cross((right - left).expand_as(b), b), dim=-1)
    turned = math.cos(missed) * b + math.sin(missed) * across
    angles = epipolar_angles(a, turned, right - left)
    # Sampson's distance divides the error between both rays.
    torch.testing.assert_close(angles, torch.full_like(angles, missed / math.sqrt(2)), rtol=0.1, atol=1e-9)
    assert (epipolar_angles(a, turned, torch.zeros(3).double()) == 0).all()
