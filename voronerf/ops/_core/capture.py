"""CUDA graphs: a function's work on a GPU is captured once and replayed with one launch.

This is the GPU's counterpart of :mod:`voronerf.ops._core.recording`. It replays everything that the device computes,
torch's operations included. A replay runs no Python, and the function must not synchronise host and device:
:attr:`Capture.obstacle` says where it did.

Numbers that vary from replay to replay lie in device memory (:func:`voronerf.ops._core.rows.varying`). The warm-up run
allocates this memory, because torch reuses memory allocated in a capture, and replays would overwrite the numbers. The
number of rows is fixed by the captured run.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from voronerf.ops._core.active import active

T = TypeVar("T")

#: The captures that run now, by id, and the graphs of captures that were freed meanwhile: if another graph is destroyed
#: during a capture, CUDA invalidates the capture.
_RUNNING, _FREED = set[int](), list[Any]()


class Capture:
    """A captured function on a GPU: call :meth:`record` once, then :meth:`replay` repeatedly.

    Attributes:
        obstacle: The reason why the function cannot be captured; None if it can.
        result: The result of the captured run, whose tensors each replay fills.

    Args:
        device: The GPU.
        generator: The generator of random numbers on this GPU.
        before: An earlier capture, whose memory pool this one takes over. Do not replay the earlier one again.
    """

    def __init__(self, device: torch.device, generator: torch.Generator, before: Capture | None = None) -> None:
        # A memory pool belongs to one stream, and one of its graphs must be alive until the next graph is captured.
        self._stream: torch.cuda.Stream = torch.cuda.Stream(device) if before is None else before._stream
        self._pool = None if before is None else before._graph.pool()
        self._graph: torch.cuda.CUDAGraph = torch.cuda.CUDAGraph()
        self._graph.register_generator_state(generator)
        self._device = device
        self._numbers = list[tuple[Tensor, Callable[[], float]]]()
        self._taken = 0  # the count of numbers that the capture has read
        self._rows: list[tuple[int, Callable[[], int]]] = []
        self.obstacle: str | None = None
        self.result: Any = None

    def record(self, function: Callable[[], T]) -> T:
        """Runs the function eagerly, and captures it if possible; returns the result of the eager run."""
        result = self.warm_up(function)
        if self.obstacle is None:
            self.result = self.capture(function)
        return result

    def warm_up(self, function: Callable[[], T]) -> T:
        """Runs the function eagerly, and sets ``obstacle`` if the function synchronises host and device."""
        current, mode = torch.cuda.current_stream(self._device), torch.cuda.get_sync_debug_mode()
        self._stream.wait_stream(current)
        with warnings.catch_warnings(record=True) as caught, torch.cuda.stream(self._stream):
            warnings.simplefilter("always")
            try:
                torch.cuda.set_sync_debug_mode("warn")
                active.vary = self._make_number
                result = function()
            finally:
                torch.cuda.set_sync_debug_mode(mode)
                active.vary = None
        current.wait_stream(self._stream)
        for warning in caught:
            text = str(warning.message)
            if "synchronizing CUDA operation" in text:
                self.obstacle = f"the host waits for the device, in {Path(warning.filename).name}:{warning.lineno}"
            elif "synchronizing operations" not in text:  # except torch's warning that this mode is a prototype
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        return result

    def capture(self, function: Callable[[], T]) -> T:
        """Captures the function without running its kernels. Each replay fills the tensors of the returned result."""
        _RUNNING.add(id(self))
        try:
            active.vary = self._take_number
            # Other threads, such as a viewer's, may allocate device memory during the capture.
            with torch.cuda.graph(self._graph, self._pool, self._stream, capture_error_mode="thread_local"):
                return function()
        finally:
            active.vary = None
            _RUNNING.discard(id(self))
            if not _RUNNING:
                _FREED.clear()

    def __del__(self) -> None:
        """Keeps the graph alive while another capture runs; the garbage collector may call this at any time."""
        if _RUNNING:
            _FREED.append(self._graph)

    def count(self, count: Callable[[], int]) -> int:
        """Returns the number of rows of this run; a replay with another number is refused."""
        rows = count()
        self._rows.append((rows, count))
        return rows

    def _make_number(self, value: Callable[[], float]) -> Tensor:
        """Allocates a number that varies from replay to replay, float32 []."""
        number = torch.full((), value(), dtype=torch.float32, device=self._device)
        self._numbers.append((number, value))
        return number

    def _take_number(self, _: Callable[[], float]) -> Tensor:
        """Returns the tensor that the warm-up allocated for the same number; the order of the calls identifies it."""
        self._taken += 1
        return self._numbers[self._taken - 1][0]

    def replay(self, threads: int, times: int = 1, inputs: Sequence[Tensor] = ()) -> int:
        """Launches the graph ``times`` times and returns ``times``, or 0 if the number of rows has changed.

        The signature matches `Recording.replay`; ``threads`` and ``inputs`` are not used.
        """
        if any(count() != rows for rows, count in self._rows):
            return 0
        for number, value in self._numbers:
            number.fill_(value())
        for _ in range(times):
            self._graph.replay()
        return times
