"""Camera paths: near or through the cameras of a capture, smooth through keyframes, or read from nerfstudio's files.

c cameras, f frames. Poses and pixels as in :mod:`voronerf.nerf.cameras`.

The file of a path is JSON: `render_width`, `render_height`, `camera_type`, `fps`, and a list `camera_path` of frames.
The `camera_to_world` of a frame has the numbers of a pose row by row; its `fov` is the vertical angle of view in
degrees. Viewers also store the keyframes: a list `keyframes` with `matrix` and `fov`, and `is_cycle`. The matrix of a
keyframe is a list, row by row. In files of nerfstudio's viewer before 1.0, its Blender add-on and its Maya plugin, this
matrix is a string of JSON, column by column.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.files import json_text, read_json, write_text
from voronerf.app.scenes.photographs import PARALLEL, turned_cameras
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import ORTHONORMAL, views_without_images
from voronerf.nerf.cameras import Cameras, focus_point, look_at, shared_focus
from voronerf.nerf.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE

#: The camera models by their names in path files.
MODELS = {"perspective": PERSPECTIVE, "fisheye": FISHEYE, "equirectangular": EQUIRECTANGULAR}
#: Greatest number of frames of a path, more than an hour at 24 a second.
MOST_FRAMES = 100_000
#: Greatest number of pixels along a side of a frame.
LONGEST_SIDE = 8192
#: Greatest coordinate of a camera in scene units.
FARTHEST = 1e9
#: Angles around the cameras' focus, in radians. A path does not cross the widest gap between cameras if this gap is at
#: least `GAP`. `WINDOW` is the standard deviation of the Gaussian weights by which a path averages the distances and
#: heights of near cameras.
GAP, WINDOW = math.radians(60), math.radians(25)
#: Number of frames for each camera of the capture that a path goes through.
BETWEEN = 4


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The frames of a video, and the keyframes from which they were made.

    Attributes:
        frames: a camera per frame, with the size of the video.
        fps: frames a second.
        keyframes: perspective cameras of the same size, or None.
        closed: whether the path returns to the first keyframe.

    Examples:
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.app.render.paths import CameraPath, smooth_path
        >>> keyframes = orbit_cameras(4, radius=3.0, elevation=20.0, width=64, height=48, focal=70.0)
        >>> path = CameraPath(smooth_path(keyframes, 48, closed=True), fps=24, keyframes=keyframes, closed=True)
        >>> len(path.frames)
        48
    """

    frames: Cameras
    fps: float
    keyframes: Cameras | None = None
    closed: bool = False


def read_camera_path(file: Path | str) -> CameraPath:
    """Reads a path that nerfstudio's viewers, its add-ons or :func:`write_camera_path` have saved.

    Positions are in the coordinates of the rendered scene. The scale of a pose, as in exports of scaled objects, is
    ignored, and so are crops, times and transitions of the file. The default angle of view is the file's `default_fov`.
    If `fps` is missing, the rate follows from the file's `seconds`; if `seconds` is missing too, the rate is 24 frames
    a second. Invalid keyframes are left out.

    Raises:
        ValueError: the file is no camera path, is too large, or its cameras are not perspective, fisheye or
            equirectangular; the message names the file, the frame and the field.
        OSError: the file cannot be read.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.app.render.paths import CameraPath, read_camera_path, write_camera_path
        >>> frames = orbit_cameras(24, radius=3.0, elevation=20.0, width=64, height=48, focal=70.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_camera_path(Path(folder) / "path.json", CameraPath(frames, fps=24))
        ...     path = read_camera_path(Path(folder) / "path.json")
        >>> path.frames.width, path.frames.height, path.fps, path.keyframes
        (64, 48, 24.0, None)
    """
    entries = read_json(Path(file))
    if not isinstance(entries, dict) or not isinstance(entries.get("camera_path"), list):
        raise ValueError(f"{file}: is not a camera path: it must have a list camera_path")
    kind = entries.get("camera_type", "perspective")
    model = MODELS.get(str(kind).lower())
    if model is None:
        raise ValueError(f"{file}: camera_type must be perspective, fisheye or equirectangular, got {kind!r:.60}")
    width, height = (
        int(_number(entries.get(name), 1, LONGEST_SIDE, f"{file}: {name}", whole=True))
        for name in ("render_width", "render_height")
    )
    angle = entries.get("default_fov")
    frames = _read_cameras(
        entries["camera_path"], "camera_to_world", angle, width, height, f"{file}: camera_path", model
    )
    fps = entries.get("fps")
    if fps is None and "seconds" in entries:
        fps = len(frames) / _number(entries["seconds"], 1e-3, 1e9, f"{file}: seconds")
    fps = _number(24 if fps is None else fps, 0.01, 1000, f"{file}: fps")
    keyframes = None
    with contextlib.suppress(RecursionError, TypeError, ValueError):  # a path is usable without keyframes
        keyframes = _read_cameras(entries.get("keyframes"), "matrix", angle, width, height, f"{file}: keyframes")
    return CameraPath(frames, fps, keyframes, entries.get("is_cycle") is True)


