"""The output of commands: plain lines, and progress bars on a terminal."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import rich
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    track,
)
from rich.table import Column

from voronerf.app.train.callbacks import Scores, counted
from voronerf.app.train.loop import Callback
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP

LONGEST_LINE = 900
#: Width of a bar, and width of a training's live line without its name and text.
BAR = 24
BESIDE = BAR + len(" 100 %    0:00:00 ")

#: Seconds between two progress lines of a long task if the output is not a terminal.
EVERY = 20.0

#: rich's global console, so that progress bars of different modules can be shown together.
console = rich.get_console()
console.soft_wrap = True


def _raise_again() -> None:
    """Re-raises the BrokenPipeError, for which rich would exit with status 1; `program.run` handles it."""
    raise


console.on_broken_pipe = _raise_again  # type: ignore[method-assign]


def say(line: str) -> None:
    """Prints a line as plain text, with control characters escaped."""
    console.print(printable(line), highlight=False, markup=False, emoji=False)


def tracked(parts: Sequence[Any], name: str) -> Iterable[Any]:
    """Yields the parts of a task, with a progress bar on a terminal, or a line every `EVERY` seconds elsewhere."""
    return track(parts, description=name, console=console) if console.is_terminal else with_lines(parts, name)


def with_lines(parts: Sequence[Any], name: str) -> Iterator[Any]:
    """Yields the parts of a task; if the output is not a terminal, prints a progress line every `EVERY` seconds."""
    last = time.monotonic()
    for number, part in enumerate(parts):
        if not console.is_terminal and time.monotonic() - last >= EVERY:
            last = time.monotonic()
            say(f"{name}: {number} of {len(parts)}")
        yield part


@contextlib.contextmanager
def busy(name: str) -> Iterator[None]:
    """A context that shows a name and the elapsed time on a terminal, for long tasks that report no progress.

    Without a terminal, it prints the name after `EVERY` seconds.
    """
    if not console.is_terminal:
        late = threading.Timer(EVERY, say, (name,))
        late.start()
        try:
            yield
        finally:
            late.cancel()
        return
    columns = TextColumn("{task.description}"), BarColumn(bar_width=BAR), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as bar:
        bar.add_task(escape(printable(name)), total=None)
        yield


@contextlib.contextmanager
def exit_on_sigterm() -> Iterator[None]:
    """A context in which SIGTERM unwinds the stack, so that a command removes its incomplete files."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def printable(text: str) -> str:
    """Escapes the control characters of a text, since a terminal would obey them."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """Returns a text as one printable line of at most `LONGEST_LINE` characters, shortened in its middle."""
    line = printable(" ".join(text.split()))
    head, tail = 2 * LONGEST_LINE // 3, LONGEST_LINE // 3 - 5
    return line if len(line) <= LONGEST_LINE else f"{line[:head]} ... {line[-tail:]}"


def fitting(parts: Sequence[tuple[int, str]], room: int) -> str:
    """Joins (rank, text) parts into a line of at most ``room`` characters.

    Parts of the lowest rank are left out first; one part always stays.
    """
    kept = list(parts)
    while len(kept) > 1 and len("  ".join(text for _, text in kept)) > room:
        kept.remove(min(kept))
    return "  ".join(text for _, text in kept)


class TrainingDisplay(Callback):
    """A callback that shows step, stage, rays/s, loss, PSNR and the remaining time in a live line.

    The line shows inside the context manager ``progress``. Without a terminal, the display prints a line if it has
    printed none for `EVERY` seconds.

    Args:
        label: Name of the run.
        quiet: Print only the live line.
    """

    group = GROUP

    def __init__(self, label: str, *, quiet: bool = False) -> None:
        self.quiet = quiet
        self.progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=BAR),
            TextColumn("{task.percentage:3.0f} %"),
            TextColumn("{task.fields[text]}", table_column=Column(no_wrap=True)),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            refresh_per_second=4,
        )
        self.task = self.progress.add_task(escape(printable(label)), total=1.0, text="")
        self.loss = math.nan  # until the first step
        self.scores: Scores | None = None
        self.told = time.monotonic()

    def following(self, scores: Scores) -> TrainingDisplay:
        """Makes the display show the PSNR of the last evaluation in ``scores``; returns the display."""
        self.scores = scores
        return self

    def after_step(self, state: State) -> None:
        """Shows the state after a step; the loss is smoothed over about the last three calls."""
        self.loss = state.loss if math.isnan(self.loss) else 0.7 * self.loss + 0.3 * state.loss
        cells = state.router.num_cells
        psnr = self.scores.metrics[-1].get("psnr") if self.scores is not None and self.scores.metrics else None
        parts = [
            *((2, f"step {state.step}"), (3, "coarse" if cells == 1 else counted(cells, "cell"))),
            (0, f"{state.rays_done / max(state.seconds, 1e-9) / 1000:.1f} k rays/s"),
            (1, f"loss {self.loss:.5f}"),
            *([] if psnr is None else [(4, f"psnr {psnr:.2f} dB")]),
        ]
        room = console.width - len(self.progress.tasks[0].description) - BESIDE
        self.progress.update(self.task, completed=state.fraction, text=fitting(parts, room))
        if not console.is_terminal and time.monotonic() - self.told >= EVERY:
            self.on_event("  ".join((f"{state.fraction:5.0%}", *(text for _, text in parts))))

    def track(self, parts: Sequence[Any], name: str) -> Iterable[Any]:
        """Yields the parts of a task during a training, with a progress bar below the training's status line."""
        task = self.progress.add_task(name, total=len(parts), text="")
        try:
            for number, part in enumerate(with_lines(parts, name)):
                self.progress.update(task, completed=number, text=f"{number} of {len(parts)}")
                yield part
        finally:
            self.progress.remove_task(task)

    def on_event(self, line: str) -> None:
        """Prints a permanent line above the live line."""
        self.told = time.monotonic()
        if not self.quiet:
            say(line)
