"""Converts a scene of nerfstudio into one of voronerf."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras as TheirCameras
from torch import Tensor

from voronerf.app.scenes import Scene, Split
from voronerf.app.scenes.photographs import find_frame
from voronerf.nerf import Cameras, Contraction


def seen_from_inside(cameras: TheirCameras, box: Tensor) -> bool:
    """Returns whether a camera stands in the scene box [2, 3], so that it sees space outside of the box too."""
    origins = cameras.camera_to_worlds[..., 3]
    return bool(((origins > box[0]) & (origins < box[1])).all(-1).any())


def scene_of(cameras: TheirCameras, box: Tensor, *, contracted: bool) -> Scene:
    """Makes a scene of cameras, box and bounds, without images.

    Args:
        cameras: The training cameras.
        box: [2, 3], the scene box of nerfstudio's parser.
        contracted: Whether to render all of space. The scene then has a sphere around the cameras' focus instead of a
            box, and near and far are chosen as in ``voronerf train``.
    """
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, :3] = cameras.camera_to_worlds.cpu()
    intrinsics = torch.cat((cameras.fx, cameras.fy, cameras.cx, cameras.cy), dim=-1).cpu()
    converted = Cameras(poses, intrinsics, int(cameras.width.max()), int(cameras.height.max()))
    views = Split(converted, torch.empty(0, converted.height, converted.width, 3, dtype=torch.uint8), ())
    common: dict[str, Any] = {"name": "nerfstudio", "train": views, "test": views}
    if not contracted:
        box = box.cpu().float()
        far = float((converted.origins - box.mean(0)).norm(dim=-1).max() + (box[1] - box[0]).norm())
        return Scene(near=0.0, far=far, box=box, **common)
    frame = find_frame(poses.double(), "unbounded", normalise=False)
    sphere = Contraction(frame.centre.float(), frame.radius)
    return Scene(near=frame.near, far=frame.far, kind="unbounded", contraction=sphere, **common)
