"""A part of a training step that is recorded by itself, since the host computes something between it and the next."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.recording import Recording

#: After a recording that no call has replayed, the next 1, 2, 4, ... calls run as they are, so many at most.
LONGEST_WAIT = 64


class Made(NamedTuple):
    """What a part has given, until its next call.

    Attributes:
        value: Of the call that was recorded, or of this one.
        recording: Of that call; None where this one ran as it is.
    """

    value: Any
    recording: Recording | None = None

    def now(self, value: Any) -> Any:
        """The value or a part of it, with as many rows as this call has filled."""
        return value if self.recording is None else self.recording.now(value)


class Part:
    """A function that is recorded when it is first called; later calls make its compiled calls again.

    Attributes:
        replayed: Whether the last call was.
    """

    def __init__(self) -> None:
        self.replayed = False
        self._recording: Recording | None = None
        self._value: Any = None
        self._read, self._rows = list[Any](), list[int]()
        self._wait = self._left = 0

    @property
    def recorded(self) -> bool:
        """Whether later calls can be replayed."""
        return self._recording is not None

    def __call__(
        self,
        function: Callable[..., Any],
        made: Sequence[Made] = (),
        tensors: Sequence[Tensor] = (),
        rows: Sequence[int] = (),
    ) -> Made:
        """The result of ``function(*values, *tensors)``.

        Args:
            function: Does the same in each call, but for its arguments.
            made: What it reads of other parts, whose memory stays.
            tensors: What it reads else, which is copied.
            rows: Numbers of rows that these have, and that change from call to call.
        """
        self._rows[:] = rows
        recording = self._recording
        if recording is not None and len(made) == len(self._read):
            same = all(each.value is value for each, value in zip(made, self._read))
            if same and recording.replay(backends.threads(), taken=tensors):
                self.replayed, self._wait, self._left = True, 0, 0
                return Made(self._value, recording)
        self.replayed, values = False, [each.now(each.value) for each in made]
        if self._left or any(each.recording is None for each in made):
            self._left = max(0, self._left - 1)
            return Made(function(*values, *tensors))
        self._left, self._wait = self._wait, min(2 * self._wait or 1, LONGEST_WAIT)
        with Recording() as recording:
            for place in range(len(rows)):
                recording.count(functools.partial(self._rows.__getitem__, place))
            value = function(*values, *map(recording.take, tensors))
        if recording.obstacle is not None:
            return Made(value)
        self._recording, self._value, self._read = recording, value, [each.value for each in made]
        return Made(value, recording)