def lists_cameras(file: Path | str) -> bool:
    """Returns whether a JSON file lists the cameras of a capture, such as transforms.json, and is no camera path.

    Raises:
        ValueError: the file is not JSON, or is too large.
        OSError: the file cannot be read.
    """
    entries = read_json(Path(file))
    return isinstance(entries, dict) and "camera_path" not in entries and isinstance(entries.get("frames"), list)


def read_cameras(file: Path | str, scene: Scene, downscale: int = 1) -> Cameras:
    """Reads the cameras of a transforms file, such as transforms.json, as cameras in a scene; images need not exist.

    The cameras are in the order of the file. The file's poses are in the coordinates of the scene's files, the returned
    poses in the scene's. Lenses keep their distortion. All cameras get the commonest size, see :func:`resized`; a
    camera of unknown size, as in Blender's files, has the commonest size of the training images.

    Args:
        file: the file, with a list `frames` of which each entry has a `transform_matrix`.
        scene: the scene, with the transform from the coordinates of its files.
        downscale: the factor by which stated sizes are reduced.

    Raises:
        ValueError: the file is invalid.
        OSError: the file cannot be read.

    Examples:
        >>> import json, tempfile, torch
        >>> from pathlib import Path
        >>> from voronerf.app.render.paths import read_cameras
        >>> from voronerf.app.scenes import load_scene
        >>> camera = {"transform_matrix": torch.eye(4).tolist()}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "transforms_test.json"
        ...     _ = file.write_text(json.dumps({"camera_angle_x": 0.7, "frames": [camera]}))
        ...     cameras = read_cameras(file, load_scene("builtin", downscale=20))
        >>> len(cameras), cameras.width
        (1, 5)
    """
    file = Path(file)
    if not 1 <= (count := len(read_json(file, dict)["frames"])) <= MOST_FRAMES:
        raise ValueError(f"{file}: frames must be a list of 1 to {MOST_FRAMES} frames, got {count} of them")
    default = like_most(scene.train.cameras)
    views, applied = views_without_images(file, (default.width * downscale, default.height * downscale))
    matrix = scene.transform @ torch.linalg.inv(applied)
    poses = matrix @ torch.stack([view.pose for view in views])
    poses[:, :3, :3] /= torch.linalg.det(matrix[:3, :3]) ** (1 / 3)
    sizes = torch.tensor([view.size for view in views], device="cpu").long()
    models = torch.tensor([view.lens.model for view in views], dtype=torch.int32, device="cpu")
    coefficients = torch.tensor([view.lens.coefficients for view in views], dtype=torch.float32, device="cpu")
    is_plain = not bool(models.any() or coefficients.any())  # perspective cameras without distortion
    lenses = (None, None) if is_plain else (coefficients, models)
    cameras = Cameras.of_images(
        poses.float(), coefficients.new_tensor([view.lens.intrinsics for view in views]), sizes, *lenses
    )
    try:
        turns = [view.header.turns if view.header else 0 for view in views]
        cameras = _of_one_size(turned_cameras(cameras.downscaled(downscale), turns))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if max(cameras.width, cameras.height) > LONGEST_SIDE:
        size = f"{cameras.width} x {cameras.height}"
        raise ValueError(f"{file}: frames must have at most {LONGEST_SIDE} pixels a side, got {size}; --downscale N")
    return cameras


