"""A step of a training, recorded once and replayed from then on. r rays, m samples of all rays."""

from __future__ import annotations

import operator
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches
from voronerf.nerf.loss import Batch, RayLoss, RenderOutput
from voronerf.nerf.radiance import Radiance
from voronerf.nerf.split import SplitStrategy
from voronerf.ops import Guard
from voronerf.ops._core import backends, native
from voronerf.ops._core.capture import Capture
from voronerf.ops._core.custom_op import is_watched
from voronerf.ops._core.recording import Recording
from voronerf.ops.adam.reference import judge

#: After a recording that no step has replayed, the next 1, 2, 4, ... steps run as they are, so many at most.
LONGEST_WAIT = 64


class StepOutput:
    """What a step has found, until the next step of the same object.

    Attributes:
        loss: [], without gradients.

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
        self.loss = output.loss.detach()

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
        return self._now(self._batch)

    @property
    def output(self) -> RenderOutput:
        """What :class:`RayLoss` gave; its tensors are the step's own memory."""
        return self._now(self._output)

    def _now(self, recorded: Any) -> Any:
        """Tensors of the recorded step as they are now, in whatever holds them."""
        if self._recording is None:
            return recorded
        if isinstance(recorded, Tensor):
            return self._recording.now(recorded)
        if isinstance(recorded, tuple):
            return type(recorded)(*map(self._now, recorded))
        if hasattr(recorded, "__dataclass_fields__"):
            return type(recorded)(**{name: self._now(value) for name, value in vars(recorded).items()})
        return recorded


class TrainingStep:
    """A step of a training: rays, loss, gradients, what the sampler and the splits learn, and the optimiser.

    The calls of the compiled module that a step makes are recorded, and made again by the steps that follow, in one
    call for each of them: no Python runs in between, and threads are woken once. Results are the same bits. On CUDA, a
    step is captured in a CUDA graph, after one of its kind; another number of rays is captured anew. What keeps a step
    from that (:meth:`explain`) lets it run as it is. What the objects are set to is followed, by their
    attributes; an object that is changed inside needs :meth:`forget`.

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
        >>> losses = [float(step(rays=32).loss) for _ in range(10)]
        >>> losses[-1] < losses[0]
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
        strategy: SplitStrategy | None = None,
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
        self._made: tuple[Batch, RenderOutput] | None = None  # when it was recorded
        self._gradients = list[tuple[nn.Parameter, Tensor]]()
        self._known: Radiance | None = None  # of the last step
        self._depends = list[Any](), list[Any]()
        self._obstacle = "no step was made yet"

    def explain(self) -> str:
        """Whether steps are replayed, and what keeps them from it."""
        if self._recording is None:
            return f"step: runs as it is, since {self._obstacle}"
        if isinstance(self._recording, Capture):
            return "step: captured and replayed as a CUDA graph"
        return f"step: recorded and replayed, {len(self._recording)} calls"

    def __call__(self, rays: int) -> StepOutput:
        """Makes a step with so many rays."""
        self._rays = rays
        recording, depends, watched = self._recording, self._what_it_depends_on(), is_watched()
        if recording is not None and not watched and _same(depends, self._depends):
            if recording.replay(backends.threads()):
                self._wait = self._left = 0
                for parameter, gradient in self._gradients:
                    parameter.grad = gradient
                batch, output = cast(Any, self._made)
                return StepOutput(batch, output, recording if isinstance(recording, Recording) else None)
        elif obstacle := "a mode, a transform or a profiler of torch watches" if watched else self._standing_obstacle():
            self.forget()
            self._obstacle = obstacle
            return StepOutput(*self._run(rays))
        if self._left:
            self._left -= 1
            return StepOutput(*self._run(rays))
        return self._record(_same(depends, self._depends))

    def _record(self, known: bool) -> StepOutput:
        """A step as it is, recorded or captured if nothing keeps it from that.

        Args:
            known: Whether the step before was of this kind, so that what a first one prepares is there.
        """
        before, on_gpu = self._recording, self._on_gpu()
        if not on_gpu or known:
            self._left, self._wait = self._wait, min(2 * self._wait or 1, LONGEST_WAIT)
        self.forget()
        if not on_gpu:
            with Recording() as recording:
                made = self._run(recording.count(lambda: self._rays))
            self._keep(recording, made)
        elif known:
            made = self._capture(before if isinstance(before, Capture) else None)
        else:
            made, self._obstacle = self._run(self._rays), "no step of its kind was made before"
        self._depends = self._what_it_depends_on()
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

    def _with_gradients(self) -> list[tuple[nn.Parameter, Tensor]]:
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        return [(p, p.grad) for p in parameters if p.grad is not None]

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
        self.loss.renderer.sampler.step_post_backward(output)
        if self.strategy is not None:
            self.strategy.step_post_backward(output)
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

    def _standing_obstacle(self) -> str | None:
        """What keeps any step from being replayed, whatever it computes."""
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
        if self.batches.fetch is not None:
            return "its pictures are read from disk"
        for part in (self.batches, self.loss, renderer.sampler, self.optimizer, self.strategy):
            if part is not None and not type(part).__module__.startswith("voronerf."):
                return f"{type(part).__name__} may do in Python what is not seen"
        return self.loss.why_not_fused()

    def _what_it_depends_on(self) -> tuple[list[Any], list[Any]]:
        """What a recording holds for: objects, and values that may be equal without being the same object."""
        renderer, optimizer, strategy = self.loss.renderer, self.optimizer, self.strategy
        objects: list[Any] = [self.guard, self.generator, self.autocast, optimizer.state, native.cpu(), renderer.field]
        for part in (self.batches, self.loss, renderer, renderer.sampler, strategy):
            objects += () if part is None else part.__dict__.values()
        known: Any = self._known
        if known is None or not known.router.gives(known.cells):
            known = self.loss.radiance()
        if isinstance(known, Radiance):
            router = known.router
            objects += [known.networks, router.diagram, router.frozen_cells]
            objects += [router.assignment, router.temperature, router.backend]
            objects += known.cells.parameters
            self._known = known
        values: list[Any] = [torch.is_grad_enabled(), len(optimizer.state)]
        values += [torch.are_deterministic_algorithms_enabled(), torch.backends.cuda.matmul.fp32_precision]
        for group in optimizer.param_groups:
            objects += [group["betas"], group["eps"], group.get("sparse")]
            for own in group["params"]:
                objects += [own, own._backward_hooks, own._post_accumulate_grad_hooks]
                values += [own.data_ptr(), own.requires_grad]
        return objects, values


def _same(one: tuple[list[Any], list[Any]], other: tuple[list[Any], list[Any]]) -> bool:
    """Whether the same objects and equal values are in both."""
    return len(one[0]) == len(other[0]) and all(map(operator.is_, one[0], other[0])) and one[1] == other[1]
