"""The loop of a training, and the interface of what goes on beside it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

from voronerf.app.train.start import judge_start, steps_to_judgement
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.split import SplitDone
from voronerf.nerf.step import StepOutput
from voronerf.ops._core import backends

#: On a GPU, steps between two times that the host reads the loss and thereby waits for the device.
READ_EVERY = 3 * GROUP
#: Seconds after which a training answers, such as to Ctrl-C, if its steps are not longer.
ANSWER = 0.3


class TrainingError(RuntimeError):
    """Training cannot continue; the message gives the reason and what is left on disk."""


class Callback:
    """What goes on beside a training: scores, checkpoints, progress. It keeps its own state.

    Its time is not training time, except in :meth:`after_split`.

    Attributes:
        group: How many steps may lie between two calls of :meth:`after_step`. Up to 16 of them are made in one call,
            which is faster. Results do not depend on it.

    Examples:
        >>> from voronerf.app.train import Callback
        >>> class Losses(Callback):
        ...     def __init__(self):
        ...         self.losses = []
        ...     def after_step(self, state):
        ...         self.losses.append(state.loss)
    """

    group: int = 1

    def on_start(self, state: State) -> None:
        """Called before the first step of this process."""

    def after_split(self, state: State, done: SplitDone) -> None:
        """Called after cells were split, before the step that follows."""

    def after_step(self, state: State) -> None:
        """Called after each step, or after up to ``group`` of them."""

    def on_end(self, state: State) -> None:
        """Called when the training has ended, or was stopped."""


def train(
    state: State,
    callbacks: Sequence[Callback] = (),
    *,
    until: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> None:
    """Trains until ``until`` training seconds, the end of the training, or ``state.stop()``, whichever comes first.

    Calls in turns let several trainings share a machine, so that its noise affects all of them alike.

    Args:
        state: What :func:`voronerf.app.train.build` made.
        callbacks: Called in their order.
        until: Training seconds.
        clock: Counts seconds.
    """
    before, one_thread = state.step, backends.torch_on_one_thread if state.thread_deterministic else nullcontext
    quick = GROUP
    state.training_step.run_within(one_thread)
    while state.fraction < 1 and state.seconds < until and not state.stopped:
        started = clock()
        with one_thread():
            prepare(state, callbacks)
        group = min((callback.group for callback in callbacks), default=GROUP)
        steps = min(state.steps_alike(), steps_to_judgement(state), group, quick)
        made = state.training_step(state.rays, steps, at=state.step - state.began)
        count(state, steps, made)
        judge_start(state, made)
        taken = clock() - started
        state.add_seconds(taken)
        quick = max(1, int(steps * ANSWER / max(taken, 1e-9)))
        for callback in callbacks:
            callback.after_step(state)
    if state.fraction >= 1 and state.step > before:  # once, however often this is called
        started = clock()
        with state.averaged():
            state.sampler.finish(state.renderer.field, state.config.seed)
        state.add_seconds(clock() - started)


def prepare(state: State, callbacks: Sequence[Callback] = (), *, patient: bool = False) -> None:
    """What comes before steps: a split that is due, the learning rate.

    Args:
        state: Between two steps.
        callbacks: Told of a split.
        patient: Whether a split waits for samples that it lacks, which is an error else.
    """
    strategy, optimizer = state.strategy, state.optimizer
    if strategy.is_due(state.fraction, state.step) and (not patient or strategy.has_samples()):
        done = strategy.step_pre_backward(optimizer, state.fraction, state.step)
        if done is not None:
            state.begin_stage(done)
            if not strategy.inherit:  # the averages are of networks that are no more
                optimizer.drop_averages()
            for callback in callbacks:
                callback.after_split(state, done)
    optimizer.set_learning_rate(state.learning_rate())
    group = state.step - (state.step - state.began) % GROUP  # its first step: the clock may cut a group anywhere
    if state.batches.unseen and state.fraction_at(group) >= state.unseen_share:
        state.batches.end_unseen()
    if not state.router.training:
        state.renderer.train()


def count(state: State, steps: int, made: StepOutput) -> None:
    """Counts steps, and reads what the last of them has found."""
    state.count_steps(steps, made.rays)
    if state.device.type == "cpu" or state.step % READ_EVERY == 0:
        state.read_output(made)


def run(state: State, callbacks: Sequence[Callback] = (), *, clock: Callable[[], float] = time.perf_counter) -> None:
    """Trains to the end, from where a state is; calls ``on_start`` before and ``on_end`` after it.

    Args:
        state: What :func:`voronerf.app.train.build` made, and ``load`` may have moved on.
        callbacks: Called in their order.
        clock: Counts seconds.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from voronerf.app.scenes import builtin_scene
        >>> from voronerf.app.train import Checkpoints, Divergence, Scores, TrainConfig, build, last_checkpoint, run
        >>> scene = builtin_scene(16, train_views=4, test_views=2)
        >>> config = TrainConfig(steps=20, cells=(4,), width=8, rays=64)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     out = Path(folder)
        ...     run(build(config, scene), [Divergence(out), Checkpoints(out), scores := Scores(out)])
        ...     kept = last_checkpoint(out)  # a Checkpoint
        >>> scores.summary["steps"], "psnr" in scores.summary, kept.values["step"]
        (20, True, 20)
    """
    for callback in callbacks:
        callback.on_start(state)
    train(state, callbacks, clock=clock)
    for callback in callbacks:
        callback.on_end(state)
