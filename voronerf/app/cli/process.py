"""``voronerf process``: a scene of a video or of photographs."""

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
    """Make a scene of a video or of images: COLMAP finds the cameras. A stopped one goes on with the same command.

    Args:
        source: A video, or a folder of PNG, JPEG, WebP, TIFF, BMP or, with pillow-heif, HEIC images, or of folders of
            these. Its folder masks may have a mask of each, whose black pixels do not count.
        out: The folder to make; it gets images, masks if there are any, sparse/0, transforms.json and colmap, which
            keeps every stage.
        frames: Frames taken of a video, evenly spread; of a shorter one all.
        matching: Which images are compared: all with all, each with those next to it by name, or those that share
            their largest features (auto).
        camera_model: COLMAP's name of the lens, such as SIMPLE_RADIAL, OPENCV or OPENCV_FISHEYE.
        mapper: How cameras are found; auto is global, and incremental too if that model has faults or loses
            cameras. A model that contradicts pairs of images is made again, without pairs that may mislead.
        max_features: Of an image.
        size: Pixels of an image's longer side, to which it is reduced where features are searched.
        verbose: Show what COLMAP says.
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
            os._exit(status)  # COLMAP's thread still runs, and crashes when Python's shutdown takes its memory
        return status
    return 0


#: Width of a bar beside the longest name of a stage, in 80 columns.
BAR = 10


class TimeLeft(ProgressColumn):
    """The time that is left of a stage, from what it has done since it began; else the time that it has taken.

    The column of rich knows the last 30 seconds alone, in which few images may be done.
    """

    def render(self, task: Task) -> Text:
        """The text of the column."""
        taken = task.finished_time if task.finished else task.elapsed
        if task.finished or not task.total or not task.completed or not taken:
            return Text(f"{timedelta(seconds=round(taken or 0))}", style="progress.elapsed")
        left = timedelta(seconds=round(taken * (task.total / task.completed - 1)))
        return Text(f"{left} left", style="progress.remaining")


class StageDisplay:
    """Shows the stages of a long command: a bar for each on a terminal, with the time left; plain lines elsewhere.

    Its ``progress`` are the bars, which show while it is entered.
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
        """Shows how much of a stage is done; a total of 0 is not known."""
        if stage not in self.tasks:
            for task in self.progress.tasks:
                if task.total is None:  # of unknown length, and over now
                    self.progress.update(task.id, completed=1, total=1)
            self.tasks[stage] = self.progress.add_task(stage, total=None, count="")
            if not console.is_terminal:
                say(stage)
        count = f"{done} of {total}" if total else str(done or "")
        self.progress.update(self.tasks[stage], completed=done, total=total or None, count=count)
