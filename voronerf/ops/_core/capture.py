"""Work of a GPU that is captured once as a CUDA graph, and made again by one launch.

The counterpart of :mod:`voronerf.ops._core.recording`, of whatever the device computes, torch's operations included.
What the host does in Python is not made again, and the host cannot wait for the device: :attr:`Capture.obstacle` says
where it did.

What changes from run to run lies in memory, as numbers do (:func:`voronerf.ops._core.rows.varying`). That memory is of
the run before the capture: within a capture torch hands out the same memory again and again, and each replay writes all
that was ever there. The number of rows is that of the captured run.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from voronerf.ops._core.active import active

T = TypeVar("T")


class Capture:
    """The work of a function on a GPU: :meth:`warm_up`, then :meth:`capture`, then :meth:`replay` as often as wanted.

    Attributes:
        obstacle: Why it cannot be captured; None if it can.

    Args:
        device: The GPU.
        generator: Of random numbers, on it.
        before: An earlier capture, whose memory this one goes on with; it is not replayed any more.
    """

    def __init__(self, device: torch.device, generator: torch.Generator, before: Capture | None = None) -> None:
        # torch wants the stream of a pool to stay the same, and a graph of the pool to be there until the next one is.
        self._stream: torch.cuda.Stream = torch.cuda.Stream(device) if before is None else before._stream
        self._pool = None if before is None else before._graph.pool()
        self._graph: torch.cuda.CUDAGraph = torch.cuda.CUDAGraph()
        self._graph.register_generator_state(generator)
        self._device = device
        self._numbers = list[tuple[Tensor, Callable[[], float]]]()
        self._taken = 0  # of the numbers, by the capture
        self._rows: list[tuple[int, Callable[[], int]]] = []
        self.obstacle: str | None = None

    def warm_up(self, function: Callable[[], T]) -> T:
        """Calls the function, which runs as ever, and looks whether the host waits for the device in it."""
        here, mode = torch.cuda.current_stream(self._device), torch.cuda.get_sync_debug_mode()
        self._stream.wait_stream(here)
        active.vary = self._make_number
        with warnings.catch_warnings(record=True) as told, torch.cuda.stream(self._stream):
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                result = function()
            finally:
                torch.cuda.set_sync_debug_mode(mode)
                active.vary = None
        here.wait_stream(self._stream)
        for each in told:
            said = str(each.message)
            if "synchronizing CUDA operation" in said:
                self.obstacle = f"the host waits for the device, in {Path(each.filename).name}:{each.lineno}"
            elif "synchronizing operations" not in said:  # as torch says of this mode
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
        return result

    def capture(self, function: Callable[[], T]) -> T:
        """Captures the warm-up's function, which computes nothing until it is replayed; its result is the replays'."""
        active.vary = self._take_number
        try:
            # Other threads, such as a viewer's, may ask the device for memory meanwhile.
            with torch.cuda.graph(self._graph, self._pool, self._stream, capture_error_mode="thread_local"):
                return function()
        finally:
            active.vary = None

    def count(self, given: Callable[[], int]) -> int:
        """A number of rows that is known before each run; that of this one, to which replays keep."""
        rows = given()
        self._rows.append((rows, given))
        return rows

    def _make_number(self, value: Callable[[], float]) -> Tensor:
        """A number that changes from run to run, float32 []."""
        number = torch.full((), value(), dtype=torch.float32, device=self._device)
        self._numbers.append((number, value))
        return number

    def _take_number(self, _: Callable[[], float]) -> Tensor:
        """The number that the warm-up has made at this place."""
        self._taken += 1
        return self._numbers[self._taken - 1][0]

    def replay(self, threads: int, times: int = 1) -> int:
        """Makes the work again so many times, and gives how often: not at all where the rows are other ones.

        Args:
            threads: As of a recording; the device has its own.
            times: How often.
        """
        if any(given() != rows for rows, given in self._rows):
            return 0
        for number, value in self._numbers:
            number.fill_(value())
        for _ in range(times):
            self._graph.replay()
        return times
