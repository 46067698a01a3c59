"""The loss of a batch of rays, with gradients. r rays, m samples of all rays (packed)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import Radiance, radiance_of, router_of
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.segment import Stage, in_python, replayed, run_stages
from voronerf.nerf.terms import LossAlongRays, Seen, Term, stages_of
from voronerf.nerf.volume import Batch, Rendered, RenderOutput, Samples, ask, composed, render_samples, shares_of
from voronerf.ops._core import backends
from voronerf.ops._core.derivatives import learnt, with_gradients
from voronerf.ops.forward_with_tape import Tape, forward_with_tape
from voronerf.ops.render_loss import render_loss_gradient


@replayed
class RayLoss:
    """The mean squared or robust error of rays at random samples, and further terms.

    Where nothing keeps it from that (:meth:`why_not_fused`), networks, colours, loss and gradients are one operation
    each way; else torch differentiates the networks. All that is behind their outputs is the same either way.

    Args:
        renderer: Networks and sampler.
        terms: Further terms, beside the error of the colours: a :class:`Term`, such as :class:`SparseDepth` and
            :class:`Surface`, or a function of :class:`Seen` rays and their :class:`Batch` that gives a scalar, and
            that torch differentiates. The networks alone learn from it. It is given all rays: of the last
            ``3 * batch.unseen``, no picture shows the colour.
        robust: Scale of the errors beyond which the loss of a ray is not squared: see `voronerf.ops.render_loss`. What
            differs from picture to picture, such as exposure, is no reason for fog then. 0 is off.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, SparseDepth, Stratified
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> clear = lambda seen, batch: 0.1 * (seen.opacity * (1 - seen.opacity)).mean()
        >>> loss = RayLoss(Renderer({"field": router}, Stratified(8)), terms=[SparseDepth(0.003), clear])
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> output = loss(Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3)), backward=True)
        >>> router.module.colour.weight.grad is not None
        True
        >>> print(loss.explain())
        samples: Stratified, 8 a ray
        loss: networks, colours and loss are separate operations
        not faster: empty space is not skipped
        field: forward: fused
    """

    def __init__(
        self,
        renderer: Renderer,
        *,
        terms: Iterable[Term | Callable[[Seen, Batch], Tensor]] = (),
        robust: float = 0.0,
    ) -> None:
        self.renderer, self.terms, self.robust = renderer, tuple(terms), robust

    def __call__(
        self, batch: Batch, generator: torch.Generator | None = None, *, backward: bool = False
    ) -> RenderOutput:
        """Computes the loss of a batch.

        Args:
            batch: The rays.
            generator: Of random samples.
            backward: Whether gradients are added to those of the parameters at once, as ``loss.backward()`` does it,
                in less time; the loss has none then.

        Raises:
            ValueError: A term that gives no scalar; a target or a background that needs a gradient.
        """
        field = self.radiance()
        if isinstance(field, str) and self.renderer.sampler.grid is not None:  # perhaps not traced yet
            middle = (batch.near + batch.far)[:, None] / 2
            samples = self.renderer.sampler.space.samples(batch.rays, middle, middle.expand(-1, 2))
            field = self.radiance((samples.inputs, batch.rays.directions))
        found: RenderOutput = run_stages(self.stages(field, generator, backward), {"batch": batch})["output"]
        return found

    def stages(
        self,
        field: Radiance | str,
        generator: torch.Generator | None,
        backward: bool,
        now: Callable[[Any], Any] = lambda held: held,
    ) -> list[Stage]:
        """The stages that lead from "batch" to "output".

        Args:
            field: The result of :meth:`radiance`.
            generator: Draws the random samples.
            backward: Whether gradients are added at once, as in a call.
            now: Gives, in a stage in Python, what replays have filled.
        """
        sampler = self.renderer.sampler
        if isinstance(field, str):
            sample = Stage("sample", functools.partial(self._draw, generator), ("batch",))
            look = Stage("look", self._look_apart, ("batch", "samples", "before"))
        else:
            name, own = f"{type(sampler).__name__}.sample", in_python(sampler, "sample")
            sample = Stage(name, functools.partial(self._sample, generator), ("batch",), own)
            look = Stage("look", functools.partial(self._look, field), ("batch", "samples"))
        terms = [stage for number, term in enumerate(self.terms) for stage in stages_of(number, term, now)]
        return [sample, look, *terms, Stage("learn", functools.partial(self._learn, backward), ("along", "learning"))]

    def why_not_fused(self) -> str | None:
        """The reason why networks, colours, loss and gradients are not one operation; None if they are.

        What a module with ``fuse=True`` computes is known from its first step on, which traces it.
        """
        radiance = self.radiance()
        return radiance if isinstance(radiance, str) else None

    def radiance(self, samples: tuple[Tensor, Tensor] | None = None) -> Radiance | str:
        """The program of the field, or why the operations are separate; samples as for `radiance_of`."""
        renderer = self.renderer
        if renderer.sampler.grid is None:
            return "empty space is not skipped"
        return radiance_of(renderer.field, samples, inputs=6 if renderer.cones else 3)

    def _sample(self, generator: torch.Generator | None, batch: Batch) -> dict[str, Any]:
        draw = self.renderer.sampler.sample
        return {"samples": draw(batch.rays, batch.near, batch.far, jitter=True, generator=generator)}

    def _look(self, field: Radiance, batch: Batch, samples: Samples) -> dict[str, Any]:
        """Evaluates the networks, and computes the loss of the colours with its gradient."""
        renderer = self.renderer
        network = field.arguments(samples.inputs, batch.rays.directions, samples.ray_index)
        tape = forward_with_tape({**network, "rows": samples.rows}, backend=renderer.backend)
        # What next to no light reaches learns nothing, and takes no part in the backward pass.
        along = self._along(tape.raw, field.rule, batch, samples, HIDDEN)
        return {"along": along, "learning": (self._learn_by, tape)}

    def _draw(self, generator: torch.Generator | None, batch: Batch) -> dict[str, Any]:
        renderer = self.renderer

        def look(name: str, samples: Samples) -> Rendered:
            given = renderer.fields[name], batch.rays, batch.far, samples, renderer.sampler.space
            return render_samples(*given, background=batch.background, backend=renderer.backend)

        ends = batch.near, batch.far
        samples, before = renderer.sampler.draw(look, batch.rays, *ends, jitter=True, generator=generator)
        return {"samples": samples, "before": before}

    def _look_apart(self, batch: Batch, samples: Samples, before: Sequence[Rendered]) -> dict[str, Any]:
        """Does the same as `_look`, where torch differentiates the networks."""
        values = ask(self.renderer.field, batch.rays, samples, self.renderer.sampler.space)
        raw = torch.cat((values[0], values[1][:, None]), 1).detach()
        along = self._along(raw, {"activated": True}, batch, samples, 0.0)
        return {"along": along, "learning": (self._learn_apart, values, batch, before)}

    def _along(self, raw: Tensor, rule: dict[str, Any], batch: Batch, samples: Samples, hidden: float) -> LossAlongRays:
        """The loss of the colours of rays."""
        backend = self.renderer.backend
        for name in ("target", "background"):
            if (colours := getattr(batch, name)) is not None and colours.requires_grad:
                raise ValueError(
                    f"RayLoss: {name} must need no gradient, which the networks alone have, got one that does"
                )
        result, gradient = render_loss_gradient(
            raw,
            samples.deltas,
            samples.ray_offsets,
            batch.target,
            background=batch.background,
            **rule,
            robust=self.robust,
            hidden=hidden,
            triples=batch.unseen,
            backend=backend,
        )
        found = result.colour, result.weights, result.density, result.error
        return LossAlongRays(result.loss, gradient, raw, rule, *found, samples, hidden, backend)

    def _learn(self, backward: bool, along: LossAlongRays, learning: tuple[Any, ...]) -> dict[str, Any]:
        learn, *held = learning
        loss = learn(*held, along, not backward)
        found = along.error, along.weights, along.density, along.samples, along.colour
        return {"output": RenderOutput(loss, *found)}

    def _learn_by(self, tape: Tape, along: LossAlongRays, defer: bool) -> Tensor:
        if (full := self.renderer.sampler.space.full_gradient) is not None:
            along.gradient.mul_(shares_of(along.samples.depths, full)[:, None])
        return tape.backward(along.loss, along.gradient, defer=defer)

    def _learn_apart(
        self,
        values: tuple[Tensor, Tensor],
        batch: Batch,
        before: Sequence[Rendered],
        along: LossAlongRays,
        defer: bool,
    ) -> Tensor:
        """Colours and densities take the gradient to the networks; passes before have losses of their own."""
        loss = with_gradients(along.loss, values, [along.gradient[:, :3], along.gradient[:, 3]])
        if before:
            last = composed(*values, batch.far, along.samples, batch.background, along.backend)
            seen = len(batch.rays) - 3 * batch.unseen
            for first in before:
                target = torch.cat((batch.target[:seen], first.colour[seen:].detach()))
                loss = loss + self.renderer.sampler.loss_before(first, last, target)
        return learnt(loss, defer)

    def explain(self) -> str:
        """How a step is computed, and what keeps it from a faster way: some lines."""
        renderer = self.renderer
        lines = [f"samples: {renderer.sampler.explain()}"]
        if (obstacle := self.why_not_fused()) is not None:
            lines += ["loss: networks, colours and loss are separate operations", f"not faster: {obstacle}"]
            routers = ((name, router_of(field)) for name, field in renderer.fields.items())
            return "\n".join([*lines, *(f"{name}: {router.explain()}" for name, router in routers if router)])
        where = renderer.device, torch.float32
        chosen = backends.chosen("forward_with_tape", *where, backend=renderer.backend)
        lines.append(f"loss: networks, colours, loss and gradients in one operation, on the {chosen} backend")
        if chosen != "native":
            reason = backends.why_not("forward_with_tape", "native", *where)
            lines.append(f"not faster: {reason or f'--backend {renderer.backend}'}")
        return "\n".join(lines)
