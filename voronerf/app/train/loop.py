"""The loop of a training, and the interface of what goes on beside it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import torch

from voronerf.app.train.start import judge_start
from voronerf.app.train.state import Stage, State
from voronerf.nerf.loss import Batch, RenderOutput
from voronerf.nerf.split import SplitDone
from voronerf.ops._core import backends
from voronerf.ops._core.checks import trusting
from voronerf.ops.adam.reference import judge

#: On a GPU, steps between two times that the host reads the loss and thereby waits for the device.
READ_EVERY = 50
#: The dtype of autocast for each precision but float32.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}


class TrainingError(RuntimeError):
    """Training cannot continue; the message gives the reason and what is left on disk."""


class Callback:
    """What goes on beside a training: scores, checkpoints, progress. It keeps its own state.

    Its time is not training time, except in :meth:`after_split`.

    Examples:
        >>> from voronerf.app.train import Callback
        >>> class Losses(Callback):
        ...     def __init__(self):
        ...         self.losses = []
        ...     def after_step(self, state):
        ...         self.losses.append(state.loss)
    """

    def on_start(self, state: State) -> None:
        """Called before the first step of this process."""

    def after_split(self, state: State, done: SplitDone) -> None:
        """Called after cells were split, before the step that follows."""

    def after_step(self, state: State) -> None:
        """Called after each step."""

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
    config, strategy, sampler, optimizer = state.config, state.strategy, state.sampler, state.optimizer
    one_thread, before = state.thread_deterministic, state.step
    # What a user's own class gives is checked in every step.
    parts = (state.ray_loss, state.batches, sampler, strategy, *(router.module for router in state.routers.values()))
    known = all(type(part).__module__.startswith("voronerf.") for part in parts)
    checked: Stage | None = None
    while state.fraction < 1 and state.seconds < until and not state.stopped:
        started = clock()
        with backends.torch_on_one_thread() if one_thread else nullcontext():
            split = strategy.step_pre_backward(optimizer, state.fraction, state.step)
            if split is not None:
                state.begin_stage(split)
                if not strategy.inherit:  # the averages are of networks that are no more
                    optimizer.drop_averages()
                for callback in callbacks:
                    callback.after_split(state, split)
            # From the second step of a stage on, all tensors have the kinds and shapes that were checked in the first.
            with trusting(known and checked is state.stages[-1]):
                batch, output = _step(state)
            checked = state.stages[-1]
        state.count_step(batch)
        if state.device.type == "cpu" or state.step % READ_EVERY == 0:
            state.read_output(output)
        judge_start(state, batch, output)
        state.add_seconds(clock() - started)
        for callback in callbacks:
            callback.after_step(state)
    if state.fraction >= 1 and state.step > before:  # once, however often this is called
        started = clock()
        with state.averaged():
            sampler.finish(state.renderer.field, config.seed)
        state.add_seconds(clock() - started)


def _step(state: State) -> tuple[Batch, RenderOutput]:
    """A step, but for splits and counters."""
    optimizer, sampler = state.optimizer, state.sampler
    autocast = HALVES.get(state.config.precision)
    optimizer.set_learning_rate(state.learning_rate())
    sampler.step_pre_backward(state.renderer.field, state.step - state.began, state.generator)
    if not state.router.training:
        state.renderer.train()
    batch = state.batches.draw(state.rays, state.draws)
    optimizer.zero_grad(set_to_none=True)
    with nullcontext() if autocast is None else torch.autocast(state.device.type, autocast, cache_enabled=False):
        output = state.ray_loss(batch, state.draws, backward=autocast is None)
    if autocast is not None:
        state.scaler.scale(output.loss).backward()
    sampler.step_post_backward(output)
    # The optimiser skips a step that is not finite by a flag on the device, so the host need not wait for it.
    if state.scaler.is_enabled():
        judge(state.guard, output.loss.detach(), [])
        state.scaler.step(optimizer)
        state.scaler.update()
    else:
        optimizer.update(state.guard, output.loss.detach())
    optimizer.after_step(state.step)
    state.strategy.step_post_backward(output)
    return batch, output


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
