"""The training loop, and the interface of its callbacks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

from voronerf.app.train.build import view_rays
from voronerf.app.train.start import judge_start, steps_to_judgement
from voronerf.app.train.state import State
from voronerf.nerf.samplers import Occupancy
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.split import SplitDone
from voronerf.nerf.step import StepOutput
from voronerf.ops._core import backends

#: On a GPU, number of steps between two reads of the loss; for each read, the host waits for the device.
READ_EVERY = 3 * GROUP
#: Floaters are dropped after a training with at least `FLOATER_VIEWS` views and `FLOATER_STEPS` steps, by rays through
#: at most `FLOATER_RAYS` pixels along the longer side of each view. With few views, few cameras see the same surface;
#: after few steps, there is fog but no floater.
FLOATER_VIEWS, FLOATER_STEPS, FLOATER_RAYS = 36, 1000, 96
#: Target duration of a group of steps in seconds, so that a training reacts quickly, for example to Ctrl-C.
ANSWER = 0.3


class TrainingError(RuntimeError):
    """A training cannot continue; the message gives the reason and the state of the last checkpoint."""


class Callback:
    """A callback of a training, such as for scores, checkpoints or progress. It keeps its own state.

    The time of a callback is not training time, except in :meth:`after_split`.

    Attributes:
        group: The maximum number of steps between two calls of :meth:`after_step`. Up to 16 steps are made in one call,
            which is faster. Results do not depend on ``group``.

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
        """Called after a split of cells, before the next step."""

    def after_step(self, state: State) -> None:
        """Called after each group of at most ``group`` steps."""

    def on_end(self, state: State) -> None:
        """Called when the training has ended or was stopped."""


def train(
    state: State,
    callbacks: Sequence[Callback] = (),
    *,
    until: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> None:
    """Trains until ``until`` training seconds, the end of the training, or ``state.stop()``, whichever comes first.

    Alternating calls for several trainings on one machine expose all of them to the same timing noise.

    Args:
        state: The state of the training, from :func:`voronerf.app.train.build`.
        callbacks: The callbacks, called in their order.
        until: Training seconds at which to return.
        clock: Function that returns the time in seconds.
    """
    scene, first_step = state.scene, state.step
    one_thread = backends.torch_on_one_thread if state.thread_deterministic else nullcontext
    quick_steps = GROUP
    state.training_step.run_within(one_thread)
    if state.sampler.grid is not None:
        state.sampler.grid.merge(state.ranks)
    while True:
        group = min((callback.group for callback in callbacks), default=GROUP)
        goes_on = state.fraction < 1 and state.seconds < until and not state.stopped
        most = state.agree(min(group, quick_steps) if goes_on else 0)
        if not most:
            break
        started = clock()
        with one_thread():
            prepare(state, callbacks)
        steps = min(state.steps_per_update(), steps_to_judgement(state), most)
        output = state.training_step(state.rays, steps, at=state.step - state.began)
        count(state, steps, output)
        judge_start(state, output)
        elapsed = clock() - started
        state.add_seconds(elapsed)
        quick_steps = max(1, int(steps * ANSWER / max(elapsed, 1e-9)))
        for callback in callbacks:
            callback.after_step(state)
    if state.fraction >= 1 and state.step > first_step:  # only once, in the call that ends the training
        started = clock()
        if state.sampler.grid is not None:
            state.sampler.grid.merge(state.ranks)
        with state.averaged():
            state.sampler.finish(state.renderer.field, state.config.seed)
            has_views = len(scene.train) >= FLOATER_VIEWS and scene.region is None
            if has_views and state.step >= FLOATER_STEPS and isinstance(state.sampler, Occupancy):
                rays = view_rays(scene, FLOATER_RAYS, state.device)
                state.sampler.drop_floaters(state.renderer.field, rays, near=scene.near, far=scene.far)
        state.add_seconds(clock() - started)


def prepare(state: State, callbacks: Sequence[Callback] = ()) -> None:
    """Prepares the next steps: makes a split that is due, and sets the learning rate.

    Args:
        state: The state between two steps.
        callbacks: The callbacks to call after a split.
    """
    strategy, optimizer = state.strategy, state.optimizer
    if strategy.is_due(state.fraction, state.step):
        done = strategy.step_pre_backward(optimizer, state.fraction, state.step)
        if done is not None:
            state.begin_stage(done)
            for callback in callbacks:
                callback.after_split(state, done)
    optimizer.set_learning_rate(state.learning_rate(), decay=state.relative_length)
    group = state.step - (state.step - state.began) % GROUP  # first step of the group, which may be cut short
    if state.batches.unseen and state.fraction_at(group) >= state.unseen_share:
        state.batches.stop_unseen_rays()
    if not state.router.training:
        state.renderer.train()


def count(state: State, steps: int, output: StepOutput) -> None:
    """Counts steps, and reads the output of the last step; on a GPU, reads it only every `READ_EVERY` steps."""
    state.count_steps(steps, output.rays)
    if state.device.type == "cpu" or (state.step - state.began) % READ_EVERY == 0:
        state.read_output(output)


def run(state: State, callbacks: Sequence[Callback] = (), *, clock: Callable[[], float] = time.perf_counter) -> None:
    """Trains from a state to the end; calls ``on_start`` before and ``on_end`` after the training.

    Args:
        state: The state of the training, from :func:`voronerf.app.train.build`, and perhaps restored by ``load``.
        callbacks: The callbacks, called in their order.
        clock: Function that returns the time in seconds.

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
