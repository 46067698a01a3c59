"""A step of a training: stages, of which those that ops compute are recorded once and replayed from then on.

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
from voronerf.nerf.segment import LONGEST_WAIT, Made, Segment, Stage, free_names, in_python, run_stages
from voronerf.nerf.split import Strategy
from voronerf.nerf.volume import Batch, RenderOutput
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops._core.capture import Capture
from voronerf.ops._core.custom_op import is_watched
from voronerf.ops._core.recording import Recording
from voronerf.ops._core.unchanged import Never, unchanged
from voronerf.router.layout import tensors_of

_OWN = ("batches", "loss", "optimizer", "strategy", "guard", "generator", "autocast", "scaler")
_HOOKS = ("_backward_hooks", "_post_accumulate_grad_hooks")  # of parameters


class StepOutput:
    """What a step has found, until the next step of the same object.

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
        """How many there were."""
        return len(self._batch.rays if self._recording is None else self._recording.now(self._batch.rays.origins))

    @property
    def samples(self) -> int:
        """How many the rays had; waits for the device."""
        rows, weights = self._output.samples.rows, self._output.weights
        if self._recording is not None:
            weights = self._recording.now(weights)
        return len(weights) if rows is None else int(rows)

    @property
    def batch(self) -> Batch:
        """The rays."""
        return self._batch if self._recording is None else cast(Batch, self._recording.now(self._batch))

    @property
    def output(self) -> RenderOutput:
        """What :class:`RayLoss` gave; its tensors are the step's own memory."""
        return self._output if self._recording is None else cast(RenderOutput, self._recording.now(self._output))