def _of_one_size(cameras: Cameras) -> Cameras:
    """Returns the cameras with the commonest size of their images; images of other sizes are resized."""
    if cameras.sizes is None:
        return cameras
    sizes = [cameras.size(index) for index in range(len(cameras))]
    common = max(sizes, key=sizes.count)
    each = (
        resized(replace(cameras[[index]], width=size[0], height=size[1], sizes=None), common)
        for index, size in enumerate(sizes)
    )
    return Cameras.joined([*each])


def write_camera_path(file: Path | str, path: CameraPath) -> None:
    """Writes a path in nerfstudio's format, which :func:`read_camera_path` reads too.

    The file keeps poses, size, vertical angles of view, and the camera model of the first frame; the principal point
    becomes the centre of the frame.
    """
    model = PERSPECTIVE if path.frames.models is None else int(path.frames.models[0])
    name = next((name for name, number in MODELS.items() if number == model), None)
    if name is None:
        raise ValueError(f"{file}: cameras of a path must be {', '.join(MODELS)}, got another lens")
    size = {"render_height": path.frames.height, "render_width": path.frames.width}
    keyframes = [] if path.keyframes is None else _entries(path.keyframes, "matrix")
    entries = {
        "camera_type": name,
        **size,
        "fps": path.fps,
        "seconds": len(path.frames) / path.fps,
        "is_cycle": path.closed,
        "smoothness_value": 0.0,
        "default_fov": keyframes[0]["fov"] if keyframes else 50.0,
        "default_transition_sec": len(path.frames) / path.fps / max(len(keyframes) - (not path.closed), 1),
        "keyframes": keyframes,
        "camera_path": _entries(path.frames, "camera_to_world"),
    }
    write_text(Path(file), json_text(entries, indent=1) + "\n")


def smooth_path(keyframes: Cameras, count: int, *, closed: bool = False) -> Cameras:
    """Returns a smooth path through keyframes, by Catmull-Rom splines of the positions and the rotations' quaternions.

    Args:
        keyframes: at least one camera.
        count: number of frames, distributed equally over the pairs of keyframes.
        closed: whether the path returns to the first keyframe; the last frame is then just before it.

    Raises:
        ValueError: there is no keyframe, or `count` is below 1.

    Examples:
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.app.render.paths import smooth_path
        >>> keyframes = orbit_cameras(3, radius=3.0, elevation=0.0, width=64, height=48, focal=70.0)
        >>> frames = smooth_path(keyframes, 5)
        >>> bool((frames.poses[2] - keyframes.poses[1]).abs().max() < 1e-5)
        True
    """
    n = len(keyframes)
    if n < 1 or count < 1:
        raise ValueError(f"smooth_path: keyframes and count must be at least 1, got {n} and {count}")
    device = keyframes.poses.device
    steps = torch.arange(count, dtype=torch.float64, device=device)
    position = steps * n / count if closed else steps * (n - 1) / max(count - 1, 1)
    first = position.floor().long().clamp(max=n - 1)
    t = (position - first)[:, None]
    around = first[:, None] + torch.arange(-1, 3, device=device)  # [f, 4], the keyframes of a frame's spline
    around = around % n if closed else around.clamp(0, n - 1)
    weights = torch.cat(
        (-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2), dim=-1
    ).div(2)[:, :, None]
    positions = (keyframes.origins.double()[around] * weights).sum(1)
    turns = quaternions(keyframes.poses[:, :3, :3].double())[around]
    turns = torch.where((turns * turns[:, 1:2]).sum(-1, keepdim=True) < 0, -turns, turns)  # q and -q are one rotation
    poses = torch.eye(4, dtype=torch.float64, device=device).repeat(count, 1, 1)
    poses[:, :3, :3] = rotations(torch.nn.functional.normalize((turns * weights).sum(1), dim=-1))
    poses[:, :3, 3] = positions
    intrinsics = keyframes.intrinsics
    intrinsics = torch.lerp(intrinsics[around[:, 1]], intrinsics[around[:, 2]], t.to(intrinsics))
    return Cameras(poses.float(), intrinsics, keyframes.width, keyframes.height)


