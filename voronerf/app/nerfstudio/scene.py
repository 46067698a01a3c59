"""A scene of nerfstudio as one of voronerf."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras as TheirCameras
from torch import Tensor

from voronerf.app.scenes import Scene, Split
from voronerf.app.scenes.photographs import find_frame
from voronerf.nerf import Cameras, Contraction


def seen_from_inside(cameras: TheirCameras, box: Tensor) -> bool:
    """Whether a camera stands in the scene box [2, 3]: then there is something to see outside of it, too."""
    origins = cameras.camera_to_worlds[..., 3]
    return bool(((origins > box[0]) & (origins < box[1])).all(-1).any())


def scene_of(cameras: TheirCameras, box: Tensor, *, contracted: bool) -> Scene:
    """The cameras, the box and the bounds of a scene, without its images.

    Args:
        cameras: Of the training images.
        box: [2, 3], the scene box of nerfstudio's parser.
        contracted: Whether all of space is to be seen. There is no box then, but a sphere around what the cameras look
            at, with near and far as ``voronerf train`` finds them.
    """
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, :3] = cameras.camera_to_worlds.cpu()
    intrinsics = torch.cat((cameras.fx, cameras.fy, cameras.cx, cameras.cy), dim=-1).cpu()
    ours = Cameras(poses, intrinsics, int(cameras.width.max()), int(cameras.height.max()))
    views = Split(ours, torch.empty(0, ours.height, ours.width, 3, dtype=torch.uint8), ())
    about: dict[str, Any] = {"name": "nerfstudio", "train": views, "test": views}
    if not contracted:
        box = box.cpu().float()
        far = float((ours.origins - box.mean(0)).norm(dim=-1).max() + (box[1] - box[0]).norm())
        return Scene(near=0.0, far=far, box=box, **about)
    frame = find_frame(poses.double(), "unbounded", normalise=False)
    sphere = Contraction(frame.centre.float(), frame.radius)
    return Scene(near=frame.near, far=frame.far, kind="unbounded", contraction=sphere, **about)
