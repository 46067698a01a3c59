"""``voronerf render``: a video of a trained run, or its frames."""

from __future__ import annotations

import re
from pathlib import Path

from voronerf.app.cli.display import say, tracked
from voronerf.app.cli.opening import AS_IN_TRAINING, Crop, Opening, check_counts, crop_box
from voronerf.app.export.video import FRAMES, check_folder, export_video, video_cameras
from voronerf.app.render.paths import (
    LONGEST_SIDE,
    lists_cameras,
    panoramas,
    read_camera_path,
    read_cameras,
    resized,
    see_all_around,
)
from voronerf.app.render.video import check_video
from voronerf.app.train.config import ConfigError


def render(
    run: Path,
    /,
    out: Path | None = None,
    path: Path | None = None,
    frames: int = FRAMES,
    fps: float | None = None,
    size: str | None = None,
    images: bool = False,
    depth: bool = False,
    panorama: bool = False,
    crop: Crop = None,
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Render a video of a trained run: along --path, or else around an object or near the training cameras.

    Args:
        run: The run directory.
        out: The video file, .mp4, or with --images a new folder; default video, panorama or the name of the path, in
            the run directory.
        path: Camera path in nerfstudio's format, as the viewer saves it, in the coordinates of this run's scene. Or a
            transforms.json (or transforms_test.json and so on) with cameras in the coordinates of the scene's files;
            its images need not exist. The path determines the frames and their size.
        frames: Number of frames of a video without a path.
        fps: Frames per second; default 24, or the rate of the path.
        size: Width and height of the frames, such as 1280x720; default the size of the training images, or of the path.
        images: Write the frames as PNG images into a folder.
        depth: Show the depth instead of the colour, near surfaces in yellow.
        panorama: Render 360-degree equirectangular frames with the horizon in the middle; --size must be 2 to 1.
        crop: Render only a box: x y z of its lowest and of its highest corner, or "saved" for the viewer's crop.
        opening: The settings with which the run is opened.
    """
    check_counts(frames=frames)
    if fps is not None and not 0.01 <= fps <= 1000:
        raise ConfigError(f"--fps must be 0.01 to 1000, got {fps:g}")
    sides = None if size is None else _sides(size)
    flight = None if path is None or lists_cameras(path) else read_camera_path(path)
    opened = opening.open_without_images(run)
    name = (path.stem if path is not None else "panorama" if panorama else "video") + "_depth" * depth
    out = out or run / (name if images else f"{name}.mp4")
    (check_folder if images else check_video)(out)
    if path is None:
        cameras, rate = video_cameras(opened.scene, frames), 24.0
    elif flight is None:
        cameras, rate = read_cameras(path, opened.scene, opening.downscale or 1), 24.0
    else:
        cameras, rate = flight.frames.downscaled(opening.downscale or 1), flight.fps
    if panorama or (sides is not None and see_all_around(cameras)):
        cameras = panoramas(cameras, sides or (2 * cameras.height, cameras.height))
    elif sides is not None:
        cameras = resized(cameras, sides)
    box = crop_box(opened, crop)
    export_video(opened, out, cameras, fps=fps or rate, images=images, depth=depth, box=box, track=tracked)
    say(f"wrote {out}")
    return 0


def _sides(size: str) -> tuple[int, int]:
    """Parses a size such as "1280x720" into width and height."""
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", size)
    if not match or max(int(match[1]), int(match[2])) > LONGEST_SIDE:
        sides = re.findall(r"\d+", size)
        hint = f"; did you mean {'x'.join(sides)}?" if len(sides) == 2 and not match else ""
        rule = f"WIDTHxHEIGHT, such as 1280x720, at most {LONGEST_SIDE} each"
        raise ConfigError(f"--size must be {rule}, got {size!r}{hint}")
    return int(match[1]), int(match[2])
