"""A training step: a sequence of stages, whose ops are recorded once and replayed in later steps.

r rays, m samples of all rays.
"""

from __future__ import annotations

import functools
import itertools
import operator
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.nerf import schedule
from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RaySource
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.radiance import Radiance
from voronerf.nerf.segment import (
    MAX_BACKOFF,
    Segment,
    SegmentResult,
    Stage,
    in_python,
    note_attributes,
    noting_reads,
    run_stages,
)
from voronerf.nerf.split import Strategy
from voronerf.nerf.volume import Batch, RenderOutput
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops._core.active import active
from voronerf.ops._core.capture import Capture
from voronerf.ops._core.custom_op import has_listeners
from voronerf.ops._core.recording import Recording
from voronerf.ops._core.unchanged import Stale, unchanged
from voronerf.router.layout import tensors_of

_ATTRIBUTES = ("batches", "loss", "optimizer", "strategy", "guard", "generator", "autocast", "scaler")
_HOOKS = ("_backward_hooks", "_post_accumulate_grad_hooks")  # attributes of parameters


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
        self._batch, self._output, self._recording = batch, output, recording

    @property
    def loss(self) -> Tensor:
        """The loss [], without gradients."""
        return self._output.loss.detach()

    @property
    def rays(self) -> int:
        """The number of rays."""
        return len(self._batch.rays if self._recording is None else self._recording.now(self._batch.rays.origins))

    @property
    def samples(self) -> int:
        """The number of samples of all rays; reading it makes the host wait for the device."""
        rows, weights = self._output.samples.rows, self._output.weights
        if self._recording is not None:
            weights = self._recording.now(weights)
        return len(weights) if rows is None else int(rows)

    @property
    def batch(self) -> Batch:
        """The batch of rays."""
        return self._batch if self._recording is None else cast(Batch, self._recording.now(self._batch))

    @property
    def output(self) -> RenderOutput:
        """The result of :class:`RayLoss`; later steps may overwrite its tensors."""
        return self._output if self._recording is None else cast(RenderOutput, self._recording.now(self._output))


