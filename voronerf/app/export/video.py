"""A trained run as a video."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from voronerf.app.evaluate.panels import picture_of_colour
from voronerf.app.export.space import Track, in_silence
from voronerf.app.render.paths import CameraPath, spiral_cameras
from voronerf.app.render.video import write_video
from voronerf.app.run import Run
from voronerf.nerf.cameras import turntable_cameras


def export_video(
    run: Run,
    path: Path | str,
    *,
    flight: CameraPath | None = None,
    spiral: bool = False,
    frames: int = 60,
    fps: float | None = None,
    box: Tensor | None = None,
    track: Track = in_silence,
) -> None:
    """Renders a video along a camera path, a spiral, or a turntable.

    Args:
        run: The run.
        path: File to write, .mp4.
        flight: The frames and their rate; None for a spiral or a turntable.
        spiral: Go where the training cameras are; a scene that was taken from one side is never turned.
        frames: Of a spiral or a turntable.
        fps: Frames a second; None for those of the flight, else 24.
        box: [2, 3], what is shown; None for everything.
        track: Shows progress: yields the items of a sequence, and is given its name.

    Raises:
        ConfigError: An empty box.
        ImportError: imageio-ffmpeg is missing.
        ValueError: Another suffix.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_video
        >>> def turn(run: Run) -> None:
        ...     export_video(run, "turntable.mp4", frames=96)
    """
    scene = run.scene
    shown = run if box is None else run.cropped(box)
    if flight is not None:
        cameras, fps = flight.frames, fps or flight.fps
    elif spiral or scene.kind == "forward":
        cameras = spiral_cameras(scene.train.cameras, frames, near=scene.near, far=scene.far)
    else:
        cameras = turntable_cameras(scene.train.cameras, frames)
    numbers = track(range(len(cameras)), "rendering")
    pictures = (picture_of_colour(shown.render(cameras, number, heaviest=False).colour) for number in numbers)
    write_video(Path(path), pictures, fps or 24)
