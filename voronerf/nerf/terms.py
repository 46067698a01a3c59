"""Terms of the loss of rays; each term adds to the loss, and to its gradients with respect to the rendered values.

r rays, m samples of all rays (packed).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from voronerf.nerf.replay import Stage, replayed
from voronerf.nerf.volume import Batch, Samples, normalised
from voronerf.ops._core.rows import new_zeros, rows_of
from voronerf.ops.formulas import activate
from voronerf.ops.ray_losses import smooth_depth_loss, sparse_depth_loss, surface_loss


class Slopes(NamedTuple):
    """The gradients of a loss with respect to the values of rays and samples, to which a :class:`Term` adds in place.

    `voronerf.ops.rendered_gradient` carries the sums of all terms to the networks.

    Attributes:
        colour: [r, 3], with respect to the colours of the rays.
        opacity: [r], with respect to the opacities of the rays.
        depth: [r], with respect to the depths of the rays, the sums of weights times depths.
        weights: [m], with respect to the contributions of the samples to their rays.
        rgb: [m, 3], with respect to the colours of the samples.
        density: [m], with respect to the densities at the samples, except through the weights.

    Examples:
        >>> from voronerf.nerf import Slopes
        >>> Slopes._fields
        ('colour', 'opacity', 'depth', 'weights', 'rgb', 'density')
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor
    rgb: Tensor
    density: Tensor

    @classmethod
    def zeros(cls, weights: Tensor, error: Tensor) -> Slopes:
        """Returns gradients of 0, with m and r, dtypes and devices from ``weights`` [m] and ``error`` [r]."""
        m, r = rows_of(weights), rows_of(error)
        of_rays = new_zeros(error, r, 3), new_zeros(error, r), new_zeros(error, r)
        return cls(*of_rays, new_zeros(weights, m), new_zeros(weights, m, 3), new_zeros(weights, m))


class LossAlongRays(NamedTuple):
    """The loss of rays, and the values of rays and samples: the input of a :class:`Term`.

    Attributes:
        loss: [], the loss, to which terms add.
        slopes: The gradients with respect to the values below, to which terms add.
        colour: [r, 3], the colours of the rays, background included.
        weights: [m], contributions of the samples to their rays.
        density: [m], the density at each sample per scene unit.
        error: [r], the squared error of the colour of each ray, summed over the channels.
        samples: The samples at which the networks were evaluated.
        raw: [m, 4], the outputs of the networks: colour and density, before their activations or, with the option
            ``activated``, after them.
        activation: The option of `voronerf.ops.render_loss` that tells how to read ``raw``: ``density_scale`` or
            ``activated``.
        hidden: A sample whose transmittance is at most this value is hidden, and gets no gradient.
        backend: The backend of the ops.

    Examples:
        >>> from voronerf.nerf import LossAlongRays
        >>> LossAlongRays._fields[:4]
        ('loss', 'slopes', 'colour', 'weights')
    """

    loss: Tensor
    slopes: Slopes
    colour: Tensor
    weights: Tensor
    density: Tensor
    error: Tensor
    samples: Samples
    raw: Tensor
    activation: dict[str, Any]
    hidden: float
    backend: str


class Term(Protocol):
    """A term of :class:`RayLoss` that computes its own gradient.

    Each step calls it once, after the evaluation of the networks and the colour loss, and before the backward pass.
    Terms are called in their order. A term computes gradients with respect to the values of rays and samples; one op
    carries the gradients of all terms back along the rays. A class that is `replayed` is recorded with the step; any
    other class is called in Python.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, Stratified
        >>> class Thin:  # the mean density, with a growing factor
        ...     factor = 0.0
        ...     def add(self, along, batch):
        ...         self.factor += 0.01
        ...         along.loss.add_(self.factor * along.density.mean())
        ...         along.slopes.density.add_(self.factor / len(along.density))
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[Thin()])
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> output = loss(Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3)))
        >>> loss.terms[0].factor
        0.01
    """

    def add(self, along: LossAlongRays, batch: Batch) -> None:
        """Adds, in place, to ``along.loss`` and to the tensors of ``along.slopes``.

        Args:
            along: The rendered rays; a term changes only their loss and slopes.
            batch: The rays; the last ``3 * batch.unseen`` have no target colour.
        """


@replayed
class SparseDepth:
    """A depth loss: light of a ray should come from the point of the sparse (SfM) model on this ray.

    See `voronerf.ops.sparse_depth_loss`.

    Args:
        factor: The factor on the mean of this loss over the rays through points.

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
            lengths = samples.depths, samples.deltas, along.weights, samples.ray_offsets
            arguments = along.loss, along.slopes.weights, *lengths, points
            sparse_depth_loss(*arguments, factor=self.factor, backend=along.backend)


@replayed
class SmoothDepth:
    """A loss on non-planar depths, for triples of neighbouring rays from positions without a camera.

    The triples are the last rays of a batch (``Batch.unseen``). See `voronerf.ops.smooth_depth_loss`.

    Args:
        factor: The factor on the mean of this loss over the triples of rays.

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
            rays = samples.depths, along.weights, samples.ray_offsets, batch.far
            options: dict[str, Any] = {"factor": self.factor, "backend": along.backend}
            smooth_depth_loss(along.loss, along.slopes.weights, *rays, triples=batch.unseen, **options)


