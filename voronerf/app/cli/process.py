"""``voronerf process``: makes a scene from a video or photographs."""

from __future__ import annotations

import os
import sys
import threading
from datetime import timedelta
from pathlib import Path
from typing import Literal

from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.table import Column
from rich.text import Text

from voronerf.app.cli.display import console, say
from voronerf.app.cli.opening import check_counts
from voronerf.app.scenes.process import MAPPER
from voronerf.app.scenes.process import process as make_scene


def process(
    source: Path,
    out: Path,
    /,
    frames: int = 150,
    matching: Literal["auto", "exhaustive", "sequential"] = "auto",
    camera_model: str = "SIMPLE_RADIAL",
    mapper: Literal["auto", "global", "incremental"] = "auto",
    max_features: int = 4096,
    size: int = 1600,
    verbose: bool = False,
) -> int:
    """Make a scene from a video or images: COLMAP finds the cameras. The same command continues after a stop.

    Args:
        source: A video, or a folder of images, also in subfolders: PNG, JPEG, WebP, TIFF, BMP or, with pillow-heif,
            HEIC. A folder named masks, in or beside the folder of the images, may hold a mask for each image; pixels
            that are black in the mask are ignored.
        out: The folder to make; it gets images, masks if there are any, sparse/0, transforms.json, and colmap, which
            holds the results of each stage so that the command can continue.
        frames: Number of evenly spaced frames to take from a video; all frames if it has fewer.
        matching: The pairs of images that are compared: all pairs (exhaustive), neighbours by name (sequential), or
            images that share their largest features (auto).
        camera_model: COLMAP's name of the lens, such as SIMPLE_RADIAL, OPENCV or OPENCV_FISHEYE.
        mapper: COLMAP's mapper; auto is global, and also incremental if the global model has faults or loses cameras. A
            model that contradicts pairs of images is made again without the doubtful pairs.
        max_features: Greatest number of features of an image.
        size: Pixels along the longer side to which images are reduced for the search of features.
        verbose: Show the output of COLMAP.
    """
    check_counts(frames=frames, max_features=max_features, size=size)
    display = StageDisplay()
    try:
        with display.progress:
            make_scene(
                source,
                out,
                frames=frames,
                matching=matching,
                camera_model=camera_model,
                mapper=mapper,
                max_features=max_features,
                size=size,
                verbose=verbose,
                say=say,
                progress=display.show,
            )
    except (KeyboardInterrupt, SystemExit) as stop:  # Ctrl-C, SIGTERM
        say("stopped; continue with the same command")
        status = stop.code if isinstance(stop, SystemExit) and isinstance(stop.code, int) else 130
        if any(thread.name == MAPPER for thread in threading.enumerate()):
            sys.stdout.flush()
            os._exit(status)  # COLMAP's thread still runs, and would crash when Python's shutdown frees its memory
        return status
    return 0


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
    """A display of the stages of a long command: bars with the remaining time on a terminal, plain lines elsewhere.

    Its ``progress`` is the context manager that shows the bars.
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
        self.tasks: dict[str, TaskID] = {}

    def show(self, stage: str, done: int, total: int) -> None:
        """Shows the progress of a stage; a total of 0 means unknown."""
        if stage not in self.tasks:
            for task in self.progress.tasks:
                if task.total is None:  # a finished stage of unknown length
                    self.progress.update(task.id, completed=1, total=1)
            self.tasks[stage] = self.progress.add_task(stage, total=None, count="")
            if not console.is_terminal:
                say(stage)
        count = f"{done} of {total}" if total else str(done or "")
        self.progress.update(self.tasks[stage], completed=done, total=total or None, count=count)
