"""``voronerf render``: a video of a trained run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from voronerf.app.cli.display import say, tracked
from voronerf.app.cli.opening import AS_IN_TRAINING, Crop, Opening, check_counts, crop_box
from voronerf.app.export.video import export_video
from voronerf.app.render.paths import read_camera_path
from voronerf.app.render.video import check_video
from voronerf.app.train.config import ConfigError


def render(
    run: Path,
    /,
    out: Path | None = None,
    path: Path | None = None,
    spiral: bool = False,
    frames: int = 60,
    fps: float | None = None,
    crop: Crop = None,
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Render a video of a trained run: a turntable, a spiral, or a camera path.

    Args:
        run: The run directory.
        out: The video file, .mp4; default turntable.mp4, spiral.mp4 or the name of the path in the run directory.
        path: Camera path in nerfstudio's format, such as the viewer saves; it has the frames and their size.
        spiral: Go where the training cameras are: up and down around an object, or a small spiral before a scene that
            was taken from one side, for which it is the default.
        frames: Frames of a turntable or a spiral.
        fps: Frames per second; default 24, or those of the path.
        crop: Show a box only, x y z of its lowest and of its highest corner, or "saved" for the viewer's.
        opening: How the run is opened.
    """
    check_counts(frames=frames)
    if fps is not None and not 0.01 <= fps <= 1000:
        raise ConfigError(f"--fps must be 0.01 to 1000, got {fps:g}")
    if path is not None and spiral:
        raise ConfigError("--spiral must be off with --path, which has the frames")
    flight = None if path is None else read_camera_path(path)
    if flight is not None:
        flight = replace(flight, frames=flight.frames.downscaled(opening.downscale or 1))
    opened = opening.open_without_images(run)
    spiral = spiral or opened.scene.kind == "forward"
    name = path.stem if path is not None else "spiral" if spiral else "turntable"
    out = out or run / f"{name}.mp4"
    check_video(out)
    box = crop_box(opened, crop)
    export_video(opened, out, flight=flight, spiral=spiral, frames=frames, fps=fps, box=box, track=tracked)
    say(f"wrote {out}")
    return 0