class TrainingStep:
    """A step of a training: rays, loss, gradients, what the sampler and the splits learn, and the optimiser.

    The calls of the compiled module that a step makes are recorded, and made again by the steps that follow, in one
    call for all of them that are asked for at once: no Python runs in between, and threads are woken once. Results are
    the same bits. A hook that is one's own (`replayed` says which is not) is called in each step, between two segments
    of such calls: of a `Sampler`, a `Strategy`, a source of rays, or a term of the loss. What it changes of other
    objects counts from the next step on. On CUDA, a step without such hooks is captured in a CUDA graph, after one of
    its kind; another number of rays is captured anew. What keeps a step from all that (:meth:`explain`) lets it run as
    it is. What the objects are set to is followed, by their attributes, and so is a tensor that moves to other memory
    (``x.data = y``); an object that is changed inside needs :meth:`forget`. A parameter that needs a gradient and is
    not the optimiser's, such as that of a second optimiser, keeps a step from being replayed.

    Args:
        batches: The source of rays: `RayBatches`, or another :class:`RaySource`.
        loss: From rays to gradients, with the sampler.
        optimizer: Of all networks. Learning rates may change from step to step.
        strategy: What keeps samples for the splits; None for none.
        guard: Leaves out steps that are not finite; None for never.
        generator: Of random numbers.
        autocast: The dtype that the networks run in under autocast; None for float32. Such a step is captured on CUDA,
            and runs as it is on the CPU.
        scaler: Scales the loss in float16, which keeps a step from being captured; None for none.

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
        self._segments, self._same = dict[str, Segment](), False
        self._asked = self._wait = self._left = 0  # of a capture: as of a segment
        self.forget()

    def run_within(self, context: Callable[[], AbstractContextManager[None]]) -> None:
        """Sets the context of steps, and of their stages, that are not replayed.

        Args:
            context: Makes one for each of them.
        """
        self._context = context

    def forget(self) -> None:
        """Records the next step anew."""
        for segment in self._segments.values():
            segment.forget()
        self._capture: Capture | None = None
        self._captured: Any = None  # batch and output of the capture
        self._groups = list[tuple[bool, str, list[Stage]]]()  # of the stages: whether in Python, and a name
        self._last = Made({})
        self._spent = dict[str, tuple[float, int]]()  # seconds and calls of each hook in Python
        self._gradients = list[tuple[nn.Parameter, Tensor | None]]()  # the memory that replays write
        self._guards: Any = Never()
        self._known: Radiance | None = None
        self._obstacle = ""

    def explain(self) -> str:
        """Whether steps are replayed, what keeps them from it, and what runs in Python in between."""
        if self._capture is not None:
            return "step: captured and replayed as a CUDA graph"
        segments = [each for name, each in self._segments.items() if name not in ("before", "after")]
        obstacle = self._obstacle or self._standing_obstacle()
        obstacle = obstacle or next((each.obstacle for each in segments if each.obstacle), "")
        recorded = [each.recording for each in segments if each.recording is not None]
        if obstacle and not recorded:
            return f"step: runs as it is, since {obstacle}"
        if not obstacle and (left := max((self._left, *(each.left for each in segments)))):
            return f"step: runs as it is {left} times more, since the last recordings were not replayed"
        if not recorded:
            return "step: will be recorded"
        calls, several = sum(map(len, recorded)), f" in {len(recorded)} segments" if len(recorded) > 1 else ""
        lines = [f"step: recorded and replayed, {calls} calls{several}"]
        others = [each.obstacle for each in self._segments.values() if each.obstacle]
        lines += [f"another segment runs as it is, since {each}" for each in others]
        spent = self._spent.items()
        lines += [f"in Python: {name}, {1e3 * seconds / calls:.3f} ms a call" for name, (seconds, calls) in spent]
        return "\n".join(lines)

    def __call__(self, rays: int, steps: int = 1, *, at: int | None = None) -> StepOutput:
        """Makes steps in a row, with the same learning rate.

        Args:
            rays: Of each step.
            steps: How many, at least 1.
            at: Steps done before. With it, the sampler's ``step_pre_backward`` is called before every step that asks
                for it (``steps_alike``), before each where hooks are one's own, and the optimiser's ``after_step``
                after every step whose number is a multiple of `GROUP`; they are recorded, too. None where the loop
                calls them.

        Returns:
            What the last step has found.

        Raises:
            ValueError: Fewer steps than 1.
        """
        if steps < 1:
            raise ValueError(f"TrainingStep: steps must be >= 1, got {steps}")
        if at is None:
            return self._make_all(rays, steps)
        sampler, end = self.loss.renderer.sampler, at + steps
        while at < end:
            alike = 1 if self._calls_hooks() else sampler.steps_alike(at)
            part = min(end - at, schedule.GROUP - at % schedule.GROUP, alike)
            ask = self._asking(at)
            if sampler.asks_at(at) and not in_python(sampler, "step_pre_backward"):
                self._beside("before", ask)
            else:
                ask()
            output = self._make_all(rays, part)
            at += part
            self.optimizer.steps_done = at
            if at % schedule.GROUP == 0:
                self._beside("after", functools.partial(self.optimizer.after_step, at))
        return output

    # Several segments of a step that another loop makes, since the host computes something in between -----------------

    def begin(self, at: int) -> None:
        """Begins a step that another loop makes of segments, since the host computes something in between.

        The sampler's ``step_pre_backward`` is called; then come segments (:meth:`do`), and :meth:`end`.

        Args:
            at: Steps done before.
        """
        asks, ask = self.loss.renderer.sampler.asks_at(at), self._asking(at)
        if not asks:
            ask()  # which may change the sampler
        self._same = self._is_same()
        if not self._same:
            self.forget()
            self._obstacle = self._standing_obstacle() or ("it runs on a GPU" if self._on_gpu() else "")
            if not self._obstacle:
                self._guard()
        if asks:
            self.do("before", ask)
        self.optimizer.zero_grad(set_to_none=True)

    def draw(self, rays: int) -> Batch:
        """Draws so many rays."""
        draw = functools.partial(self.batches.draw, generator=self.generator)
        made = self.do("rays", draw, rays) if not self._draws_in_python() else Made(draw(rays))
        return cast(Batch, made.now(made.value))

    def do(self, name: str, function: Callable[..., Any], *given: Any) -> Made:
        """A segment of a step, see :class:`Segment`.

        Args:
            name: The same in each step.
            function: The same in each step, but for what it is given.
            given: As of a segment.
        """
        if self._obstacle:
            return Made(function(*(each.now(each.value) if isinstance(each, Made) else each for each in given)))
        return self._segments.setdefault(name, Segment())(function, *given)

    def end(self, at: int, output: RenderOutput, *gradients: Made) -> None:
        """Ends a step of segments: optimiser, sampler and splits learn.

        Args:
            at: Steps done, with this one.
            output: What was found, with the loss.
            gradients: The segments that have left gradients at the parameters; without any there is nothing to learn.
        """
        if gradients:
            self.do(f"update of {len(gradients)}", self._update, output.loss, *gradients)
        for stage in self._telling():
            stage.function(output)
        self.optimizer.steps_done = at
        if at % schedule.GROUP == 0:
            self.do("after", functools.partial(self.optimizer.after_step, at))

    # What a step does -------------------------------------------------------------------------------------------------

    def _stages(self, field: Radiance) -> list[Stage]:
        """A step whose networks, loss and gradients are one operation."""
        draw = Stage(f"{type(self.batches).__name__}.draw", self._draw, ("rays",), self._draws_in_python())
        clear = Stage("clear", functools.partial(self.optimizer.zero_grad, set_to_none=True))
        update = Stage("update", lambda output: self._update(output.loss), ("output",))
        *look, learn = self.loss.stages(field, self.generator, True, lambda held: self._last.now(held))
        return [draw, *look, clear, learn, update, *self._telling()]

    def _telling(self) -> Iterator[Stage]:
        """What sampler and splits learn of a step."""
        for part in (self.loss.renderer.sampler, self.strategy):
            if part is not None:
                own, name = in_python(part, "step_post_backward"), f"{type(part).__name__}.step_post_backward"
                yield Stage(name, part.step_post_backward, ("output",), own)

    def _draw(self, rays: int) -> dict[str, Any]:
        return {"batch": self.batches.draw(rays, self.generator)}

    def _draws_in_python(self) -> bool:
        return in_python(self.batches, "draw") or getattr(self.batches, "fetch", None) is not None

    def _update(self, loss: Tensor, *gradients: Any) -> None:
        self.optimizer.update(self.guard, None if self.guard is None else loss)

    def _asking(self, step: int) -> Callable[[], None]:
        renderer = self.loss.renderer
        return functools.partial(renderer.sampler.step_pre_backward, renderer.field, step, self.generator)

    def _calls_hooks(self) -> bool:
        """Whether Python runs in each step."""
        sampler, strategy = self.loss.renderer.sampler, self.strategy
        hooks = ("step_pre_backward", "sample", "step_post_backward")
        told = strategy is not None and in_python(strategy, "step_post_backward")
        own = any(not hasattr(term, "add") or in_python(term, "add") for term in self.loss.terms)
        return told or own or self._draws_in_python() or any(in_python(sampler, hook) for hook in hooks)

    # How it is made ---------------------------------------------------------------------------------------------------

    def _make_all(self, rays: int, steps: int) -> StepOutput:
        """Makes all of so many steps."""
        while True:
            made, output = self._make(rays, steps)
            steps -= made
            if not steps:
                return output

    def _make(self, rays: int, steps: int) -> tuple[int, StepOutput]:
        """Makes the next of so many steps, or more of them; gives how many, and what the last has found."""
        same = self._is_same()
        if not same and (obstacle := self._standing_obstacle()):
            self.forget()
            self._obstacle = obstacle
            return 1, StepOutput(*self._run(rays))
        if self._on_gpu():
            return self._make_on_gpu(rays, steps, same)
        if not same:
            self.forget()
            stages = self._stages(cast(Radiance, self.loss.radiance()))
            groups = itertools.groupby(stages, operator.attrgetter("python"))
            self._groups = [(own, f"step {place}", [*group]) for place, (own, group) in enumerate(groups)]
            for name in self._segments.keys() - {"before", "after", *(name for _, name, _ in self._groups)}:
                del self._segments[name]  # of other hooks
            self._guard()  # before hooks, whose changes count from the next step on
        self._last, fresh = Made({}), dict[str, Any]()
        for own, name, stages in self._groups:
            if own:
                for stage in stages:
                    fresh |= self._call(stage, {"rays": rays, **fresh})
                continue
            segment, before = self._segments.setdefault(name, Segment()), self._last if self._last.value else {}
            run, times = functools.partial(self._run_stages, stages), steps if len(self._groups) == 1 else 1
            self._last = segment(run, rays, before, fresh, times=times)
            fresh = {}
            if any(each.name == "update" for each in stages):
                self._settle_gradients(segment)
        value = self._last.value
        return self._last.times, StepOutput(value["batch"], value["output"], self._last.recording)

    def _call(self, stage: Stage, fresh: Mapping[str, Any]) -> Mapping[str, Any]:
        """A stage in Python, given what others there have made, or segments before."""
        began, last = time.perf_counter(), self._last
        with self._context():
            values = [
                fresh[name] if name in fresh else last.value[name] if stage.lazy else last.now(last.value[name])
                for name in stage.reads
            ]
            found = stage.function(*values) or {}
        seconds, calls = self._spent.get(stage.name, (0.0, 0))
        self._spent[stage.name] = seconds + time.perf_counter() - began, calls + 1
        return found

    def _run_stages(self, stages: list[Stage], rays: int, before: Any, fresh: Any) -> dict[str, Any]:
        with self._context():
            return run_stages(stages, {**before, **fresh, "rays": rays})

    def _settle_gradients(self, segment: Segment) -> None:
        """Gives parameters the gradients that replays write; a step in between, or the loop, may have left others."""
        if segment.replayed:
            for parameter, gradient in self._gradients:
                if parameter.grad is not gradient:
                    parameter.grad = gradient
        elif (recording := self._last.recording) is not None:  # a new one
            self._gradients = self._with_gradients()
            for _, gradient in self._gradients:
                if gradient is not None:
                    recording.hold(gradient)

    def _beside(self, name: str, function: Callable[[], None]) -> None:
        """Calls a function of the same objects, or makes its calls again."""
        if self._last.recording is not None and self._is_same():
            self._segments.setdefault(name, Segment())(function)
        else:
            function()

    def _is_same(self) -> bool:
        """Whether all is as it was noted, and nothing of torch watches."""
        return not is_watched() and self._holds()

    def _on_gpu(self) -> bool:
        return self.batches.device.type == "cuda"

    def _make_on_gpu(self, rays: int, steps: int, same: bool) -> tuple[int, StepOutput]:
        """As `_make`: by a CUDA graph, captured after a step of its kind."""
        if self._calls_hooks():
            self.forget()
            self._obstacle = "Python runs in it, which a CUDA graph does not make"
            return 1, StepOutput(*self._run(rays))
        self._asked, capture = rays, self._capture
        if capture is not None and same and (times := capture.replay(backends.threads(), steps)):
            self._wait = self._left = 0
            for parameter, gradient in self._gradients:
                parameter.grad = gradient
            return times, StepOutput(*self._captured)
        if self._left:
            self._left -= 1
            return 1, StepOutput(*self._run(rays))
        self.forget()
        if not same:
            made, self._obstacle = self._run(rays), "no step of its kind was made before"
        else:
            self._left, self._wait = self._wait, min(2 * self._wait or 1, LONGEST_WAIT)
            made = self._capture_step(capture)
        self._guard()
        return 1, StepOutput(*made)

    def _capture_step(self, before: Capture | None) -> tuple[Batch, RenderOutput]:
        """A step as it is, and the graph of those that follow."""
        capture = Capture(getattr(self.batches, "place", self.batches.device), self.generator, before)
        made = capture.warm_up(lambda: self._run(self._asked))
        gradients = self._with_gradients()
        if capture.obstacle is None:
            self._captured = capture.capture(lambda: self._run(capture.count(lambda: self._asked)))
            self._capture, self._gradients = capture, self._with_gradients()
        self._obstacle = capture.obstacle or ""
        for parameter, gradient in gradients:  # of the step that was made
            parameter.grad = gradient
        return made

    def _with_gradients(self) -> list[tuple[nn.Parameter, Tensor | None]]:
        return [(p, p.grad) for group in self.optimizer.param_groups for p in group["params"]]

    def _run(self, rays: int) -> tuple[Batch, RenderOutput]:
        """A step as it is."""
        with self._context():
            batch = self.batches.draw(rays, self.generator)
            self.optimizer.zero_grad(set_to_none=True)
            if self.autocast is None:
                output = self.loss(batch, self.generator, backward=True)
                self._update(output.loss)
            else:
                with self._in_precision():
                    output = self.loss(batch, self.generator)
                self._learn_scaled(output.loss)
                # A graph of autograd that lives on gives the next step's gradients the stream of this one, and a
                # capture may wait for no other stream than its own.
                output = output._replace(loss=output.loss.detach())
            for part in (self.loss.renderer.sampler, self.strategy):
                if part is not None:
                    part.step_post_backward(output)
            return batch, output

    def _in_precision(self) -> AbstractContextManager[Any]:
        """Autocast to the dtype that the networks run in, without a cache of weights, which a capture would outlive."""
        if self.autocast is None:
            return nullcontext()
        return torch.autocast(self.batches.device.type, self.autocast, cache_enabled=False)

    def _scales(self) -> bool:
        """Whether a scaler changes the loss."""
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
        # The optimiser skips a step that is not finite by a flag on the device, so the host need not wait for it.
        scaler.step(self.optimizer)
        scaler.update()

    def _standing_obstacle(self) -> str | None:
        """What keeps any step from being replayed, whatever it computes."""
        if is_watched():
            return "a mode, a transform or a profiler of torch watches"
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
        for part in (self.loss, renderer, self.optimizer):
            if in_python(part):
                return f"{type(part).__name__} may do in Python what is not seen"
        with self._in_precision():  # in which a traced field is no program
            reason = self.loss.why_not_fused()
        if reason is not None:
            return reason
        learning = {id(p) for group in self.optimizer.param_groups for p in group["params"]}
        for name, parameter in cast(nn.Module, renderer.field).named_parameters():
            if parameter.requires_grad and id(parameter) not in learning:  # others read and drop its gradient
                return f"{name} needs a gradient and is not the optimizer's"
            if self._on_gpu() and (parameter._backward_hooks or parameter._post_accumulate_grad_hooks):
                return f"a hook of {name} runs in Python, which a CUDA graph does not make"
        return None

    def _guard(self) -> None:
        """Notes what the step that was made depends on."""
        renderer, optimizer = self.loss.renderer, self.optimizer
        with self._in_precision():
            known = self.loss.radiance()
        compiled = backends.compiled()
        if not isinstance(known, Radiance) or compiled is None:
            return
        self._known, guard = known, unchanged()
        field, grid = cast(nn.Module, renderer.field), getattr(renderer.sampler, "grid", None)
        guard.entries(vars(self), _OWN)
        guard.entries(vars(known.router), ["assignment", "temperature", "backend", "coords"])
        parts = [self.loss, renderer, renderer.sampler]  # those that segments read
        parts += [each for each in self.loss.terms if hasattr(each, "add") and not in_python(each, "add")]
        if not self._draws_in_python():
            parts.append(self.batches)
        if self.strategy is not None and not in_python(self.strategy, "step_post_backward"):
            parts.append(self.strategy)
        for part in parts:
            guard.contents(vars(part), free_names(part))
        dictionaries: list[dict[Any, Any]] = [renderer.fields, *([] if grid is None else [vars(grid)])]
        for module in field.modules():  # the router, perhaps in a wrapper
            for name, members in vars(module).items():
                if name in ("_parameters", "_buffers", "_modules") or name.endswith("_hooks"):
                    dictionaries.append(members)
        dictionaries += [*map(vars, known.router.module.modules()), optimizer.state, *optimizer.state.values()]
        for members in dictionaries:
            guard.contents(members)
        guard.contents(vars(optimizer), ["steps_done"])
        learning = list[nn.Parameter]()
        for group in optimizer.param_groups:
            guard.contents(group, ["lr"])
            for each in (group["params"], group["betas"]):
                guard.contents(each)
            learning += group["params"]
        if self._on_gpu():  # a capture does not see which tensors it takes, as a recording does
            owners = self.batches, renderer.sampler, self.strategy, self.guard, optimizer.state, self._gradients
            for tensor in (*tensors_of(owners), *field.parameters(), *field.buffers()):
                guard.layout(tensor)
        for parameter in dict.fromkeys((*field.parameters(), *learning)):
            guard.attributes(parameter, ["requires_grad", *_HOOKS])
            for hooks in (getattr(parameter, name) for name in _HOOKS):
                if hooks is not None:
                    guard.contents(hooks)
        kind = self.batches.device.type  # autocast of the caller, around the step's own
        for question in (
            backends.threads,
            compiled.isa,
            torch.is_grad_enabled,
            torch.are_deterministic_algorithms_enabled,
            self._scales,
            known.router.diagram.index,  # another one where centres have changed in place
            functools.partial(torch.is_autocast_enabled, kind),
            functools.partial(torch.get_autocast_dtype, kind),
            self._precision,
        ):
            guard.answer(question)
        self._guards = guard

    def _precision(self) -> str:
        return torch.backends.cuda.matmul.fp32_precision if self._on_gpu() else backends.cpu_precision()

    def _holds(self) -> bool:
        """Whether all is as it was noted."""
        if not self._guards.holds():
            return False
        known = cast(Radiance, self._known)
        with self._in_precision():
            now = self.loss.radiance()
        same = isinstance(now, Radiance) and now.networks is known.networks
        return same and all(map(operator.is_, cast(Radiance, now).cells.parameters, known.cells.parameters))
