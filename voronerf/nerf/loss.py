"""The loss of a batch of rays, with its gradients. r rays, m samples of all rays (packed)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import Radiance, radiance_of, router_of
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.replay import Stage, replayed, run_stages
from voronerf.nerf.terms import LossAlongRays, RayValues, Slopes, Term, stage_of
from voronerf.nerf.volume import (
    Batch,
    Rendered,
    RenderOutput,
    Samples,
    composite_rays,
    evaluate_field,
    gradient_factors,
    render_samples,
)
from voronerf.ops._core import backends
from voronerf.ops._core.derivatives import run_backward, with_gradients
from voronerf.ops.network import OP, Tape
from voronerf.ops.render_loss import RenderLoss, render_loss
from voronerf.ops.rendered_gradient import rendered_gradient


@replayed
class RayLoss:
    """The loss of rays rendered from random samples: their mean squared or robust error, and further terms.

    If possible (:meth:`why_not_fused`), networks, colours, loss and gradients are fused into one operation for the
    forward and one for the backward pass. Otherwise torch differentiates the networks; all other parts are the same.

    Args:
        renderer: The networks and the sampler.
        terms: Further terms of the loss: a :class:`Term`, such as :class:`SparseDepth` or :class:`Surface`, or a
            function of the :class:`RayValues` and the :class:`Batch` that returns a scalar. Torch differentiates this
            function, with gradients for the networks alone. A term gets all rays; the last ``3 * batch.unseen`` have no
            target colour.
        robust: The scale of errors above which the loss is linear instead of squared; see `voronerf.ops.render_loss`.
            With a robust loss, differences between pictures, such as exposure, cause less fog. 0 for the squared error.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, SparseDepth, Stratified
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> clear = lambda rays, batch: 0.1 * (rays.opacity * (1 - rays.opacity)).mean()
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
        terms: Iterable[Term | Callable[[RayValues, Batch], Tensor]] = (),
        robust: float = 0.0,
    ) -> None:
        self.renderer, self.terms, self.robust = renderer, tuple(terms), robust

    def __call__(
        self, batch: Batch, generator: torch.Generator | None = None, *, backward: bool = False
    ) -> RenderOutput:
        """Computes the loss of a batch.

        Args:
            batch: The rays.
            generator: Random generator of the samples.
            backward: Whether this call itself adds the gradients to ``grad`` of the parameters, which is faster than
                ``loss.backward()``; the returned loss then has no gradient.

        Raises:
            ValueError: A term returns no scalar, or a target or a background needs a gradient.
        """
        output: RenderOutput = run_stages(self.stages(generator, backward), {"batch": batch})["output"]
        return output

    def stages(self, generator: torch.Generator | None, backward: bool) -> list[Stage]:
        """Returns the stages of a training step that compute the result "output" (`RenderOutput`) of the rays "batch".

        Args:
            generator: Random generator of the samples.
            backward: Whether to add the gradients at once, as in :meth:`__call__`.
        """
        draw, sampler = functools.partial(self._sample, generator), self.renderer.sampler
        sample = Stage.of_hook(sampler, "sample", "draw", function=draw, reads=("batch",))
        evaluate = Stage("evaluate", self._evaluate_any, ("batch", "samples", "before"), self.uses)
        terms = [stage_of(term) for term in self.terms]
        if terms:
            along = Stage("along", self._along, ("outputs", "rendered", "samples"))
            terms = [along, *terms, Stage("gradient", self._add_slopes, ("along", "rendered", "batch"))]
        learn = Stage("learn", functools.partial(self._learn, backward), ("rendered", "samples", "learning"))
        return [sample, evaluate, *terms, learn]

    def uses(self) -> Iterable[Any]:
        """Returns the objects that the evaluation of the loss reads, except the terms."""
        sampler = self.renderer.sampler
        return self, self.renderer, self.renderer.field, sampler, sampler.grid, self.radiance()

    def why_not_fused(self) -> str | None:
        """Returns the reason why networks, colours, loss and gradients are not fused; None if they are.

        The first step traces a module with ``fuse=True``, so the answer for such a module is known only after this
        step.
        """
        radiance = self.radiance()
        return radiance if isinstance(radiance, str) else None

    def radiance(self, samples: tuple[Tensor, Tensor] | None = None) -> Radiance | str:
        """Returns the field as a program for fused ops, or the reason why nothing is fused.

        For ``samples`` see `voronerf.nerf.radiance.radiance_of`.
        """
        renderer = self.renderer
        if renderer.sampler.grid is None:
            return "empty space is not skipped"
        return radiance_of(renderer.field, samples, inputs=6 if renderer.cones else 3)

    def _evaluate_any(self, batch: Batch, samples: Samples, before: Sequence[Rendered]) -> dict[str, Any]:
        """Evaluates the networks, fused if possible."""
        field, sampler = self.radiance(), self.renderer.sampler
        if isinstance(field, str) and sampler.grid is not None:  # the field may not be traced yet
            middle = (batch.near + batch.far)[:, None] / 2
            points = sampler.space.samples(batch.rays, middle, middle.expand(-1, 2))
            field = self.radiance((points.inputs, batch.rays.directions))
        if isinstance(field, str):
            return self._evaluate_unfused(batch, samples, before)
        return self._evaluate(field, batch, samples)

    def _evaluate(self, field: Radiance, batch: Batch, samples: Samples) -> dict[str, Any]:
        """Evaluates the networks, and computes the loss of the colours and its gradient."""
        renderer = self.renderer
        rows = field.rows(samples.inputs, batch.rays.directions, samples.ray_index)
        rows["cells"] = rows["cells"]._replace(rows=samples.rows)
        (raw,), tape = field.network(field.networks.raw).fwd(**rows, backend=renderer.backend)
        # A sample that almost no light reaches has a negligible gradient and is left out of the backward pass.
        outputs = raw.float(), field.networks.activation, HIDDEN
        rendered = self._render(*outputs, batch, samples)
        return {"outputs": outputs, "rendered": rendered, "learning": (self._learn_fused, tape, samples)}

    def _sample(self, generator: torch.Generator | None, batch: Batch) -> dict[str, Any]:
        renderer = self.renderer

        def render(name: str, samples: Samples) -> Rendered:
            arguments = renderer.fields[name], batch.rays, batch.far, samples, renderer.sampler.space
            return render_samples(*arguments, background=batch.background, backend=renderer.backend)

        ends = batch.near, batch.far
        samples, before = renderer.sampler.draw(render, batch.rays, *ends, jitter=True, generator=generator)
        return {"samples": samples, "before": before}

    def _evaluate_unfused(self, batch: Batch, samples: Samples, before: Sequence[Rendered]) -> dict[str, Any]:
        """Does the same as `_evaluate` for networks that torch differentiates."""
        values = evaluate_field(self.renderer.field, batch.rays, samples, self.renderer.sampler.space)
        raw = torch.cat((values[0], values[1][:, None]), 1).detach()
        outputs = raw, {"activated": True}, 0.0
        rendered = self._render(*outputs, batch, samples)
        return {
            "outputs": outputs,
            "rendered": rendered,
            "learning": (self._learn_unfused, values, batch, samples, before),
        }

    def _render(
        self, raw: Tensor, activation: dict[str, Any], hidden: float, batch: Batch, samples: Samples
    ) -> RenderLoss:
        """Computes the loss of the colours and its gradient with respect to the raw outputs."""
        for name in ("target", "background"):
            if (colours := getattr(batch, name)) is not None and colours.requires_grad:
                raise ValueError(f"RayLoss: {name} must not require a gradient; only the networks are trained")
        return render_loss(
            raw,
            samples.deltas,
            samples.ray_offsets,
            batch.target,
            background=batch.background,
            **activation,
            robust=self.robust,
            hidden=hidden,
            triples=batch.unseen,
            backend=self.renderer.backend,
        )

    def _along(
        self, outputs: tuple[Tensor, dict[str, Any], float], rendered: RenderLoss, samples: Samples
    ) -> dict[str, Any]:
        loss, colour, weights, density, error, _ = rendered
        rays = Slopes.zeros(weights, error), colour, weights, density, error, samples
        return {"along": LossAlongRays(loss, *rays, *outputs, self.renderer.backend)}

    def _add_slopes(self, along: LossAlongRays, rendered: RenderLoss, batch: Batch) -> None:
        """Carries the gradients that terms have added to the slopes back along the rays, to the raw outputs."""
        samples = along.samples
        rendered_gradient(
            rendered.gradient,
            along.raw,
            along.density,
            samples.depths,
            samples.deltas,
            along.weights,
            samples.ray_offsets,
            background=batch.background,
            **{f"of_{name}": slope for name, slope in along.slopes._asdict().items()},
            **along.activation,
            hidden=along.hidden,
            backend=along.backend,
        )

    def _learn(
        self, backward: bool, rendered: RenderLoss, samples: Samples, learning: tuple[Any, ...]
    ) -> dict[str, Any]:
        learn, *arguments = learning
        loss = learn(*arguments, rendered, not backward)
        rays = rendered.error, rendered.weights, rendered.density, samples, rendered.colour
        return {"output": RenderOutput(loss, *rays), "learning": ()}  # frees the autograd tape

    def _learn_fused(self, tape: Tape, samples: Samples, rendered: RenderLoss, defer: bool) -> Tensor:
        if (full := self.renderer.sampler.space.full_gradient) is not None:
            rendered.gradient.mul_(gradient_factors(samples.depths, full)[:, None])
        return tape.learn(rendered.loss, [rendered.gradient], defer=defer)

    def _learn_unfused(
        self,
        values: tuple[Tensor, Tensor],
        batch: Batch,
        samples: Samples,
        before: Sequence[Rendered],
        rendered: RenderLoss,
        defer: bool,
    ) -> Tensor:
        """Passes the gradients of colours and densities to the networks, and adds the losses of earlier passes."""
        gradient = rendered.gradient
        loss = with_gradients(rendered.loss, values, [gradient[:, :3], gradient[:, 3]])
        if before:
            last = composite_rays(*values, batch.far, samples, batch.background, self.renderer.backend)
            with_target = len(batch.rays) - 3 * batch.unseen
            for first in before:
                target = torch.cat((batch.target[:with_target], first.colour[with_target:].detach()))
                loss = loss + self.renderer.sampler.earlier_loss(first, last, target)
        return run_backward(loss, defer)

    def explain(self) -> str:
        """Describes in a few lines how a step is computed, and what prevents a faster computation."""
        renderer = self.renderer
        lines = [f"samples: {renderer.sampler.explain()}"]
        if (obstacle := self.why_not_fused()) is not None:
            lines += ["loss: networks, colours and loss are separate operations", f"not faster: {obstacle}"]
            routers = ((name, router_of(field)) for name, field in renderer.fields.items())
            return "\n".join([*lines, *(f"{name}: {router.explain()}" for name, router in routers if router)])
        place = renderer.device, torch.float32
        chosen = backends.chosen(OP, *place, backend=renderer.backend)
        lines.append(f"loss: networks, colours, loss and gradients in one operation, on the {chosen} backend")
        if chosen != "native":
            reason = backends.why_not(OP, "native", *place)
            lines.append(f"not faster: {reason or f'--backend {renderer.backend}'}")
        return "\n".join(lines)
