"""``voronerf process``: makes a scene from videos or photographs."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import timedelta
from pathlib import Path
from typing import Literal

from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

from voronerf.app.cli.display import console, say
from voronerf.app.cli.opening import check_counts
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.process import MAPPER
from voronerf.app.scenes.process import process as make_scene


@dataclass(frozen=True)
class ProcessSettings:
    """The search for the cameras of images."""

    prefix = ""  # of the options

    frames: int = 150
    """Number of evenly spaced frames to take from the videos; all frames if they have fewer."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """The pairs of images that are compared: all pairs (exhaustive), neighbours by name (sequential), or images that
    share their largest features (auto)."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the lens, such as SIMPLE_RADIAL, OPENCV or OPENCV_FISHEYE."""
    mapper: Literal["auto", "global", "incremental"] = "auto"
    """COLMAP's mapper; auto is global, and also incremental if the global model has faults or loses cameras. A model
    that contradicts pairs of images is made again without the doubtful pairs."""
    max_features: int = 4096
    """Greatest number of features of an image."""
    size: int = 1600
    """Pixels along the longer side to which images are reduced for the search of features."""
    verbose: bool = False
    """Show the output of COLMAP."""


@dataclass(frozen=True)
class CaptureSettings(ProcessSettings):
    """The search for cameras if --data is a video or a folder of pictures without cameras, as in voronerf process."""

    prefix = "process_"


AS_IN_PROCESS = CaptureSettings()


def process(
    source: Path, out: Path, more: tuple[Path, ...] = (), /, settings: ProcessSettings = ProcessSettings()
) -> int:
    """Make a scene from videos or images: COLMAP finds the cameras. The same command continues after a stop.

    Args:
        source: A video, or a folder of images, also in subfolders: PNG, JPEG, WebP, TIFF, BMP or, with pillow-heif,
            HEIC, or of videos. A folder named masks, in or beside the folder of the images, may hold a mask for each
            image; pixels that are black in the mask are ignored.
        out: The folder to make; it gets images, masks if there are any, sparse/0, transforms.json, and colmap, which
            holds the results of each stage so that the command can continue.
        more: With several videos, as in `process a.mp4 b.mp4 DIR`, the last path is the folder to make.
        settings: The settings of COLMAP.
    """
    paths = [source, out, *more]
    return find_cameras(paths[:-1], paths[-1], settings)


def find_cameras(sources: Sequence[Path], out: Path, settings: ProcessSettings) -> int:
    """Makes a scene with a progress line; returns 0, or the exit status after Ctrl-C or SIGTERM."""
    check_counts(frames=settings.frames, max_features=settings.max_features, size=settings.size)
    display = StageDisplay()
    try:
        with display.progress, prefixed_options(settings) as renamed:
            make_scene(sources, out, **vars(settings), say=lambda line: say(renamed(line)), progress=display.show)
    except (KeyboardInterrupt, SystemExit) as stop:  # Ctrl-C, SIGTERM
        say("stopped; continue with the same command")
        status = stop.code if isinstance(stop, SystemExit) and isinstance(stop.code, int) else 130
        if any(thread.name == MAPPER for thread in threading.enumerate()):
            sys.stdout.flush()
            os._exit(status)  # COLMAP's thread still runs, and would crash when Python's shutdown frees its memory
        return status
    return 0


@contextlib.contextmanager
def prefixed_options(settings: ProcessSettings) -> Iterator[Callable[[str], str]]:
    """A context in which errors name options with the command's prefix; yields a function that adds it in a text."""
    names = "|".join(field.name.replace("_", "-") for field in fields(settings))

    def renamed(text: str) -> str:
        return re.sub(rf"--(?=({names})\b)", f"--{settings.prefix.replace('_', '-')}", text)

    try:
        yield renamed
    except SceneError as error:
        raise SceneError(renamed(str(error))) from None


#: Width of a bar in characters; it fits beside the longest name of a stage in 80 columns.
BAR = 10


class TimeLeft(ProgressColumn):
    """A column with the remaining time of a stage, or with its elapsed time if the remaining time is unknown.

    The time is extrapolated from the whole stage. The column of rich uses the last 30 seconds alone, in which few
    images may be done.
    """

    def render(self, task: Task) -> Text:
        """Returns the text of the column."""
        elapsed = task.finished_time if task.finished else task.elapsed
        if task.finished or not task.total or not task.completed or not elapsed:
            return Text(f"{timedelta(seconds=round(elapsed or 0))}", style="progress.elapsed")
        remaining = timedelta(seconds=round(elapsed * (task.total / task.completed - 1)))
        return Text(f"{remaining} left", style="progress.remaining")


class StageDisplay:
    """A display of the stages of a long command: on a terminal a line with the remaining time, else a line per stage.

    Its ``progress`` is the context manager that shows the line.
    """

    def __init__(self) -> None:
        self.progress = Progress(
            TextColumn("[bold]{task.description:<10}", table_column=Column(no_wrap=True, overflow="ellipsis")),
            BarColumn(bar_width=BAR),
            TextColumn("{task.fields[count]}", table_column=Column(no_wrap=True)),
            TimeLeft(table_column=Column(no_wrap=True)),
            console=console,
            disable=not console.is_terminal,
            refresh_per_second=4,
        )
        self.task = self.progress.add_task("", total=None, count="", visible=False)

    def show(self, stage: str, done: int, total: int) -> None:
        """Shows the progress of a stage; a total of 0 means unknown."""
        if stage != self.progress.tasks[0].description:
            self.progress.reset(self.task, description=stage, visible=True)
            if not console.is_terminal:
                say(stage)
        count = f"{done} of {total}" if total else str(done or "")
        self.progress.update(self.task, completed=done, total=total or None, count=count)