class TrainingStep:
    """A training step: draws rays, computes loss and gradients, updates networks, sampler and split strategy.

    The first step records its calls of the compiled module, and later steps replay them, several steps in one call. No
    Python runs in between, and threads are woken once per call. The results are bit-identical to eager steps.

    A user's hook of a `Sampler`, a `Strategy`, a source of rays or a term of the loss is called in each step, between
    two replayed segments; see `replayed`. If the hook changes other objects, the rest of the step runs eagerly with the
    changes, and the next step is recorded again. A step must not be called within its own hooks. On CUDA, a step
    without such hooks is captured in a CUDA graph after a warm-up step; a new number of rays needs a new capture.

    A step that cannot be replayed runs eagerly; :meth:`explain` tells why. One reason is a parameter that needs a
    gradient but belongs to another optimiser. Changed attributes of the objects are detected, and so is a tensor that
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
    ) -> None:
        self.batches, self.loss, self.optimizer, self.strategy, self.guard = batches, loss, optimizer, strategy, guard
        self.generator, self.autocast, self.scaler = generator, autocast, scaler
        self.run_within(nullcontext)
        self._start_anew()

    def _start_anew(self) -> None:
        self._segments, self._is_running = dict[str, Segment](), False
        self._rays = self._backoff = self._eager_steps = 0  # for captures, as in `Segment`
        self._forget()

    def __getstate__(self) -> dict[str, Any]:
        """Returns the attributes without recordings, which a copy makes for itself."""
        blank = object.__new__(type(self))
        blank._start_anew()
        return {name: value for name, value in vars(self).items() if name not in vars(blank)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._start_anew()

    def run_within(self, context: Callable[[], AbstractContextManager[None]]) -> None:
        """Sets the context manager in which steps and stages run if they are not replayed.

        Args:
            context: Function that returns a new context manager for each step or stage.
        """
        self._context = context

    def forget(self) -> None:
        """Drops all recordings, so the next step is recorded again; the rest of a running step runs eagerly."""
        self._dependencies: Any = Stale()
        if not self._is_running:
            self._forget()

    def _forget(self) -> None:
        for segment in self._segments.values():
            segment.forget()
        self._capture: Capture | None = None
        self._captured: Any = None  # batch and output of the captured step
        self._groups = list[tuple[bool, str, list[Stage]]]()  # (whether in Python, name, stages)
        self._draws = True  # whether the stages draw the batch
        self._last = SegmentResult({})
        self._spent = dict[str, tuple[float, int]]()  # seconds and calls of each Python hook
        self._gradients = list[tuple[nn.Parameter, Tensor | None]]()  # a captured step writes to this memory
        self._dependencies = Stale()
        self._reads = list[tuple[Any, set[str]]]()  # objects, and the names of the attributes that segments read
        self._radiance: Radiance | None = None
        self._obstacle = ""

    def explain(self) -> str:
        """Describes whether steps are replayed or why they are not, and lists the hooks that run in Python."""
        if self._capture is not None:
            return "step: captured and replayed as a CUDA graph"
        segments = [each for name, each in self._segments.items() if name not in ("before", "after")]
        obstacle = self._obstacle or self._standing_obstacle()
        obstacle = obstacle or next((each.obstacle for each in segments if each.obstacle), "")
        recorded = [each.recording for each in segments if each.recording is not None]
        if obstacle and not recorded:
            return f"step: runs eagerly, since {obstacle}"
        if not obstacle and (eager := max((self._eager_steps, *(each.eager_calls for each in segments)))):
            steps = f"{eager} more step{'s' * (eager > 1)}"
            return f"step: runs eagerly for {steps}, since the last recordings could not be replayed"
        if not recorded or not self._dependencies.holds():
            return f"step: will be recorded{' again, since something that it reads has changed' * bool(recorded)}"
        calls, several = sum(map(len, recorded)), f" in {len(recorded)} segments" if len(recorded) > 1 else ""
        lines = [f"step: recorded and replayed, {calls} calls{several}"]
        others = [each.obstacle for each in self._segments.values() if each.obstacle]
        lines += [f"another segment runs eagerly, since {each}" for each in others]
        spent = self._spent.items()
        lines += [f"in Python: {name}, {1e3 * seconds / calls:.3f} ms a call" for name, (seconds, calls) in spent]
        return "\n".join(lines)

    def __call__(self, rays: int, steps: int = 1, *, at: int | None = None) -> StepOutput:
        """Runs steps in a row, with the same learning rate.

        Args:
            rays: The number of rays of each step.
            steps: The number of steps, at least 1.
            at: The number of steps done before. This method then also calls two hooks. It calls the sampler's
                ``step_pre_backward`` before each step if there are user hooks, else before each run of steps; a run
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
        if at is None:
            return self._run_steps(rays, steps)
        sampler, end = self.loss.renderer.sampler, at + steps
        while at < end:
            until_update = 1 if self._calls_hooks() else sampler.steps_per_update(at)
            count = min(end - at, schedule.GROUP - at % schedule.GROUP, until_update)
            pre_backward = self._pre_backward(at)
            if sampler.evaluates_at(at) and not in_python(sampler, "step_pre_backward"):
                self._run_or_replay_hook("before", pre_backward)
            else:
                pre_backward()
            output = self._run_steps(rays, count)
            at += count
            self.optimizer.steps_done = at
            if at % schedule.GROUP == 0:
                self._run_or_replay_hook("after", functools.partial(self.optimizer.after_step, at))
        return output

    # Stages of a step -------------------------------------------------------------------------------------------------

    def _stages(self, field: Radiance) -> list[Stage]:
        """Returns the stages of a step whose networks, loss and gradients are fused."""
        clear = Stage("clear", functools.partial(self.optimizer.zero_grad, set_to_none=True))
        update = Stage("update", self._update_and_hold, ("output",))
        *evaluate, learn = self.loss.stages(field, self.generator, True, lambda value: self._last.now(value))
        return [self._draw_stage(), *evaluate, clear, learn, update, *self._post_backward_stages()]

    def _post_backward_stages(self) -> Iterator[Stage]:
        """Yields the stages that update sampler and split strategy."""
        for part in (self.loss.renderer.sampler, self.strategy):
            if part is not None:
                python, name = in_python(part, "step_post_backward"), f"{type(part).__name__}.step_post_backward"
                yield Stage(name, part.step_post_backward, ("output",), python)

    def _draw_stage(self) -> Stage:
        return Stage(f"{type(self.batches).__name__}.draw", self._draw, ("rays",))

    def _draw(self, rays: int) -> dict[str, Any]:
        return {"batch": self.batches.draw(rays, self.generator)}

    def _draws_in_python(self) -> bool:
        return in_python(self.batches, "draw") or getattr(self.batches, "fetch", None) is not None

    def _update(self, loss: Tensor) -> None:
        self.optimizer.update(self.guard, None if self.guard is None else loss)

    def _update_and_hold(self, output: RenderOutput) -> dict[str, Any]:
        """Updates the parameters, and returns them with the gradients, which replays write."""
        self._update(output.loss)
        gradients = self._with_gradients()
        if active.recording is not None:
            for _, gradient in gradients:
                if gradient is not None:
                    active.recording.hold(gradient)
        return {"gradients": gradients}

    def _pre_backward(self, step: int) -> Callable[[], None]:
        renderer = self.loss.renderer
        return functools.partial(renderer.sampler.step_pre_backward, renderer.field, step, self.generator)

    def _calls_hooks(self) -> bool:
        """Returns whether a Python hook runs in each step."""
        sampler, strategy = self.loss.renderer.sampler, self.strategy
        hooks = ("step_pre_backward", "sample", "step_post_backward")
        strategy_hook = strategy is not None and in_python(strategy, "step_post_backward")
        term_hook = any(not hasattr(term, "add") or in_python(term, "add") for term in self.loss.terms)
        return strategy_hook or term_hook or self._draws_in_python() or any(in_python(sampler, hook) for hook in hooks)

    # Replay -----------------------------------------------------------------------------------------------------------

    def _run_steps(self, rays: int, steps: int) -> StepOutput:
        """Runs or replays all steps."""
        while True:
            done, output = self._run_or_replay(rays, steps)
            steps -= done
            if not steps:
                return output

    def _run_or_replay(self, rays: int, steps: int) -> tuple[int, StepOutput]:
        """Runs one step or replays several; returns their number, and the result of the last one."""
        if self._is_running:
            raise RuntimeError(
                "TrainingStep: a step must not be called while it runs, by one of its hooks or in another thread"
            )
        try:
            self._is_running = True
            return self._run_once(rays, steps)
        finally:
            self._is_running = False

    def _run_once(self, rays: int, steps: int) -> tuple[int, StepOutput]:
        batch = None
        if self._draws_in_python():  # before all checks, since this hook may change what they look at
            batch = self._call_stage(self._draw_stage(), {"rays": rays})["batch"]
        is_unchanged = self._is_unchanged()
        if not is_unchanged and (obstacle := self._standing_obstacle()):
            self._forget()
            self._obstacle = obstacle
            return 1, StepOutput(*self._run_eagerly(rays, batch))
        if self._on_gpu():
            return self._run_or_replay_on_gpu(rays, steps, is_unchanged, batch)
        if not is_unchanged:
            self._forget()
            self._draws, stages = batch is None, self._stages(cast(Radiance, self.loss.radiance()))
            stages = stages if self._draws else stages[1:]
            groups = itertools.groupby(stages, operator.attrgetter("python"))
            self._groups = [(python, f"step {place}", [*group]) for place, (python, group) in enumerate(groups)]
            for name in self._segments.keys() - {"before", "after", *(name for _, name, _ in self._groups)}:
                del self._segments[name]  # these segments lie between other hooks
            self._note_dependencies()  # before the hooks, which may change them
        self._last, hook_results = SegmentResult({}), dict[str, Any]() if batch is None else {"batch": batch}
        has_called = False  # whether a hook of this step has been called since the dependencies were checked
        for python, name, stages in self._groups:
            if python:
                for stage in stages:
                    hook_results |= self._call_stage(stage, {"rays": rays, **hook_results})
                has_called = True
                continue
            segment, earlier = self._segments.setdefault(name, Segment()), self._last if self._last.value else {}
            run = functools.partial(self._run_stages, stages)
            times = steps if self._draws and len(self._groups) == 1 else 1
            if has_called and not self._dependencies.holds():
                earlier = self._last.now(self._last.value)
                self._last = SegmentResult(run(rays, earlier, hook_results))
            else:
                self._last = segment(run, rays, earlier, hook_results, times=times)
                if any(each.name == "update" for each in stages):
                    self._settle_gradients(segment)
            hook_results = {}
        value = self._last.value
        return self._last.times, StepOutput(value["batch"], value["output"], self._last.recording)

    def _call_stage(self, stage: Stage, inputs: Mapping[str, Any]) -> Mapping[str, Any]:
        """Calls a stage in Python with its inputs and the results of earlier segments."""
        began, last = time.perf_counter(), self._last
        with self._context():
            values = [
                inputs[name] if name in inputs else last.value[name] if stage.lazy else last.now(last.value[name])
                for name in stage.reads
            ]
            results = stage.function(*values) or {}
        seconds, calls = self._spent.get(stage.name, (0.0, 0))
        self._spent[stage.name] = seconds + time.perf_counter() - began, calls + 1
        return results

    def _run_stages(self, stages: list[Stage], rays: int, earlier: Any, hook_results: Any) -> dict[str, Any]:
        with self._context():
            return noting_reads(self._reads, run_stages, stages, {**earlier, **hook_results, "rays": rays})

    def _settle_gradients(self, segment: Segment) -> None:
        """Points ``grad`` of all parameters to the memory that replays write.

        Eager steps or the loop may have set ``grad`` to other tensors.
        """
        if segment.replayed:
            for parameter, gradient in self._last.value["gradients"]:
                if parameter.grad is not gradient:
                    parameter.grad = gradient

    def _run_or_replay_hook(self, name: str, function: Callable[[], None]) -> None:
        """Calls a hook before or after a step, or replays the compiled calls that were recorded in the hook."""
        if self._last.recording is not None and self._is_unchanged():
            self._segments.setdefault(name, Segment())(functools.partial(noting_reads, self._reads, function))
        else:
            function()

    def _is_unchanged(self) -> bool:
        """Returns whether all dependencies are unchanged, and no mode, transform or profiler of torch is active."""
        return not has_listeners() and self._dependencies_hold()

    def _on_gpu(self) -> bool:
        return self.batches.device.type == "cuda"

    def _run_or_replay_on_gpu(
        self, rays: int, steps: int, is_unchanged: bool, batch: Batch | None
    ) -> tuple[int, StepOutput]:
        """Does the same as `_run_or_replay` by a CUDA graph, which is captured after a warm-up step."""
        if self._calls_hooks():
            self._forget()
            self._obstacle = "it calls a Python hook, which a CUDA graph cannot replay"
            return 1, StepOutput(*self._run_eagerly(rays, batch))
        self._rays, capture = rays, self._capture
        if capture is not None and is_unchanged and (times := capture.replay(backends.threads(), steps)):
            self._backoff = self._eager_steps = 0
            for parameter, gradient in self._gradients:
                parameter.grad = gradient
            return times, StepOutput(*self._captured)
        if self._eager_steps:
            self._eager_steps -= 1
            return 1, StepOutput(*self._run_eagerly(rays))
        self._forget()
        if not is_unchanged:
            result, self._obstacle = self._run_eagerly(rays), "it needs a warm-up step before the capture"
        else:
            self._eager_steps, self._backoff = self._backoff, min(2 * self._backoff or 1, MAX_BACKOFF)
            result = self._capture_step(capture)
        self._note_dependencies()
        return 1, StepOutput(*result)

    def _capture_step(self, previous: Capture | None) -> tuple[Batch, RenderOutput]:
        """Runs one step eagerly, and captures the graph for the next steps."""
        capture = Capture(getattr(self.batches, "place", self.batches.device), self.generator, previous)
        result = capture.warm_up(lambda: self._run_eagerly(self._rays))
        gradients = self._with_gradients()
        if capture.obstacle is None:
            self._captured = capture.capture(lambda: self._run_eagerly(capture.count(lambda: self._rays)))
            self._capture, self._gradients = capture, self._with_gradients()
        self._obstacle = capture.obstacle or ""
        for parameter, gradient in gradients:  # the gradients of the eager step
            parameter.grad = gradient
        return result

    def _with_gradients(self) -> list[tuple[nn.Parameter, Tensor | None]]:
        return [(p, p.grad) for group in self.optimizer.param_groups for p in group["params"]]

    def _run_eagerly(self, rays: int, batch: Batch | None = None) -> tuple[Batch, RenderOutput]:
        """Runs one step eagerly, with ``batch`` if it has been drawn already."""
        with self._context():
            batch = self.batches.draw(rays, self.generator) if batch is None else batch
            self.optimizer.zero_grad(set_to_none=True)
            if self.autocast is None:
                output = self.loss(batch, self.generator, backward=True)
                self._update(output.loss)
            else:
                with self._in_precision():
                    output = self.loss(batch, self.generator)
                self._learn_scaled(output.loss)
                # If the autograd graph stayed alive, the next step's gradients would use the stream of this step, but a
                # capture may only wait for its own stream.
                output = output._replace(loss=output.loss.detach())
            for part in (self.loss.renderer.sampler, self.strategy):
                if part is not None:
                    part.step_post_backward(output)
            return batch, output

    def _in_precision(self) -> AbstractContextManager[Any]:
        """Returns an autocast context without a weight cache, since a captured graph would outlive the cache."""
        if self.autocast is None:
            return nullcontext()
        return torch.autocast(self.batches.device.type, self.autocast, cache_enabled=False)

    def _scales(self) -> bool:
        """Returns whether a GradScaler scales the loss."""
        return self.autocast is not None and self.scaler is not None and self.scaler.is_enabled()

    def _learn_scaled(self, loss: Tensor) -> None:
        scaler = self.scaler
        if scaler is None or not self._scales():
            loss.backward()
            self._update(loss.detach())
            return
        scaler.scale(loss).backward()
        if self.guard is not None:
            self.guard.judge(loss.detach(), [])
        # A flag on the device makes the optimiser skip a step that is not finite, so the host need not wait.
        scaler.step(self.optimizer)
        scaler.update()

    def _standing_obstacle(self) -> str | None:
        """Returns the reason why no step can be replayed, or None; other obstacles may appear in the recording."""
        if has_listeners():
            return "a mode, a transform or a profiler of torch is active"
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
        if self._scales():
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
        learning = {id(p) for group in self.optimizer.param_groups for p in group["params"]}
        for name, parameter in cast(nn.Module, renderer.field).named_parameters():
            if parameter.requires_grad and id(parameter) not in learning:  # another optimiser reads its gradient
                return f"{name} needs a gradient but is not in the optimizer"
            if self._on_gpu() and (parameter._backward_hooks or parameter._post_accumulate_grad_hooks):
                return f"a hook of {name} runs in Python, which a CUDA graph cannot replay"
        return None

    def _note_dependencies(self) -> None:
        """Notes the dependencies of the recorded step, so that changes are detected."""
        renderer, optimizer = self.loss.renderer, self.optimizer
        with self._in_precision():
            radiance = self.loss.radiance()
        compiled = backends.compiled()
        if not isinstance(radiance, Radiance) or compiled is None:
            return
        self._radiance, dependencies = radiance, unchanged()
        field = cast(nn.Module, renderer.field)
        dependencies.entries(vars(self), _ATTRIBUTES)
        dependencies.entries(vars(radiance.router), ["assignment", "temperature", "backend", "coords"])
        self._reads = note_attributes(dependencies, self._parts())
        hooks = [(self.batches, ["draw", "fetch"]), (self.strategy, ["step_post_backward"])]
        for part, names in (*hooks, *((term, ["add"]) for term in self.loss.terms)):
            if hasattr(part, "__dict__"):  # replaced hooks run in Python
                dependencies.entries(vars(part), names)
        dictionaries = list[dict[Any, Any]]()
        for module in field.modules():  # the field is the router or a module around it
            for name, members in vars(module).items():
                if name in ("_parameters", "_buffers", "_modules") or name.endswith("_hooks"):
                    dictionaries.append(members)
        dictionaries += [*map(vars, radiance.router.module.modules()), optimizer.state, *optimizer.state.values()]
        for members in dictionaries:
            dependencies.contents(members)
        dependencies.contents(vars(optimizer), ["steps_done"])
        learning = list[nn.Parameter]()
        for group in optimizer.param_groups:
            dependencies.contents(group, ["lr"])
            for each in (group["params"], group["betas"]):
                dependencies.contents(each)
            learning += group["params"]
        if self._on_gpu():  # unlike a recording, a capture does not track its tensors
            owners = self.batches, renderer.sampler, self.strategy, self.guard, optimizer.state, self._gradients
            for tensor in (*tensors_of(owners), *field.parameters(), *field.buffers()):
                dependencies.layout(tensor)
        for parameter in dict.fromkeys((*field.parameters(), *learning)):
            dependencies.attributes(parameter, ["requires_grad", *_HOOKS])
            for hooks in (getattr(parameter, name) for name in _HOOKS):
                if hooks is not None:
                    dependencies.contents(hooks)
        kind = self.batches.device.type  # for the autocast of the caller, not of the step
        for query in (
            backends.threads,
            compiled.isa,
            torch.is_grad_enabled,
            torch.are_deterministic_algorithms_enabled,
            self._scales,
            radiance.router.diagram.index,  # a new index if centres have changed in place
            functools.partial(torch.is_autocast_enabled, kind),
            functools.partial(torch.get_autocast_dtype, kind),
            self._precision,
        ):
            dependencies.answer(query)
        self._dependencies = dependencies

    def _parts(self) -> list[Any]:
        """Returns the objects with hooks that may be replayed."""
        sampler = self.loss.renderer.sampler
        parts = [self.loss, self.loss.renderer, sampler, *([] if sampler.grid is None else [sampler.grid])]
        parts += [term for term in self.loss.terms if hasattr(term, "add") and not in_python(term, "add")]
        parts += [] if self._draws_in_python() else [self.batches]
        if self.strategy is not None and not in_python(self.strategy, "step_post_backward"):
            parts.append(self.strategy)
        return parts

    def _precision(self) -> str:
        return torch.backends.cuda.matmul.fp32_precision if self._on_gpu() else backends.cpu_precision()

    def _dependencies_hold(self) -> bool:
        """Returns whether all noted dependencies are unchanged."""
        if not self._dependencies.holds():
            return False
        noted = cast(Radiance, self._radiance)
        with self._in_precision():
            current = self.loss.radiance()
        same = isinstance(current, Radiance) and current.networks is noted.networks
        return same and all(map(operator.is_, cast(Radiance, current).cells.parameters, noted.cells.parameters))
