"""Terms of the loss of rays, one after another: each adds to the loss, and to its gradient along the rays.

r rays, m samples of all rays (packed).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from voronerf.nerf.segment import Stage, in_python, replayed
from voronerf.nerf.volume import Batch, Samples, normalised
from voronerf.ops.formulas import activate
from voronerf.ops.rendered_gradient import rendered_gradient
from voronerf.ops.smooth_depth_gradient import smooth_depth_gradient
from voronerf.ops.sparse_depth_gradient import sparse_depth_gradient
from voronerf.ops.surface_gradient import surface_gradient


class LossAlongRays(NamedTuple):
    """The loss of rays, and its gradient to what the networks have put out for their samples: what a :class:`Term` has.

    Attributes:
        loss: [], to which terms add.
        gradient: [m, 4], to ``raw``; to which terms add.
        raw: [m, 4], of the networks, colour and density before their activations or ``activated``.
        rule: How to read ``raw``: ``density_scale`` or ``activated`` of `voronerf.ops.render_loss`.
        colour: [r, 3] of the rays, background included.
        weights: [m], contributions of the samples to their rays.
        density: [m], per scene unit.
        error: [r], the squared error of the colour of each ray, summed over the channels.
        samples: Where the networks were asked.
        hidden: Share of the light; samples that no more than it reaches need no gradient.
        backend: Of the ops.

    Examples:
        >>> from voronerf.nerf import LossAlongRays
        >>> LossAlongRays._fields[:4]
        ('loss', 'gradient', 'raw', 'rule')
    """

    loss: Tensor
    gradient: Tensor
    raw: Tensor
    rule: dict[str, Any]
    colour: Tensor
    weights: Tensor
    density: Tensor
    error: Tensor
    samples: Samples
    hidden: float
    backend: str

    def add_gradient(self, batch: Batch, **slopes: Tensor) -> None:
        """Adds to ``gradient`` what follows from gradients to what the rays show: see `voronerf.ops.rendered_gradient`.

        Args:
            batch: The rays.
            slopes: ``colour`` [r, 3], ``opacity`` [r], ``depth`` [r] that is not normalised, ``weights`` [m], ``rgb``
                [m, 3], ``density`` [m].
        """
        samples = self.samples
        lengths = self.density, samples.depths, samples.deltas, self.weights, samples.ray_offsets
        options: dict[str, Any] = {"hidden": self.hidden, **self.rule, "backend": self.backend}
        options |= {f"of_{name}": slope for name, slope in slopes.items()}
        rendered_gradient(self.gradient, self.raw, *lengths, background=batch.background, **options)


class Term(Protocol):
    """A term of :class:`RayLoss` that knows its own gradient.

    It is called once in each step, after the networks and the error of the colours, before the backward pass, and after
    the terms before it. A class that is `replayed` is recorded with the step; another one is called in Python.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, Stratified
        >>> class Thin:  # densities, with a factor that grows
        ...     factor = 0.0
        ...     def add(self, along, batch):
        ...         self.factor += 0.01
        ...         along.loss.add_(self.factor * along.density.mean())
        ...         along.gradient[:, 3].add_(self.factor / len(along.density))  # of a field that has activated
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[Thin()])
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> output = loss(Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3)))
        >>> loss.terms[0].factor
        0.01
    """

    def add(self, along: LossAlongRays, batch: Batch) -> None:
        """Adds, in place, to ``along.loss`` and to ``along.gradient``.

        Args:
            along: What the rays have shown; all else of it stays as it is.
            batch: The rays; for the last ``3 * batch.unseen`` no picture shows the colour.
        """


@replayed
class SparseDepth:
    """Light that does not come from where the points of a sparse model are: see `voronerf.ops.sparse_depth_gradient`.

    Args:
        factor: On the mean over the rays through points.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import RayLoss, Renderer, SparseDepth, Stratified
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[SparseDepth(0.003)])
    """

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def add(self, along: LossAlongRays, batch: Batch) -> None:
        """See :class:`Term`; a batch without points adds nothing."""
        samples, points = along.samples, batch.sparse_depths
        if points is not None:
            lengths = along.density, samples.depths, samples.deltas, along.weights, samples.ray_offsets
            given = along.loss, along.gradient, *lengths, points
            sparse_depth_gradient(*given, factor=self.factor, **along.rule, backend=along.backend)


@replayed
class SmoothDepth:
    """Depths of unseen rays that lie on no plane with those of their neighbours.

    See `voronerf.ops.smooth_depth_gradient`.

    Args:
        factor: On the mean over the triples of rays.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import RayLoss, Renderer, SmoothDepth, Stratified
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[SmoothDepth(0.1)])
    """

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def add(self, along: LossAlongRays, batch: Batch) -> None:
        """See :class:`Term`; a batch without unseen rays adds nothing."""
        samples = along.samples
        if batch.unseen:
            lengths = along.density, samples.depths, samples.deltas, along.weights, samples.ray_offsets
            given = along.loss, along.gradient, *lengths, batch.far
            options: dict[str, Any] = {"hidden": along.hidden, **along.rule, "backend": along.backend}
            smooth_depth_gradient(*given, triples=batch.unseen, factor=self.factor, **options)


@replayed
class Surface:
    """Light along a ray that does not come from one surface: see `voronerf.ops.surface_gradient`.

    Args:
        distortion: Factor on the mean over the rays of the distortion loss of mip-NeRF 360.
        orientation: The same on an orientation loss after Ref-NeRF.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import RayLoss, Renderer, Stratified, Surface
        >>> terms = [Surface(distortion=0.005, orientation=0.02)]
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=terms)
    """

    def __init__(self, *, distortion: float = 0.0, orientation: float = 0.0) -> None:
        self.distortion, self.orientation = distortion, orientation

    def add(self, along: LossAlongRays, batch: Batch) -> None:
        """See :class:`Term`."""
        samples = along.samples
        lengths = along.density, samples.depths, samples.deltas, along.weights, samples.ray_offsets
        given = along.loss, along.gradient, *lengths, batch.near, batch.far
        options: dict[str, Any] = {"hidden": along.hidden, **along.rule, "backend": along.backend}
        surface_gradient(*given, distortion=self.distortion, orientation=self.orientation, **options)


class Seen:
    """Rays as a term in torch sees them. What is read of them has gradients, but for the places of the samples.

    Tensors are the step's own memory: they hold what they do until the next step, and nothing is to be written to them.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Renderer, Seen, Stratified
        >>> def clear(seen: Seen, batch: Batch):  # rays end at a surface, or nowhere
        ...     return 0.01 * (seen.opacity * (1 - seen.opacity)).mean()
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[clear])
    """

    def __init__(self, along: LossAlongRays, batch: Batch, now: Callable[[Any], Any]) -> None:
        self._along, self._batch, self._now = along, batch, now
        self.leaves: dict[str, Tensor] = {}  # what was read, by name

    def _leaf(self, name: str, value: Tensor) -> Tensor:
        self.leaves[name] = leaf = value.detach().requires_grad_()
        return leaf

    def _sum(self, values: Tensor) -> Tensor:
        """Sums [r] of values of the samples."""
        return torch.segment_reduce(values, "sum", offsets=self._now(self._along.samples.ray_offsets), unsafe=True)

    @functools.cached_property
    def colour(self) -> Tensor:
        """[r, 3], the background included."""
        return self._leaf("colour", self._now(self._along.colour))

    @functools.cached_property
    def opacity(self) -> Tensor:
        """[r], 0..1: the sum of the weights."""
        return self._leaf("opacity", self._sum(self._now(self._along.weights)))

    @functools.cached_property
    def depth(self) -> Tensor:
        """[r], expected distance, normalised by the opacity; the far end for a ray with opacity 0."""
        sums = self._sum(self._now(self._along.weights) * self._now(self._along.samples.depths))
        return normalised(self._leaf("depth", sums), self.opacity, self._now(self._batch.far))

    @functools.cached_property
    def weights(self) -> Tensor:
        """[m], the contribution of each sample."""
        return self._leaf("weights", self._now(self._along.weights))

    @functools.cached_property
    def rgb(self) -> Tensor:
        """[m, 3], the colour of each sample."""
        return self._leaf("rgb", activate(self._now(self._along.raw), **self._along.rule)[0])

    @functools.cached_property
    def density(self) -> Tensor:
        """[m], per scene unit."""
        return self._leaf("density", self._now(self._along.density))

    @functools.cached_property
    def samples(self) -> Samples:
        """Where the networks were asked."""
        found: Samples = self._now(self._along.samples)
        return found


class Differentiated:
    """A term that torch differentiates: a function of `Seen` rays and their batch.

    Its lines alone run in Python, and torch differentiates no more than them. Their gradients to what they read are
    taken further by an op, which a step replays.

    Args:
        function: Gives a scalar.
    """

    def __init__(self, function: Callable[[Seen, Batch], Tensor]) -> None:
        self.function = function

    def differentiate(self, now: Callable[[Any], Any], along: LossAlongRays, batch: Batch) -> dict[str, Tensor]:
        """Adds to the loss; gives the gradients to what was read, by its name."""
        seen = Seen(along, batch, now)
        with torch.enable_grad():
            term = self.function(seen, now(batch))
        if not isinstance(term, Tensor) or term.dim():
            came = list(term.shape) if isinstance(term, Tensor) else repr(term)[:60]
            raise ValueError(f"RayLoss: a term must give a scalar tensor, got {came}")
        now(along.loss).add_(term.detach())
        if not (term.requires_grad and seen.leaves):
            return {}
        slopes = torch.autograd.grad(term, [*seen.leaves.values()], allow_unused=True)
        return {name: slope for name, slope in zip(seen.leaves, slopes, strict=True) if slope is not None}

    def take_further(self, along: LossAlongRays, batch: Batch, slopes: Mapping[str, Tensor]) -> None:
        """Adds to the gradient what follows from gradients to what was read."""
        if slopes:
            along.add_gradient(batch, **slopes)


def stages_of(number: int, term: Term | Callable[[Seen, Batch], Tensor], now: Callable[[Any], Any]) -> list[Stage]:
    """What a step does of a term, which reads "along" and "batch".

    Args:
        number: Of the term, which is one of several.
        term: That of :class:`RayLoss`.
        now: Gives, in Python, what replays have filled.
    """
    if hasattr(term, "add"):
        return [Stage(f"{type(term).__name__}.add", term.add, ("along", "batch"), in_python(term, "add"))]
    own, slopes = Differentiated(term), f"slopes {number}"
    name = getattr(term, "__qualname__", type(term).__qualname__)
    return [
        Stage(name, lambda *seen: {slopes: own.differentiate(now, *seen)}, ("along", "batch"), python=True, lazy=True),
        Stage("gradients", own.take_further, ("along", "batch", slopes)),
    ]