@replayed
class Surface:
    """A loss on the light of a ray that does not come from one surface; see `voronerf.ops.surface_loss`.

    Args:
        distortion: The factor on the distortion loss of mip-NeRF 360, a mean over the rays.
        orientation: The factor on an orientation loss after Ref-NeRF, a mean over the rays.

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
        samples, slopes = along.samples, along.slopes
        rays = samples.depths, samples.deltas, along.weights, samples.ray_offsets, batch.near, batch.far
        factors = {"distortion": self.distortion, "orientation": self.orientation}
        options: dict[str, Any] = {**factors, "hidden": along.hidden, "backend": along.backend}
        surface_loss(along.loss, slopes.weights, slopes.density, *rays, **options)


class RayValues:
    """The rendered rays, for a term that torch differentiates. All attributes except ``samples`` have gradients.

    The tensors belong to the step: they are valid until the next step, and must not be written to.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Renderer, RayValues, Stratified
        >>> def clear(rays: RayValues, batch: Batch):  # rays end at a surface, or nowhere
        ...     return 0.01 * (rays.opacity * (1 - rays.opacity)).mean()
        >>> loss = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)), terms=[clear])
    """

    def __init__(self, along: LossAlongRays, batch: Batch, now: Callable[[Any], Any]) -> None:
        self._along, self._batch, self._now = along, batch, now
        self.leaves: dict[str, Tensor] = {}  # the leaf tensors that the term has read, by name

    def _leaf(self, name: str, value: Tensor) -> Tensor:
        self.leaves[name] = leaf = value.detach().requires_grad_()
        return leaf

    def _sum(self, values: Tensor) -> Tensor:
        """Returns [r], the sum over the samples of each ray."""
        return torch.segment_reduce(values, "sum", offsets=self._now(self._along.samples.ray_offsets), unsafe=True)

    @functools.cached_property
    def colour(self) -> Tensor:
        """The colours of the rays [r, 3], the background included."""
        return self._leaf("colour", self._now(self._along.colour))

    @functools.cached_property
    def opacity(self) -> Tensor:
        """The opacities of the rays [r], 0..1: the sums of the weights."""
        return self._leaf("opacity", self._sum(self._now(self._along.weights)))

    @functools.cached_property
    def depth(self) -> Tensor:
        """The expected depths [r], normalised by the opacity; the far end for a ray with opacity 0."""
        sums = self._sum(self._now(self._along.weights) * self._now(self._along.samples.depths))
        return normalised(self._leaf("depth", sums), self.opacity, self._now(self._batch.far))

    @functools.cached_property
    def weights(self) -> Tensor:
        """The contributions of the samples to their rays [m]."""
        return self._leaf("weights", self._now(self._along.weights))

    @functools.cached_property
    def rgb(self) -> Tensor:
        """The colours of the samples [m, 3]."""
        return self._leaf("rgb", activate(self._now(self._along.raw), **self._along.activation)[0])

    @functools.cached_property
    def density(self) -> Tensor:
        """The densities at the samples [m], per scene unit."""
        return self._leaf("density", self._now(self._along.density))

    @functools.cached_property
    def samples(self) -> Samples:
        """The samples at which the networks were evaluated."""
        samples: Samples = self._now(self._along.samples)
        return samples


def stage_of(term: Term | Callable[[RayValues, Batch], Tensor]) -> Stage:
    """Returns the stage that reads the results named "along" and "batch" and adds a term to the loss."""
    reads = "along", "batch"
    if hasattr(term, "add"):
        return Stage.of_hook(term, "add", function=term.add, reads=reads)
    name = getattr(term, "__qualname__", type(term).__qualname__)
    return Stage(name, functools.partial(_add_differentiated, term), reads, python=True, lazy=True)


def _add_differentiated(
    term: Callable[[RayValues, Batch], Tensor], now: Callable[[Any], Any], along: LossAlongRays, batch: Batch
) -> None:
    """Adds a term that torch differentiates: a function of `RayValues` and their `Batch` that returns a scalar.

    Recorded tensors have spare rows; the function ``now`` cuts them to the rows of the present step.
    """
    values = RayValues(along, batch, now)
    with torch.enable_grad():
        added = term(values, now(batch))
    if not isinstance(added, Tensor) or added.dim():
        got = list(added.shape) if isinstance(added, Tensor) else repr(added)[:60]
        raise ValueError(f"RayLoss: a term must give a scalar tensor, got {got}")
    now(along.loss).add_(added.detach())
    if added.requires_grad and values.leaves:
        slopes = torch.autograd.grad(added, [*values.leaves.values()], allow_unused=True)
        for name, slope in zip(values.leaves, slopes, strict=True):
            if slope is not None:
                now(getattr(along.slopes, name)).add_(slope)
