"""Runs several trainings in one process, in turns of a few seconds, so that machine noise affects all alike."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

import torch

from voronerf.app.scenes import Scene
from voronerf.app.train import (
    Callback,
    Checkpoints,
    ConfigError,
    Divergence,
    Scores,
    TrainConfig,
    TrainingError,
    build,
    last_checkpoint,
    load,
    train,
)

#: Clocks of the training time: wall time, or process CPU time divided by the number of threads.
CLOCKS: dict[str, Callable[[], float]] = {
    "wall": time.perf_counter,
    "cpu": lambda: time.process_time() / torch.get_num_threads(),
}


class TakesTurns(Protocol):
    """A training that can take turns, such as :class:`Training`."""

    @property
    def seconds(self) -> float:
        """The training seconds so far."""

    def advance(self, until: float) -> Any:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first."""


class Training:
    """A training of `voronerf train` that runs in turns; it writes checkpoints at the end and on :meth:`save`.

    Args:
        config: The settings; ``out`` is the run directory.
        scene: The scene.
        clock: A function that returns the time in seconds.
        on_event: A function that is called with a line of text for each event.
        resume: Whether to continue from the last checkpoint.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        *,
        clock: Callable[[], float] = time.perf_counter,
        on_event: Callable[[str], None] | None = None,
        resume: bool = False,
    ) -> None:
        if config.out is None:
            raise ValueError("Training: config.out must name the run directory, got None")
        self.out, self.clock = config.out, clock
        self.state = build(config, scene, on_event=on_event)
        if resume:
            load(self.state, last_checkpoint(self.out))
        self.scores, self.checkpoints = Scores(self.out, clock=clock), Checkpoints(self.out, math.inf)
        self.callbacks: list[Callback] = [Divergence(self.out), self.checkpoints, self.scores]
        for callback in self.callbacks:
            callback.on_start(self.state)

    @property
    def seconds(self) -> float:
        """The training seconds so far."""
        return self.state.seconds

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first."""
        train(self.state, self.callbacks, until=until, clock=self.clock)

    def save(self) -> None:
        """Writes a checkpoint."""
        self.checkpoints.save(self.state)
        self.checkpoints.writer.wait()

    def run(self) -> dict[str, Any]:
        """Trains to the end, evaluates and saves; returns the summary."""
        self.advance()
        for callback in self.callbacks:
            callback.on_end(self.state)
        return self.scores.summary


T = TypeVar("T", bound=TakesTurns)


def take_turns(
    trainings: Iterable[T],
    *,
    budget: float,
    turn: float,
    stops: Callable[[T], Sequence[float]] = lambda training: (),
    on_stop: Callable[[T, float], None] = lambda training, second: None,
    after_turn: Callable[[T], None] = lambda training: None,
    on_failure: Callable[[T, Exception], None] | None = None,
) -> None:
    """Trains all trainings for the same time; the time of the callbacks does not count.

    Args:
        trainings: The trainings, at any point of their run; trainings that are ahead wait for the rest.
        budget: Training seconds of each training.
        turn: Seconds of a turn.
        stops: A function that returns the training seconds at which ``on_stop`` is called, in rising order.
        on_stop: A function that is called with a training and the stop that it has reached.
        after_turn: A function that is called with a training after each of its turns.
        on_failure: A function that is called with a failed training and its error; the other trainings continue.
            None: the error ends all trainings.

    Raises:
        ConfigError: When ``turn`` is not positive.
        TrainingError, ValueError: When a training fails and there is no ``on_failure``.
    """
    if not turn > 0:
        raise ConfigError(f"--turn must be positive, got {turn}")
    trainings = list(trainings)
    # Begin at the start of the current turn: a resumed training may have passed stops of this turn without a call of
    # on_stop.
    done = turn * math.floor(min((training.seconds for training in trainings), default=budget) / turn)
    while done < budget:
        before, done = done, min(done + turn, budget)
        for training in list(trainings):
            # The previous turn's last step may have passed a stop of this turn. on_stop is still called for the stop.
            due = [second for second in stops(training) if before < second <= done]
            if training.seconds >= done and not due:
                continue
            try:
                for stop in due:
                    training.advance(stop)
                    on_stop(training, stop)
                training.advance(done)
            except (TrainingError, ValueError) as error:
                if on_failure is None:
                    raise
                trainings.remove(training)
                on_failure(training, error)
                continue
            after_turn(training)
