"""Converts between a browser's cameras and the renderer's cameras.

A browser's camera has OpenCV's axes (x right, y down, z forward), square pixels, and a vertical `fov`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from viser.transforms import SO3

from voronerf.app.scenes import Scene
from voronerf.nerf.cameras import Cameras, shared_focus

#: The matrix that converts OpenCV's axes to OpenGL's, and back.
FLIP = np.diag([1.0, -1.0, -1.0])


def make_camera(
    rotation: NDArray[np.floating], position: NDArray[np.floating], fov: float, aspect: float, longest: int
) -> Cameras:
    """Returns one camera whose picture fills a canvas.

    Args:
        rotation: [3, 3], camera to world, in OpenCV's axes.
        position: [3], in scene units.
        fov: The vertical angle of view in radians.
        aspect: Width over height of the canvas.
        longest: Pixels along the longer side of the picture.

    Examples:
        >>> import numpy as np
        >>> from voronerf.app.viewer.cameras import make_camera
        >>> camera = make_camera(np.eye(3), np.zeros(3), fov=1.0, aspect=1.5, longest=300)
        >>> camera.width, camera.height, camera.forward
        (300, 200, tensor([[-0., -0., 1.]]))
    """
    width = longest if aspect >= 1 else max(1, round(longest * aspect))
    height = longest if aspect < 1 else max(1, round(longest / aspect))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation @ FLIP, position
    # Rounding to whole pixels changes the aspect a little; stretching the picture over the canvas undoes that.
    down = height / 2 / math.tan(fov / 2)
    across = down * width / (height * aspect)
    poses = torch.from_numpy(pose).float()[None]
    return Cameras(poses, poses.new_tensor([[across, down, width / 2, height / 2]]), width, height)


def frustum(cameras: Cameras, number: int) -> dict[str, Any]:
    """Returns the arguments of viser's ``add_camera_frustum`` for one of several cameras."""
    cameras, number = cameras[[number]].perspective(), 0
    pose, (width, height) = cameras.poses[number].double().numpy(), cameras.size(number)
    fov = 2 * math.atan(height / 2 / float(cameras.intrinsics[number, 1]))
    wxyz = SO3.from_matrix(pose[:3, :3] @ FLIP).wxyz
    return {"fov": fov, "aspect": width / height, "wxyz": wxyz, "position": pose[:3, 3]}


def angle_of_view(cameras: Cameras, number: int, aspect: float) -> float:
    """Returns the vertical angle in radians at which a canvas shows the whole picture of one of several cameras."""
    view = frustum(cameras, number)
    return 2 * math.atan(math.tan(view["fov"] / 2) * max(1.0, view["aspect"] / aspect))


def axial_depth(camera: Cameras, depth: Tensor) -> Tensor:
    """Converts distances along rays [h, w] to distances along the optical axis."""
    fx, fy, cx, cy = camera.intrinsics[0].to(depth).unbind()
    u = (torch.arange(camera.width, dtype=depth.dtype, device=depth.device) + 0.5 - cx) / fx
    v = (torch.arange(camera.height, dtype=depth.dtype, device=depth.device) + 0.5 - cy) / fy
    return depth / (1 + u.square() + v.square()[:, None]).sqrt()


def scene_bounds(scene: Scene) -> Tensor:
    """Returns the scene's box [2, 3]; if there is none, a box around the cameras and points in front of them."""
    if scene.box is not None:
        return scene.box.cpu()
    cameras = scene.train.cameras
    places = torch.cat((cameras.origins, cameras.origins + cameras.forward * cameras.origins.std().clamp_min(0.5)))
    low, high = places.amin(0), places.amax(0)
    margin = (high - low).amax() / 2
    return torch.stack((low - margin, high + margin))


def look_point(scene: Scene, cameras: Cameras, index: int) -> Tensor:
    """Returns the point [3] around which a camera turns: the point of its axis nearest to the scene's focus."""
    focus = shared_focus(scene.train.cameras)
    centre = scene_bounds(scene).mean(0) if focus is None else focus
    origin, forward = cameras.origins[index], cameras.forward[index]
    return origin + forward * ((centre - origin) @ forward).clamp_min(0.1)
