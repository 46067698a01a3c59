"""A training step: a list of stages, whose ops are recorded once and replayed in later steps.

r rays, m samples of all rays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.nerf import schedule
from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RaySource
from voronerf.nerf.distributed import ALONE, Ranks
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.replay import Replay, Stage, in_python
from voronerf.nerf.split import Strategy
from voronerf.nerf.volume import Batch, RenderOutput
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops._core.active import active
from voronerf.ops._core.recording import Recording


class StepOutput:
    """The result of a step; valid until the next step of the same object.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, StepOutput, Stratified
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> batch = Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3))
        >>> made = StepOutput(batch, RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)))(batch))
        >>> made.rays, made.samples, made.loss.requires_grad
        (5, 40, False)
    """

    def __init__(self, batch: Batch, output: RenderOutput, recording: Recording | None = None) -> None:
        self._batch, self._output = batch, output
        self._now: Callable[[Any], Any] = (lambda held: held) if recording is None else recording.now

    @property
    def loss(self) -> Tensor:
        """The loss [], without gradients."""
        return self._output.loss.detach()

    @property
    def rays(self) -> int:
        """The number of rays."""
        return len(self._now(self._batch.rays.origins))

    @property
    def samples(self) -> int:
        """The number of samples of all rays; reading it makes the host wait for the device."""
        rows = self._output.samples.rows
        return len(self._now(self._output.weights)) if rows is None else int(rows)

    @property
    def batch(self) -> Batch:
        """The batch of rays."""
        return cast(Batch, self._now(self._batch))

    @property
    def output(self) -> RenderOutput:
        """The result of :class:`RayLoss`; later steps may overwrite its tensors."""
        return cast(RenderOutput, self._now(self._output))


class TrainingStep:
    """A training step: draws rays, computes loss and gradients, updates networks, sampler and split strategy.

    The first step records its calls of the compiled module, and later steps replay them, several steps in one call. No
    Python runs in between, and threads are woken once per call. The results are bit-identical to eager steps.

    A user's hook of a `Sampler`, a `Strategy`, a source of rays or a term of the loss is called in each step, between
    two replayed segments; see `replayed`. If the hook changes other objects, the rest of the step runs eagerly with the
    changes, and the next step is recorded again. A step must not be called within its own hooks. On CUDA, a step
    without such hooks is captured in a CUDA graph after a warm-up step; a new number of rays needs a new capture.

    A step that cannot be replayed runs eagerly; :meth:`explain` tells why. One reason is a parameter that needs a
    gradient but belongs to another optimiser. Changed attributes of the arguments are detected, and so is a tensor that
    moves to other memory (``x.data = y``). After other changes inside an object, call :meth:`forget`. A copy of a step
    has recordings of its own; a shallow copy trains the same networks.

    Args:
        batches: The source of rays: `RayBatches`, or another :class:`RaySource`.
        loss: The loss, which holds the renderer with the sampler.
        optimizer: The optimiser of all networks. Learning rates may change from step to step.
        strategy: The strategy that collects samples for splits; None for none.
        guard: NaN guard, which skips steps that are not finite; None for no guard.
        generator: Random generator of the step.
        autocast: The dtype of the networks under autocast; None for float32. With autocast, a step is captured on CUDA,
            and runs eagerly on the CPU.
        scaler: GradScaler for float16, which prevents the capture of a step; None for no scaler.
        ranks: The processes of a data-parallel training, which average their gradients. With several processes, the
            attribute ``ranks`` of ``batches`` and ``strategy`` is set, too, and calls need ``at``: after each `GROUP`
            of steps, the grids of the processes are merged.

    Examples:
        >>> import torch
        >>> from voronerf import HashGridField, OccupancyGrid, VoronoiRouter
        >>> from voronerf.nerf import Adam, Occupancy, RayBatches, RayLoss, Renderer, TrainingStep, orbit_cameras
        >>> box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
        >>> cameras = orbit_cameras(2, radius=2.0, elevation=0.0, width=8, height=8, focal=8.0)
        >>> batches = RayBatches(cameras, torch.zeros(2, 8, 8, 3, dtype=torch.uint8), near=1.0, far=3.0, box=box)
        >>> router = VoronoiRouter(HashGridField(), torch.zeros(1, 3), share=["features"])
        >>> sampler = Occupancy(OccupancyGrid.for_training(box, 16), 16)
        >>> loss, optimizer = RayLoss(Renderer({"field": router}, sampler)), Adam.of({"field": router}, lr=0.01)
        >>> step = TrainingStep(batches, loss, optimizer, generator=torch.Generator().manual_seed(0))
        >>> first, last = float(step(rays=32).loss), float(step(rays=32, steps=20).loss)
        >>> last < first
        True
        >>> print(step.explain())
        step: recorded and replayed, 10 calls
    """

    def __init__(
        self,
        batches: RaySource,
        loss: RayLoss,
        optimizer: Adam,
        *,
        strategy: Strategy | None = None,
        guard: Guard | None = None,
        generator: torch.Generator,
        autocast: torch.dtype | None = None,
        scaler: torch.amp.GradScaler | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.batches, self.loss, self.optimizer, self.strategy, self.guard = batches, loss, optimizer, strategy, guard
        self.generator, self.autocast, self.scaler, self.ranks = generator, autocast, scaler, ranks
        for part in (batches, strategy):
            if ranks.size > 1 and part is not None:
                part.ranks = ranks  # type: ignore[union-attr]
        self.run_within(nullcontext)
        self._start_anew()

    def _start_anew(self) -> None:
        self._is_running, self._done = False, 0  # `_done`: the steps done before, for the hooks before and after a step
        obstacle = lambda: self._standing_obstacle()  # noqa: E731
        self._step = Replay(self._stages, obstacle, within=lambda: self._context(), gpu=self._gpu)
        hooks_obstacle = lambda: "it runs on a GPU" if self._on_gpu() else obstacle()  # noqa: E731
        self._before, self._after = Replay(self._before_step, hooks_obstacle), Replay(self._after_step, hooks_obstacle)

    def __getstate__(self) -> dict[str, Any]:
        """Returns the attributes without recordings, which a copy makes for itself."""
        blank = object.__new__(type(self))
        blank._start_anew()
        return {name: value for name, value in vars(self).items() if name not in vars(blank)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._start_anew()

    def run_within(self, context: Callable[[], AbstractContextManager[None]]) -> None:
        """Sets the context manager in which steps, or parts of them, run if they are not replayed.

        Args:
            context: Function that returns a new context manager for each step or part.
        """
        self._context = context

    def forget(self) -> None:
        """Drops all recordings, so the next step is recorded again; the rest of a running step runs eagerly."""
        for replay in (self._step, self._before, self._after):
            replay.forget()

    def explain(self) -> str:
        """Describes whether steps are replayed or why they are not, and lists the hooks that run in Python."""
        return "step: " + self._step.explain(self._before, self._after)

    def __call__(self, rays: int, steps: int = 1, *, at: int | None = None) -> StepOutput:
        """Runs steps in a row, with the same learning rate.

        Args:
            rays: The number of rays of each step.
            steps: The number of steps, at least 1.
            at: The number of steps done before. This method then also calls two hooks. It calls the sampler's
                ``step_pre_backward`` before each step if there are user hooks, else before each series of steps, which
                ends after ``steps_per_update`` steps or at a multiple of `GROUP`. It calls the optimiser's
                ``after_step`` after each multiple of `GROUP` steps. Both hooks are recorded, except a hook that must
                run in Python (see `replayed`). None if the training loop calls both hooks itself.

        Returns:
            The result of the last step.

        Raises:
            ValueError: ``steps`` is below 1.
        """
        if steps < 1:
            raise ValueError(f"TrainingStep: steps must be >= 1, got {steps}")
        if self._is_running:
            raise RuntimeError(
                "TrainingStep: a step must not be called while it runs, by one of its hooks or in another thread"
            )
        try:
            self._is_running, done = True, 0
            while done < steps:
                count = steps - done if at is None else min(steps - done, self._prepare(at + done))
                results = self._step({"rays": rays}, count)
                done += results.times
                if at is not None:
                    self._finish(at + done)
            return StepOutput(results.value["batch"], results.value["output"], results.recording)
        finally:
            self._is_running = False

    def _prepare(self, at: int) -> int:
        """Updates the sampler after ``at`` steps; returns the number of next steps for which this update suffices."""
        sampler, self._done = self.loss.renderer.sampler, at
        if sampler.evaluates_at(at):
            self._before({})
        else:
            self._pre_backward()
        until_update = 1 if in_python(sampler, "step_pre_backward") else sampler.steps_per_update(at)
        return min(schedule.GROUP - at % schedule.GROUP, until_update)

    def _finish(self, at: int) -> None:
        """Counts steps; after each `GROUP`, calls the optimiser's ``after_step`` and merges the grids of all ranks."""
        self.optimizer.steps_done = self._done = at
        if at % schedule.GROUP == 0:
            self._after({})
            if (grid := self.loss.renderer.sampler.grid) is not None:
                grid.merge(self.ranks)

    # Stages -----------------------------------------------------------------------------------------------------------

    def _stages(self) -> list[Stage]:
        """Returns the stages of a step."""
        loss, generator, backward = self.loss, self.generator, self.autocast is None
        draw = Stage.of_hook(self.batches, "draw", "fetch", function=self._draw, reads=("rays",))
        stages = loss.stages(generator, backward)
        if in_python(loss, "__call__"):
            stages = [Stage("loss", lambda batch: {"output": loss(batch, generator, backward=backward)}, ("batch",))]
        if self.autocast is not None:
            stages = [stage._replace(function=self._in_precision()(stage.function)) for stage in stages]
        *evaluate, learn = stages
        clear = Stage("clear", self.optimizer.zero_grad)
        gradients = Stage("backward", self._backward, ("output",), self._uses, restore=_set_gradients)
        average = Stage("average", self._average, ("output", "gradients"), python=not self._on_gpu())
        update = Stage("update", self._update, ("output",), self._uses)
        hook = "step_post_backward"
        parts = [part for part in (loss.renderer.sampler, self.strategy) if part is not None]
        post = (Stage.of_hook(part, hook, function=getattr(part, hook), reads=("output",)) for part in parts)
        averaging = [average] if self.ranks.size > 1 else []
        return [draw, *evaluate, clear, learn, gradients, *averaging, update, *post]

    def _before_step(self) -> list[Stage]:
        sampler = self.loss.renderer.sampler
        stage = Stage.of_hook(sampler, "step_pre_backward", function=self._pre_backward, reads=())
        return [stage._replace(uses=self._uses)]

    def _after_step(self) -> list[Stage]:
        return [Stage("after_step", lambda: self.optimizer.after_step(self._done), (), self._uses)]

    def _uses(self) -> Iterable[Any]:
        return self, self.optimizer, self.guard, *self.loss.uses()

    def note_dependencies(self, noted: Any) -> tuple[Any, ...]:
        """Notes attributes whose change makes a step be recorded again.

        See `voronerf.nerf.replay.Stage`.
        """
        names = "batches", "loss", "optimizer", "strategy", "guard", "generator", "autocast", "scaler", "ranks"
        noted.entries(vars(self), names)
        return ()

    def _draw(self, rays: int) -> dict[str, Any]:
        return {"batch": self.batches.draw(rays, self.generator)}

    def _pre_backward(self) -> None:
        renderer = self.loss.renderer
        renderer.sampler.step_pre_backward(renderer.field, self._done, self.generator)

    def _backward(self, output: RenderOutput) -> dict[str, Any]:
        """Returns the parameters with their gradients, which replays write.

        Under autocast, the backward pass runs here, outside the context.
        """
        loss = output.loss
        if self.autocast is not None:
            (loss if self._scaler is None else self._scaler.scale(loss)).backward()
            # If the autograd graph stayed alive, the next step's gradients would use the stream of this step, but a
            # capture may only wait for its own stream.
            loss = loss.detach()
        gradients = [(p, p.grad) for group in self.optimizer.param_groups for p in group["params"]]
        if active.recording is not None:
            for _, gradient in gradients:
                if gradient is not None:
                    active.recording.hold(gradient)
        return {"output": output._replace(loss=loss), "gradients": gradients}

    def _average(self, output: RenderOutput, gradients: list[tuple[Tensor, Tensor | None]]) -> None:
        """Averages gradients and the loss over the ranks, so that the guard judges equally on all of them."""
        present = [gradient for _, gradient in gradients if gradient is not None]
        self.ranks.average([output.loss.detach(), *present])

    def _update(self, output: RenderOutput) -> None:
        """Updates the parameters."""
        loss, guard, scaler = output.loss, self.guard, self._scaler
        if scaler is None:
            self.optimizer.update(guard, None if guard is None else loss)
        else:
            if guard is not None:
                guard.judge(loss, [])
            # A flag on the device makes the optimiser skip a step that is not finite, so the host need not wait.
            scaler.step(self.optimizer)
            scaler.update()

    @property
    def _scaler(self) -> torch.amp.GradScaler | None:
        """The GradScaler that scales the loss; None without autocast or an enabled scaler."""
        used = self.autocast is not None and self.scaler is not None and self.scaler.is_enabled()
        return self.scaler if used else None

    def _in_precision(self) -> Any:
        """Returns an autocast context without a weight cache, since a captured graph would outlive the cache."""
        if self.autocast is None:
            return nullcontext()
        return torch.autocast(self.batches.device.type, self.autocast, cache_enabled=False)

    # Replay -----------------------------------------------------------------------------------------------------------

    def _on_gpu(self) -> bool:
        return self.batches.device.type == "cuda"

    def _gpu(self) -> tuple[torch.device, torch.Generator] | None:
        """Returns the device and the generator of a capture; None on the CPU."""
        return (getattr(self.batches, "place", self.batches.device), self.generator) if self._on_gpu() else None

    def _standing_obstacle(self) -> str | None:
        """Returns the reason why no step can be replayed, or None; other obstacles may appear in the recording."""
        renderer, device = self.loss.renderer, self.batches.device
        place = getattr(self.batches, "place", device)
        if device.type not in ("cpu", "cuda"):
            return f"it runs on {device.type}"
        if device.type != place.type or device.index not in (None, place.index):
            return f"its pictures are on {place}"
        if self.generator.device.type != device.type:
            return f"its random numbers are drawn on {self.generator.device.type}"
        if (chosen := backends.chosen("adam", device, torch.float32, backend=renderer.backend)) != "native":
            return f"it runs on the {chosen} backend"
        if self.autocast is not None and not self._on_gpu():
            return "it runs under autocast"
        if self._scaler is not None:
            return "a GradScaler scales its loss"
        parts = [self.loss, renderer, self.optimizer, renderer.sampler.grid]
        if self.strategy is not None and not in_python(self.strategy, "step_post_backward"):
            parts.append(getattr(self.strategy, "reservoir", None))
        for part in parts:
            if part is not None and in_python(part):
                return f"{type(part).__name__} may run Python code that a recording does not see"
        with self._in_precision():  # under autocast a traced field has no program
            reason = self.loss.why_not_fused()
        if reason is not None:
            return reason
        if self._on_gpu() and any(stage.python for stage in (*self._stages(), *self._before_step())):
            return "it calls a Python hook, which a CUDA graph cannot replay"
        learning = {id(p) for group in self.optimizer.param_groups for p in group["params"]}
        for name, parameter in cast(nn.Module, renderer.field).named_parameters():
            if parameter.requires_grad and id(parameter) not in learning:  # another optimiser reads its gradient
                return f"{name} needs a gradient but is not in the optimizer"
            if self._on_gpu() and (parameter._backward_hooks or parameter._post_accumulate_grad_hooks):
                return f"a hook of {name} runs in Python, which a CUDA graph cannot replay"
        return None


def _set_gradients(results: Mapping[str, Any]) -> None:
    """Points ``grad`` of all parameters to the memory that replays write.

    Eager steps or the loop may have set ``grad`` to other tensors.
    """
    for parameter, gradient in results["gradients"]:
        if parameter.grad is not gradient:
            parameter.grad = gradient