def capture_path(cameras: Cameras, count: int, *, near: float, far: float) -> Cameras:
    """Returns a path that stays near the cameras of a capture, so that its frames show regions in the captured images.

    For forward-facing cameras, the path is the spiral of LLFF (Mildenhall et al. 2019) around the cameras' focus, as
    large as the cameras' extent. For cameras around a focus, it is a turn around the focus, at the mean distance and
    height of the nearest cameras; if the cameras leave a gap, the path goes from one end of the gap to the other and
    back, without crossing the gap. For cameras that look outwards, it is a smooth path through some of the cameras, in
    their order. The frames have the commonest size of the cameras.

    Args:
        cameras: the cameras of the capture, such as the training views; the path has their mean focal length.
        count: number of frames.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which the scene ends; near and far give the focus of parallel cameras.

    Raises:
        ValueError: `count` is below 1.

    Examples:
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.app.render.paths import capture_path
        >>> seen = orbit_cameras(8, radius=2.0, elevation=20.0, width=64, height=64, focal=70.0)
        >>> frames = capture_path(seen, 60, near=1.0, far=3.0)
        >>> bool((frames.origins.norm(dim=-1) - 2).abs().max() < 1e-4)
        True
    """
    if count < 1:
        raise ValueError(f"capture_path: count must be at least 1, got {count}")
    forward = cameras.forward.double().mean(0)
    common = like_most(cameras)
    if forward.norm() > PARALLEL:
        poses = _spiral(cameras, count, focus_point(cameras), near, far)
    elif (focus := shared_focus(cameras)) is not None:
        poses = _around(cameras, count, focus.double())
    else:
        chosen = evenly_spaced(len(cameras), max(count // BETWEEN, 2))
        poses = smooth_path(cameras[chosen], count).poses
    focal = float(common.intrinsics[:, :2].mean())
    intrinsics = cameras.intrinsics.new_tensor((focal, focal, common.width / 2, common.height / 2)).repeat(count, 1)
    return Cameras(poses.float(), intrinsics, common.width, common.height)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Returns the indices of at most ``most`` of ``count`` cameras, evenly spaced from the first to the last."""
    chosen = torch.linspace(0, count - 1, min(most, count), dtype=torch.float32, device="cpu")
    return chosen.round().long().tolist()


def like_most(cameras: Cameras) -> Cameras:
    """Returns the cameras whose images have the commonest size, without their lens distortion."""
    cameras = cameras.perspective()
    sizes = [cameras.size(index) for index in range(len(cameras))]
    width, height = max(sizes, key=sizes.count)
    mask = torch.tensor([size == (width, height) for size in sizes], device=cameras.poses.device)
    return Cameras(cameras.poses[mask], cameras.intrinsics[mask], width, height)


def resized(cameras: Cameras, size: tuple[int, int]) -> Cameras:
    """Resizes cameras to another (width, height); if the aspect ratio differs, the pictures are cropped, not padded."""
    scale = max(size[0] / cameras.width, size[1] / cameras.height)
    intrinsics = scale * cameras.intrinsics
    intrinsics[:, 2] += (size[0] - scale * cameras.width) / 2
    intrinsics[:, 3] += (size[1] - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=size[0], height=size[1])


def see_all_around(cameras: Cameras) -> bool:
    """Returns whether all cameras are equirectangular, with a view of 360 degrees."""
    return cameras.models is not None and bool((cameras.models == EQUIRECTANGULAR).all())


def panoramas(cameras: Cameras, size: tuple[int, int]) -> Cameras:
    """Returns equirectangular 360-degree cameras with ``size``, 2 to 1, at the same positions and with z up.

    Raises:
        ValueError: the size is not 2 to 1.
    """
    if size[0] != 2 * size[1]:
        raise ValueError(f"pictures all around must be 2 to 1, got {size[0]} x {size[1]}")
    if see_all_around(cameras):
        return Cameras.all_around(cameras.poses, size[1])
    level = cameras.forward * cameras.forward.new_tensor((1.0, 1.0, 0.0))
    up = cameras.poses.new_tensor((0.0, 0.0, 1.0))
    targets = cameras.origins + torch.where(level.norm(dim=-1, keepdim=True) > 1e-3, level, cameras.poses[:, :3, 1])
    poses = [look_at(origin[None], target, up)[0] for origin, target in zip(cameras.origins, targets)]
    return Cameras.all_around(torch.stack(poses), size[1])


def _spiral(cameras: Cameras, count: int, focus: Tensor | None, near: float, far: float) -> Tensor:
    """Returns the poses of a closed spiral of two turns in front of a scene."""
    poses = cameras.poses.double()
    angles = torch.arange(count, dtype=torch.float64, device=poses.device) * (4 * math.pi / count)
    centre, forward = poses[:, :3, 3].mean(0), -poses[:, :3, 2].mean(0)
    mean = look_at((centre - forward)[None], centre, poses[:, :3, 1].mean(0))[0]
    mean[:3, 3] = centre
    extent = torch.quantile(((poses[:, :3, 3] - centre) @ mean[:3, :3]).abs(), 0.9, dim=0)
    depth = 1 / (0.25 / near + 0.75 / far)
    if focus is not None:
        depth = float((focus.double() - centre) @ -mean[:3, 2])
    swing = torch.stack((angles.cos(), -angles.sin(), -(angles / 2).sin()), dim=-1) * extent
    return look_at(centre + swing @ mean[:3, :3].T, centre - depth * mean[:3, 2], mean[:3, 1])


def _around(cameras: Cameras, count: int, focus: Tensor) -> Tensor:
    """Returns the poses of a turn around a focus, or of a path back and forth if the cameras leave a gap."""
    up = cameras.poses[:, :3, 1].double().mean(0)
    up = torch.nn.functional.normalize(up, dim=0) if up.norm() > 0.1 else up.new_tensor((0.0, 0.0, 1.0))
    axes = look_at(up[None], torch.zeros_like(up), torch.ones_like(up))[0, :3, :3]  # its third column is up
    local = (cameras.origins.double() - focus) @ axes
    bearing, reach = torch.atan2(local[:, 1], local[:, 0]), local[:, :2].norm(dim=-1)
    sorted_bearings = bearing.sort().values
    gaps = torch.cat((sorted_bearings.diff(), sorted_bearings[:1] + 2 * math.pi - sorted_bearings[-1:]))
    widest = int(gaps.argmax())
    share = torch.arange(count, dtype=torch.float64, device=up.device) / count
    if gaps[widest] < GAP:
        angles = 2 * math.pi * share
    else:
        width = 2 * math.pi - gaps[widest]
        angles = sorted_bearings[(widest + 1) % len(gaps)] + width * (1 - (2 * math.pi * share).cos()) / 2
    difference = torch.remainder(angles[:, None] - bearing + math.pi, 2 * math.pi) - math.pi
    shares = torch.softmax(-(difference / WINDOW).square() / 2, dim=-1)
    reach, height = shares @ reach, shares @ local[:, 2]
    origins = focus + torch.stack((reach * angles.cos(), reach * angles.sin(), height), dim=-1) @ axes.T
    return look_at(origins, focus, up)


def _read_cameras(
    entries: Any, key: str, angle: Any, width: int, height: int, where: str, model: int = PERSPECTIVE
) -> Cameras:
    """Parses a list of frames into cameras; ``angle`` is the default angle of view in degrees."""
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_FRAMES:
        got = f"{len(entries)} of them" if isinstance(entries, list) else f"{entries!r:.60}"
        raise ValueError(f"{where} must be a list of 1 to {MOST_FRAMES} frames, got {got}")
    matrices, focals = [], []
    for number, entry in enumerate(entries):
        label = f"{where}[{number}]"
        matrix = entry.get(key) if isinstance(entry, dict) else None
        if key == "matrix" and isinstance(matrix, str):
            columns = json.loads(matrix)
            matrix = [columns[row::4] for row in range(4)]
        matrices.append(_matrix(matrix, f"{label}.{key}"))
        if model != EQUIRECTANGULAR:
            fov = entry.get("fov")
            fov = _number(angle if fov is None else fov, 0.01, 179.9, f"{label}.fov")
            focals.append([height / 2 / math.tan(math.radians(fov) / 2)] * 2)
        else:
            focals.append([width / 2 / math.pi, height / math.pi])
    poses = torch.tensor(matrices, dtype=torch.float64, device="cpu").view(-1, 4, 4)
    poses[:, :3, :3] /= torch.linalg.det(poses[:, :3, :3]).clamp_min(1e-18)[:, None, None] ** (1 / 3)
    rotations = poses[:, :3, :3]
    identity = torch.eye(3, dtype=poses.dtype, device=poses.device)
    invalid = (rotations @ rotations.mT - identity).abs().amax((1, 2)) > ORTHONORMAL
    invalid |= (poses[:, 3] - poses.new_tensor((0, 0, 0, 1))).abs().amax(-1) > ORTHONORMAL
    if invalid.any():
        raise ValueError(f"{where}[{int(invalid.nonzero()[0])}].{key} must be a rotation and a position")
    poses[:, 3] = poses.new_tensor((0, 0, 0, 1))
    intrinsics = poses.new_tensor([(*focal, width / 2, height / 2) for focal in focals])
    cameras = Cameras(poses.float(), intrinsics.float(), width, height)
    if model == PERSPECTIVE:
        return cameras
    models = torch.full((len(poses),), model, dtype=torch.int32, device=poses.device)
    return replace(cameras, distortion=cameras.poses.new_zeros(len(poses), 8), models=models)


def _matrix(value: Any, where: str) -> list[float]:
    """Parses a pose, a list of numbers or rows, into 16 numbers; the last row may be missing."""
    rows = value if isinstance(value, list) else []
    numbers = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if len(numbers) == 12:
        numbers += [0, 0, 0, 1]
    if len(numbers) != 16:
        raise ValueError(f"{where} must be 4 x 4 or 3 x 4 numbers, got {value!r:.60}")
    return [_number(number, -FARTHEST, FARTHEST, where) for number in numbers]


def _number(value: Any, lowest: float, highest: float, where: str, *, whole: bool = False) -> float:
    # The comparison works for integers of any size, and is false for NaN.
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and lowest <= value <= highest
    if is_number and not (whole and value % 1):
        return float(value)
    kind = "an integer" if whole else "a number"
    raise ValueError(f"{where} must be {kind} of {lowest:g} to {highest:g}, got {value!r:.60}")


def _entries(cameras: Cameras, key: str) -> list[dict[str, Any]]:
    aspect = cameras.width / cameras.height
    angles = 2 * torch.atan(cameras.height / 2 / cameras.intrinsics[:, 1].double()).rad2deg()
    return [
        {key: pose, "fov": fov, "aspect": aspect}
        for pose, fov in zip(cameras.poses.flatten(1).tolist(), angles.tolist())
    ]


def quaternions(rotations: Tensor) -> Tensor:
    """Converts rotations [c, 3, 3] to unit quaternions (w, x, y, z) [c, 4], of either sign.

    A quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix (Bar-Itzhack 2000), which is stable
    for every rotation.
    """
    r = rotations.mT
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in r.unbind(-2))
    rows = (
        (xx + yy + zz, yz - zy, zx - xz, xy - yx),
        (yz - zy, xx - yy - zz, xy + yx, zx + xz),
        (zx - xz, xy + yx, yy - xx - zz, yz + zy),
        (xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return torch.linalg.eigh(matrix)[1][..., -1]


def rotations(quaternions: Tensor) -> Tensor:
    """Converts unit quaternions (w, x, y, z) [c, 4] to rotations [c, 3, 3]."""
    w, x, y, z = quaternions.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
