"""A step of a training, recorded once and replayed from then on. r rays, m samples of all rays."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.nerf import schedule
from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches
from voronerf.nerf.loss import Batch, RayLoss, RenderOutput
from voronerf.nerf.part import LONGEST_WAIT, Made, Part
from voronerf.nerf.radiance import Radiance
from voronerf.nerf.split import Strategy
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops._core.capture import Capture
from voronerf.ops._core.custom_op import is_watched
from voronerf.ops._core.recording import Recording
from voronerf.ops.adam.reference import judge
from voronerf.router.layout import tensors_of


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
        return len(self._batch.rays) if self._recording is None else self._recording.rows(0)

    @property
    def samples(self) -> int:
        """How many the rays had; waits for the device."""
        rows = self._output.samples.rows
        if self._recording is not None:
            return self._recording.rows_of(self._output.weights)
        return len(self._output.weights) if rows is None else int(rows)

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
    the same bits. On CUDA, a step is captured in a CUDA graph, after one of its kind; another number of rays is
    captured anew. What keeps a step from that (:meth:`explain`) lets it run as it is. What the objects are set to is
    followed, by their attributes, and so is a tensor that moves to other memory (``x.data = y``); an object that is
    changed inside needs :meth:`forget`. A parameter that needs a gradient and is not the optimiser's, such as that of
    a second optimiser, keeps a step from being replayed.

    Args:
        batches: Where rays come from.
        loss: From rays to gradients, with the sampler.
        optimizer: Of all networks. Learning rates may change from step to step.
        strategy: What keeps samples for the splits; None for none.
        guard: Leaves out steps that are not finite; None for never.
        generator: Of random numbers.
        autocast: The dtype that the networks run in under autocast; None for float32.
        scaler: Of the loss in float16; None for none.

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
        batches: RayBatches,
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
        self.as_it_is: Callable[[], AbstractContextManager[None]] = nullcontext  # around a step that is not replayed
        self._rays = self._wait = self._left = 0  # steps that run as they are, the next time, and still this time
        self.forget()

    def forget(self) -> None:
        """Records the next step anew."""
        self._recording: Recording | Capture | None = None
        self._made: Any = None  # batch and output, when it was recorded
        self._gradients = list[tuple[nn.Parameter, Tensor | None]]()  # the memory that replays write
        self._guards: Any = None
        self._cpu: Callable[[], Any]
        self._known: Radiance | None = None
        self._parameters = list[nn.Parameter]()  # of the field and the optimiser
        self._parts = dict[str, Part]()
        self._objects, self._values = list[Any](), list[Any]()
        self._obstacle, self._same = "", False

    def explain(self) -> str:
        """Whether steps are replayed, and what keeps them from it."""
        if isinstance(self._recording, Capture):
            return "step: captured and replayed as a CUDA graph"
        if self._recording is not None and self._left:
            return f"step: runs as it is {self._left} times more, since the last recordings were not replayed"
        if self._recording is not None:
            return f"step: recorded and replayed, {len(self._recording)} calls"
        if parts := sum(part.recorded for part in self._parts.values()):
            return f"step: {parts} parts of it are recorded and replayed"
        obstacle = self._obstacle or self._standing_obstacle()
        return "step: will be recorded" if obstacle is None else f"step: runs as it is, since {obstacle}"

    def __call__(self, rays: int, steps: int = 1, *, at: int | None = None) -> StepOutput:
        """Makes steps in a row, with the same learning rate.

        Args:
            rays: Of each step.
            steps: How many, at least 1.
            at: Steps done before. With it, the sampler's ``step_pre_backward`` is called before every step that asks
                for it (``steps_alike``), and the optimiser's ``after_step`` after every step whose number is a
                multiple of `GROUP`; they are recorded, too. None where the loop calls them.

        Returns:
            What the last step has found.

        Raises:
            ValueError: Fewer steps than 1.
        """
        if steps < 1:
            raise ValueError(f"TrainingStep: steps must be >= 1, got {steps}")
        self._rays = rays
        if at is None:
            return self._make_all(steps, None)[0]
        sampler, end = self.loss.renderer.sampler, at + steps
        while at < end:
            part = min(end - at, schedule.GROUP - at % schedule.GROUP, sampler.steps_alike(at))
            output, same = self._make_all(part, self._before(at))
            at += part
            self._after(at, same)
        return output

    def begin(self, at: int) -> None:
        """Begins a step that another loop makes of parts, since the host computes something in between.

        The sampler's ``step_pre_backward`` is called; then come parts (:meth:`part`), and :meth:`end`.

        Args:
            at: Steps done before.
        """
        asks, ask = self.loss.renderer.sampler.asks_at(at), self._asking(at)
        if not asks:
            ask()  # which may change the sampler
        self._same = self._is_same()
        if not self._same:
            self.forget()
            self._obstacle = self._standing_obstacle(draws=False) or ("it runs on a GPU" if self._on_gpu() else "")
        if asks:
            self.part("before", ask)
        self.optimizer.zero_grad(set_to_none=True)

    def draw(self, rays: int) -> Batch:
        """The part of a step that draws so many rays."""
        draw = functools.partial(self.batches.draw, rays, self.generator)
        if self.batches.fetch is not None:
            return draw()
        made = self.part("rays", draw, rows=(rays,))
        return cast(Batch, made.now(made.value))

    def part(
        self,
        name: str,
        function: Callable[..., Any],
        *made: Made,
        tensors: Sequence[Tensor] = (),
        rows: Sequence[int] = (),
    ) -> Made:
        """A part of a step; it is recorded by itself, and replayed.

        Args:
            name: The same in each step.
            function: Of the values of other parts, and of tensors, as of these objects.
            made: What it reads of other parts of this step.
            tensors: What it reads else.
            rows: Numbers of rows that these have, and that change from step to step.
        """
        if self._obstacle:
            return Made(function(*(each.now(each.value) for each in made), *tensors))
        return self._parts.setdefault(name, Part())(function, made, tensors, rows)

    def end(self, at: int, output: RenderOutput, *gradients: Made) -> None:
        """Ends a step of parts: optimiser, sampler and splits learn.

        Args:
            at: Steps done, with this one.
            output: What was found, with the loss.
            gradients: The parts that have left gradients at the parameters; without any there is nothing to learn.
        """
        if gradients:
            self.part(f"update of {len(gradients)}", self._update, *gradients, tensors=(output.loss,))
        self._tell(output)
        if not self._same and not self._obstacle:
            self._guard()
        self.optimizer.steps_done = at
        if at % schedule.GROUP == 0:
            self.part("after", functools.partial(self.optimizer.after_step, at))

    def _update(self, *given: Any) -> None:
        self.optimizer.update(self.guard, None if self.guard is None else given[-1])

    def _asking(self, step: int) -> Callable[[], None]:
        renderer = self.loss.renderer
        return functools.partial(renderer.sampler.step_pre_backward, renderer.field, step, self.generator)

    def _tell(self, output: RenderOutput) -> None:
        """What sampler and splits learn of a step."""
        self.loss.renderer.sampler.step_post_backward(output)
        if self.strategy is not None:
            self.strategy.step_post_backward(output)

    def _make_all(self, steps: int, same: bool | None) -> tuple[StepOutput, bool | None]:
        """Makes all of so many steps; ``same`` and the results are those of :meth:`_make`."""
        while True:
            made, output, same = self._make(steps, same)
            steps -= made
            if not steps:
                return output, same

    def _make(self, steps: int, same: bool | None) -> tuple[int, StepOutput, bool | None]:
        """Makes the next of so many steps, or more of them.

        Args:
            steps: At least 1.
            same: Whether all is as it was noted; None where that is not known.

        Returns:
            How many, what the last has found, and whether all is still as it was.
        """
        recording = self._recording
        same = self._is_same() if same is None else same
        if recording is not None and same:
            if times := recording.replay(backends.threads(), steps):
                self._wait = self._left = 0
                self._give_gradients()  # a step in between, or the loop, may have left others
                batch, output = self._made
                return times, StepOutput(batch, output, recording if isinstance(recording, Recording) else None), True
        elif obstacle := self._standing_obstacle():
            self.forget()
            self._obstacle = obstacle
            return 1, StepOutput(*self._run(self._rays)), None
        if self._left:
            self._left -= 1
            return 1, StepOutput(*self._run(self._rays)), None
        return 1, self._record(same), None

    def _before(self, step: int) -> bool | None:
        """The sampler before a step, replayed where it asks the field; gives what :meth:`_beside` gives."""
        ask = self._asking(step)
        if self.loss.renderer.sampler.asks_at(step):
            return self._beside("before", ask, self._is_same())
        ask()
        return None

    def _after(self, step: int, same: bool | None) -> None:
        """The optimiser after so many steps; what it computes is replayed."""
        self.optimizer.steps_done = step
        if step % schedule.GROUP == 0:
            learn = functools.partial(self.optimizer.after_step, step)
            self._beside("after", learn, self._is_same() if same is None else same)

    def _beside(self, name: str, function: Callable[[], None], same: bool) -> bool | None:
        """Calls a function of the same objects, or makes its calls again; whether all is as it was noted, if known."""
        if not same or not isinstance(self._recording, Recording):
            function()
            return None
        part = self._parts.setdefault(name, Part())
        part(function)
        return True if part.replayed else None

    def _is_same(self) -> bool:
        """Whether all is as it was noted, and nothing of torch watches."""
        return not is_watched() and self._holds()

    def _record(self, known: bool) -> StepOutput:
        """A step as it is, recorded or captured if nothing keeps it from that.

        Args:
            known: Whether the step before was of this kind, so that what a first one prepares is there.
        """
        before, on_gpu = self._recording, self._on_gpu()
        if not on_gpu or known:
            self._left, self._wait = self._wait, min(2 * self._wait or 1, LONGEST_WAIT)
        parts = self._parts if known else {}
        self.forget()
        self._parts = parts
        if not on_gpu:
            with Recording() as recording:
                made = self._run(recording.count(lambda: self._rays))
            self._keep(recording, made)
        elif known:
            made = self._capture(before if isinstance(before, Capture) else None)
        else:
            made, self._obstacle = self._run(self._rays), "no step of its kind was made before"
        self._guard()
        return StepOutput(*made)

    def _on_gpu(self) -> bool:
        return self.batches.device.type == "cuda"

    def _capture(self, before: Capture | None) -> tuple[Batch, RenderOutput]:
        """A step as it is, and the graph of those that follow."""
        capture = Capture(self.batches.place, self.generator, before)
        made = capture.warm_up(lambda: self._run(self._rays))
        gradients = self._with_gradients()
        if capture.obstacle is None:
            self._keep(capture, capture.capture(lambda: self._run(capture.count(lambda: self._rays))))
        self._obstacle = capture.obstacle or ""
        for parameter, gradient in gradients:  # of the step that was made
            parameter.grad = gradient
        return made

    def _keep(self, recording: Recording | Capture, made: tuple[Batch, RenderOutput]) -> None:
        """Steps that follow are replayed, if nothing keeps them from it."""
        self._obstacle = recording.obstacle or ""
        if recording.obstacle is None:
            self._recording, self._made, self._gradients = recording, made, self._with_gradients()

    def _give_gradients(self) -> None:
        for parameter, gradient in self._gradients:
            if parameter.grad is not gradient:
                parameter.grad = gradient

    def _with_gradients(self) -> list[tuple[nn.Parameter, Tensor | None]]:
        return [(p, p.grad) for group in self.optimizer.param_groups for p in group["params"]]

    def _run(self, rays: int) -> tuple[Batch, RenderOutput]:
        with self.as_it_is():
            return self._run_step(rays)

    def _run_step(self, rays: int) -> tuple[Batch, RenderOutput]:
        batch = self.batches.draw(rays, self.generator)
        self.optimizer.zero_grad(set_to_none=True)
        if self.autocast is None:
            output = self.loss(batch, self.generator, backward=True)
            self.optimizer.update(self.guard, None if self.guard is None else output.loss)
        else:
            with torch.autocast(self.batches.device.type, self.autocast, cache_enabled=False):
                output = self.loss(batch, self.generator)
            self._learn_scaled(output.loss)
        self._tell(output)
        return batch, output

    def _learn_scaled(self, loss: Tensor) -> None:
        scaler = self.scaler
        if scaler is None or not scaler.is_enabled():
            loss.backward()
            self.optimizer.update(self.guard, None if self.guard is None else loss.detach())
            return
        scaler.scale(loss).backward()
        if self.guard is not None:
            judge(self.guard, loss.detach(), [])
        # The optimiser skips a step that is not finite by a flag on the device, so the host need not wait for it.
        scaler.step(self.optimizer)
        scaler.update()

    def _standing_obstacle(self, draws: bool = True) -> str | None:
        """What keeps any step from being replayed, whatever it computes; one that draws its rays, or not."""
        if is_watched():
            return "a mode, a transform or a profiler of torch watches"
        renderer, device, place = self.loss.renderer, self.batches.device, self.batches.place
        if device.type not in ("cpu", "cuda"):
            return f"it runs on {device.type}"
        if device.type != place.type or device.index not in (None, place.index):
            return f"its pictures are on {place}"
        if self.generator.device.type != device.type:
            return f"its random numbers are drawn on {self.generator.device.type}"
        if (chosen := backends.chosen("adam", device, torch.float32, backend=renderer.backend)) != "native":
            return f"it runs on the {chosen} backend"
        if self.autocast is not None:
            return "it runs under autocast"
        if draws and self.batches.fetch is not None:
            return "its pictures are read from disk"
        for part in (self.batches, self.loss, self.loss.term, renderer.sampler, self.optimizer, self.strategy):
            if part is not None and not type(part).__module__.startswith("voronerf."):
                return f"{type(part).__name__} may do in Python what is not seen"
        if (reason := self.loss.why_not_fused()) is not None:
            return reason
        learning = {id(p) for group in self.optimizer.param_groups for p in group["params"]}
        for name, parameter in cast(nn.Module, renderer.field).named_parameters():
            if parameter.requires_grad and id(parameter) not in learning:  # others read and drop its gradient
                return f"{name} needs a gradient and is not the optimizer's"
        return None

    def _guard(self) -> None:
        """Notes what the step that was made depends on."""
        renderer, optimizer, known = self.loss.renderer, self.optimizer, self.loss.radiance()
        if not isinstance(known, Radiance):
            return
        from voronerf.ops._core import native  # which is not everywhere

        self._known, self._guards, self._cpu = known, native.compiled.Guards(), native.cpu
        field, grid = cast(nn.Module, renderer.field), getattr(renderer.sampler, "grid", None)
        parts = (self.batches, self.loss, renderer, renderer.sampler, grid, self.strategy)
        dictionaries: list[dict[Any, Any]] = [vars(part) for part in parts if part is not None]
        dictionaries.append(renderer.fields)
        for module in field.modules():  # the router, perhaps in a wrapper
            for name, members in vars(module).items():
                if name in ("_parameters", "_buffers", "_modules") or name.endswith("_hooks"):
                    dictionaries.append(members)
        dictionaries += [*map(vars, known.router.module.modules()), optimizer.state, *optimizer.state.values()]
        for members in dictionaries:
            self._guards.add(members, "")
        self._guards.add(vars(optimizer), "steps_done")
        for group in optimizer.param_groups:
            self._guards.add(group, "lr")
        if self._on_gpu():  # a capture does not see which tensors it takes, as a recording does
            owners = self.batches, renderer.sampler, self.strategy, self.guard, optimizer.state, self._gradients
            for tensor in (*tensors_of(owners), *field.parameters(), *field.buffers()):
                self._guards.add_tensor(tensor, True)
        learning = (p for group in optimizer.param_groups for p in group["params"])
        self._parameters = [*dict.fromkeys((*field.parameters(), *learning))]
        self._objects, self._values = self._current()

    def _holds(self) -> bool:
        """Whether all is as it was noted."""
        if self._guards is None or not self._guards.hold():
            return False
        objects, values = self._current()
        if values != self._values or not all(map(operator.is_, objects, self._objects)):
            return False
        known = cast(Radiance, self._known)
        if known.cells.table is not None:  # of a field with a layer table, whose members are guarded
            return True
        now = self.loss.radiance()
        same = isinstance(now, Radiance) and now.networks is known.networks
        return same and all(map(operator.is_, cast(Radiance, now).cells.parameters, known.cells.parameters))

    def _current(self) -> tuple[list[Any], list[Any]]:
        """What is in no dictionary that is guarded: objects, and numbers."""
        router, optimizer = cast(Radiance, self._known).router, self.optimizer
        objects = [self.batches, self.loss, optimizer, self.strategy, self.guard, self.generator, self.autocast]
        objects += [router.assignment, router.temperature, router.backend, router.coords]
        values: list[Any] = [backends.threads(), self._cpu().isa, torch.is_grad_enabled(), len(optimizer.state)]
        values += [torch.are_deterministic_algorithms_enabled(), torch.backends.cuda.matmul.fp32_precision]
        values.append(backends.cpu_precision())
        for group in optimizer.param_groups:
            objects += group["params"]
            values += [len(group["params"]), tuple(group["betas"])]
        for parameter in self._parameters:
            hooks = parameter._backward_hooks, parameter._post_accumulate_grad_hooks
            values += [parameter.requires_grad, *([*each.values()] if each else [] for each in hooks)]
        return objects, values
