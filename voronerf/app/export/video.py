"""Exports a trained run as a video, or as images of its frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from voronerf.app.evaluate.panels import SOLID, picture_of_colour, picture_of_depth, save_picture
from voronerf.app.export.space import Track, in_silence
from voronerf.app.render.paths import capture_path, evenly_spaced, like_most
from voronerf.app.render.video import write_video
from voronerf.app.run import Run
from voronerf.app.scenes import Scene
from voronerf.nerf.cameras import Cameras, turntable_cameras

#: Default number of frames of a video.
FRAMES = 60
#: Number of frames from which the range of depths of a video is found.
RANGE_FRAMES = 4


def export_video(
    run: Run,
    path: Path | str,
    cameras: Cameras | None = None,
    *,
    fps: float = 24,
    images: bool = False,
    depth: bool = False,
    box: Tensor | None = None,
    track: Track = in_silence,
) -> None:
    """Renders a video, or its frames as images.

    Args:
        run: The run.
        path: File to write, .mp4; for images a folder, new or empty.
        cameras: A camera per frame; None for 60 frames of :func:`video_cameras`.
        fps: Frames a second.
        images: Write a PNG of each frame, 00000.png and so on.
        depth: Show depth, from near (yellow) to far (dark blue), instead of colours.
        box: [2, 3], the rendered region; None for everything.
        track: Shows progress: takes a sequence and the task's name, and yields the items.

    Raises:
        ConfigError: The box is empty.
        ImportError: imageio-ffmpeg is missing.
        ValueError: The suffix is not .mp4, or the folder is not empty.
        OSError: A file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_video
        >>> from voronerf.app.export.video import video_cameras
        >>> def turn(run: Run) -> None:
        ...     export_video(run, "video.mp4", video_cameras(run.scene, 96))
    """
    path = Path(path)
    if images:
        check_folder(path)
    cropped = run if box is None else run.cropped(box)
    cameras = video_cameras(run.scene, FRAMES) if cameras is None else cameras
    numbers = track(range(len(cameras)), "rendering")
    pictures = _depths(cropped, cameras, numbers) if depth else _colours(cropped, cameras, numbers)
    if not images:
        write_video(path, pictures, fps)
        return
    for number, picture in enumerate(pictures):
        save_picture(path / f"{number:05d}.png", picture)


def video_cameras(scene: Scene, count: int) -> Cameras:
    """Returns the cameras of a video: a turntable of an object, else a path near the training cameras.

    Args:
        scene: The scene, whose training cameras give size and focal length.
        count: Number of frames.
    """
    cameras = scene.train.cameras
    if scene.kind == "object":
        return turntable_cameras(like_most(cameras), count)
    return capture_path(cameras, count, near=scene.near, far=scene.far)


def check_folder(folder: Path) -> None:
    """Raises ValueError unless the folder for images is new or empty."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: must be a new or empty folder for the images")


def _colours(run: Run, cameras: Cameras, numbers: Iterable[int]) -> Iterator[Tensor]:
    for number in numbers:
        yield picture_of_colour(run.render(cameras, number, heaviest=False).colour)


def _depths(run: Run, cameras: Cameras, numbers: Iterable[int]) -> Iterator[Tensor]:
    """Yields pictures of depth (of disparity if rays are sampled in disparity), on one scale for all frames."""

    def measured(number: int) -> tuple[Tensor, Tensor]:
        image = run.render(cameras, number, heaviest=False)
        far = run.scene.spacing == "disparity"
        return -1 / image.depth.clamp_min(1e-6) if far else image.depth, image.opacity

    numbers_of_range = evenly_spaced(len(cameras), RANGE_FRAMES)
    solid = torch.cat([value[opacity > SOLID] for value, opacity in map(measured, numbers_of_range)])
    for number in numbers:
        yield picture_of_depth(*measured(number), among=solid)
