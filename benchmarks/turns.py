"""Several trainings in one process, in turns of a few seconds, so that the noise of the machine affects all alike."""

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

#: What counts as a second: wall time, or process CPU time for each thread.
CLOCKS: dict[str, Callable[[], float]] = {
    "wall": time.perf_counter,
    "cpu": lambda: time.process_time() / torch.get_num_threads(),
}


class TakesTurns(Protocol):
    """A training that can take turns, such as :class:`Training`."""

    @property
    def seconds(self) -> float:
        """Of training so far."""

    def advance(self, until: float) -> Any:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first."""


class Training:
    """A training as of `voronerf train`, in parts, which writes checkpoints only when told to and at the end.

    Args:
        config: its settings; ``out`` is the run directory.
        scene: the scene.
        clock: counts seconds.
        on_event: called with a line for what happens.
        resume: go on from the last checkpoint.
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
        """Of training so far."""
        return self.state.seconds

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first."""
        train(self.state, self.callbacks, until=until, clock=self.clock)

    def save(self) -> None:
        """Writes a checkpoint."""
        self.checkpoints.save(self.state)
        self.checkpoints.writer.wait()

    def run(self) -> dict[str, Any]:
        """Trains to the end, scores and saves; returns the summary."""
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
    """Trains all of them for the same time; the time of the callbacks does not count.

    Args:
        trainings: at any point of their run; the ones that are ahead wait for the others.
        budget: training seconds of each.
        turn: seconds until the next one has its turn.
        stops: for each the training seconds at which ``on_stop`` is called, rising.
        on_stop: called with a training and the stop that it has reached.
        after_turn: called with a training after each of its turns.
        on_failure: called with a training that failed and its error; the others go on. None: the error ends all.

    Raises:
        ConfigError: When ``turn`` is not positive.
        TrainingError, ValueError: When a training fails and there is no ``on_failure``.
    """
    if not turn > 0:
        raise ConfigError(f"--turn must be positive, got {turn}")
    trainings = list(trainings)
    # those that go on begin with a whole turn: what was due in it may have been passed, but not looked at
    done = turn * math.floor(min((training.seconds for training in trainings), default=budget) / turn)
    while done < budget:
        before, done = done, min(done + turn, budget)
        for training in list(trainings):
            # a long step may have passed a stop in the turn before: what is due in this one is looked at all the same
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
