"""Rays of every camera model of COLMAP, against pixels by pycolmap 4.2.

OpenCV 5.0 (`projectPoints`, `fisheye.projectPoints`) gives the same pixels to 1e-13 for all but THIN_PRISM_FISHEYE.
"""

import json
from pathlib import Path

import pytest
import torch
from helpers import refuses

from voronerf.data.lenses import MODELS, REFUSED, colmap_lens
from voronerf.rendering import Cameras

TABLE = json.loads((Path(__file__).parent / "lenses.json").read_text())


@pytest.mark.parametrize("model", [name for name, _ in MODELS.values() if name not in REFUSED])
def test_rays_go_where_colmap_and_opencv_see_the_points(model):
    row = TABLE[model]
    lens = colmap_lens(model, row["params"])
    intrinsics, bent = (torch.tensor([part]) for part in (lens.intrinsics, lens.coefficients))
    cameras = Cameras(torch.eye(4)[None], intrinsics, 640, 480, bent, lens.fisheye)
    points = torch.tensor(row["points"], dtype=torch.float64) * torch.tensor([1.0, -1.0, -1.0])  # OpenGL's axes
    pixels = torch.tensor(row["pixels"])
    rays = cameras.rays(0, *pixels.unbind(-1))
    expected = torch.nn.functional.normalize(points, dim=-1)
    assert float((rays.directions - expected).norm(dim=-1).max()) * max(lens.intrinsics[:2]) < 1e-4
    again, _ = cameras.project(points.float(), 0)
    torch.testing.assert_close(again, pixels, atol=1e-4, rtol=0)


def test_refuses_unknown_models():
    refuses("camera model FOV is not supported, only SIMPLE_PINHOLE, PINHOLE", colmap_lens, "FOV", [1.0] * 5)
    refuses("RADIAL must have 5 parameters, got 4", colmap_lens, "RADIAL", [1.0] * 4)
