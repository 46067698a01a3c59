"""Balances a Voronoi diagram: moves the centres until every cell holds the same importance.

Letters: m samples, k centres, W [k] the total importance of the samples in each cell.

Source: Elsner et al. 2023, "Adaptive Voronoi NeRFs", section 3.2. The figure of merit is the paper's: the standard
deviation (of the population: divided by k, not k - 1) of `W / max W`; 0 is perfect balance.

Everything runs on the CPU in a fixed order, so the same samples and the same generator give the same diagram on every
machine. For ten thousand samples a GPU would not help. Coordinates are in scene units.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf import ops
from voronerf.diagram.centroidal import lloyd
from voronerf.diagram.transport import transport
from voronerf.diagram.uniform import uniform_centres
from voronerf.diagram.voronoi import VoronoiDiagram

METHODS = ("published", "transport", "centroidal", "centroidal-transport")


@dataclass(frozen=True)
class Balance:
    """The result of `balance`.

    Attributes:
        centres: float32 [k, 3], on the device of the samples.
        power: float32 [k] power weights, or None for a plain Voronoi diagram.
        before: float64 [k], importance of each cell with the first centres.
        after: float64 [k], importance of each cell with the returned centres.
        imbalance_before: std(W / max W) of `before`.
        imbalance_after: std(W / max W) of `after`.

    Examples:
        >>> import torch
        >>> from voronerf import balance
        >>> result = balance(torch.rand(500, 3), torch.ones(500), 4)
        >>> int(result.after.sum())  # the importance of all cells together
        500
        >>> result.diagram()
        VoronoiDiagram(Voronoi, cells=4, depth=1)
    """

    centres: Tensor
    power: Tensor | None
    before: Tensor
    after: Tensor
    imbalance_before: float
    imbalance_after: float

    def diagram(self) -> VoronoiDiagram:
        """The balanced centres as a flat diagram."""
        return VoronoiDiagram(self.centres, weights=self.power)


def imbalance(weights: Tensor) -> float:
    """The population standard deviation of `W / max W` over the cells, the paper's figure of merit.

    Args:
        weights: [k] importance per cell, k >= 1, at least one of them positive.

    Raises:
        ValueError: wrong shape, or no positive value.

    Examples:
        >>> import torch
        >>> from voronerf import imbalance
        >>> imbalance(torch.tensor([2.0, 2.0, 2.0]))
        0.0
        >>> imbalance(torch.tensor([4.0, 0.0]))
        0.5
    """
    if weights.dim() != 1 or weights.numel() == 0:
        raise ValueError(f"imbalance: weights must have shape [k] with k >= 1, got {list(weights.shape)}")
    heaviest = float(weights.max())
    if not heaviest > 0:
        raise ValueError(f"imbalance: weights must hold a positive value, got a maximum of {heaviest}")
    return float((weights.double() / heaviest).std(correction=0))


def cell_weights(cells: Tensor, importance: Tensor, k: int) -> Tensor:
    """float64 [k]: the total importance of the samples in each cell, added up in the order of the samples."""
    return torch.bincount(cells, weights=importance.double(), minlength=k)


def balance(
    points: Tensor,
    importance: Tensor,
    k: int,
    *,
    method: str = "published",
    steps: int = 500,
    alpha: float = 0.05,
    neighbours: int = 8,
    normalise: str = "neighbourhood",
    init: str | None = None,
    uniform_scale: float = 1.0,
    generator: torch.Generator | None = None,
    backend: str = "auto",
) -> Balance:
    """Places k centres so that their Voronoi cells hold equal importance.

    The method "published" draws the first centres and repeats, `steps` times, for all centres i at once,

        v_i <- v_i + alpha * mean_{j in N(i)} (v_j - v_i) * (W_j - W_i) / norm_i,

    where N(i) are its `neighbours` closest centres (all others if there are fewer). Light cells move towards heavy
    neighbours, and heavy cells away from light ones. `norm_i` is the largest W of i and N(i), as the text of the paper
    says ("neighbourhood"), or the largest of all cells ("global"), the other reading of its formula.

    Args:
        points: floating [m, 3], finite.
        importance: floating [m], finite, >= 0, not all 0.
        k: number of cells, 1 <= k <= number of distinct points.
        method: "published" (a plain Voronoi diagram); "transport" (a power diagram of equal importance); "centroidal"
            (a plain Voronoi diagram whose centres are the centroids of their cells, weighted by importance: compact
            cells, which hold unequal importance; Du, Faber and Gunzburger 1999); or "centroidal-transport" (a power
            diagram of both, equal importance and compact cells; Balzer, Schloemer and Deussen 2009, de Goes et al.
            2012).
        steps: number of updates; 0 keeps the first centres.
        alpha: step size, no unit.
        neighbours: size of N(i), >= 1.
        normalise: "neighbourhood" or "global".
        init: the first centres. "random": distinct samples, all equally likely (as in the paper; default of
            "published"). "weighted": distinct samples drawn one by one with probability proportional to importance
            (default of the other methods). "uniform": `uniform_centres` over the bounding box of the samples.
        uniform_scale: factor > 0 on the size of that box about its middle.
        generator: CPU generator of the draws; None for torch's global one.
        backend: of the ops, see `voronerf.backends`.

    Raises:
        ValueError: a wrong shape, an unknown choice, a value that is not finite, a negative importance, no importance
            at all, k below 1, or more cells than distinct samples.
        TypeError: points or importance that are not floating-point.

    Examples:
        >>> import torch
        >>> from voronerf import balance
        >>> generator = torch.Generator().manual_seed(0)
        >>> points, importance = torch.rand(2000, 3, generator=generator), torch.rand(2000, generator=generator)
        >>> result = balance(points, importance, 8, generator=generator)
        >>> result.centres.shape
        torch.Size([8, 3])
        >>> result.imbalance_after < 0.1 * result.imbalance_before
        True
    """
    check_samples("balance", points, importance)
    _check_choice("method", method, METHODS)
    init = init or ("random" if method == "published" else "weighted")
    _check_choice("init", init, ("random", "weighted", "uniform"))
    _check_choice("normalise", normalise, ("neighbourhood", "global"))
    if k < 1:
        raise ValueError(f"balance: k must be at least 1, got {k}")
    if not 0 < uniform_scale < float("inf"):
        raise ValueError(f"balance: uniform_scale must be positive and finite, got {uniform_scale}")
    if steps < 0 or neighbours < 1:
        raise ValueError(f"balance: steps must be >= 0 and neighbours >= 1, got {steps} and {neighbours}")
    total = float(importance.double().sum())
    if not 0.0 < total < float("inf"):
        raise ValueError(f"balance: importance must have a positive finite sum, got {total}")

    samples = points.detach().to("cpu", torch.float32).contiguous()
    masses = importance.detach().to("cpu", torch.float64)

    def weigh(centres: Tensor, power: Tensor | None = None) -> Tensor:
        return cell_weights(ops.nearest_centre(samples, centres, weights=power, backend=backend), masses, k)

    centres = first_centres(samples, masses, k, init=init, generator=generator, uniform_scale=uniform_scale)
    power = None
    before = after = weigh(centres)
    if "centroidal" in method:
        centres = lloyd(samples, masses, centres, backend=backend)
        after = weigh(centres)
    if "transport" in method and k > 1:
        centres, power = transport(
            samples, masses, centres, centroidal=method == "centroidal-transport", generator=generator
        )
        after = weigh(centres, power)
    elif method == "published" and k > 1:
        centres, after = ops.balance_centres(
            samples,
            masses,
            centres,
            steps=steps,
            alpha=alpha,
            neighbours=neighbours,
            global_norm=normalise == "global",
            backend=backend,
        )
    device = points.device
    return Balance(
        centres=centres.to(device),
        power=None if power is None else power.to(device),
        before=before.to(device),
        after=after.to(device),
        imbalance_before=imbalance(before),
        imbalance_after=imbalance(after),
    )


def first_centres(
    samples: Tensor,
    masses: Tensor,
    k: int,
    *,
    init: str,
    generator: torch.Generator | None,
    uniform_scale: float = 1.0,
) -> Tensor:
    """float32 [k, 3] first centres from CPU samples float32 [m, 3] and masses [m]; see `init` of `balance`."""
    distinct, member = torch.unique(samples, dim=0, return_inverse=True)
    if k > distinct.shape[0]:
        raise ValueError(f"balance: k must be at most the number of distinct samples, {distinct.shape[0]}, got {k}")
    if init == "uniform":
        box = torch.stack([samples.amin(0), samples.amax(0)])
        return uniform_centres(box if uniform_scale == 1 else box.mean(0).lerp(box, uniform_scale), k)
    # Sorting exponential variates divided by the weights draws without replacement in proportion to the weights
    # (Efraimidis and Spirakis 2006). Of several samples in one place only the first counts, because two centres in one
    # place would make an empty cell.
    keys = torch.empty(samples.shape[0], dtype=torch.float64).exponential_(generator=generator)
    order = torch.argsort(keys / masses if init == "weighted" else keys, stable=True)
    place = torch.full((distinct.shape[0],), samples.shape[0], dtype=torch.int64)
    place.scatter_reduce_(0, member[order], torch.arange(samples.shape[0]), "amin")
    return samples[order[place.sort().values[:k]]]


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"balance: {name} must be one of {', '.join(choices)}, got {value!r}")


def check_samples(op: str, points: Tensor, importance: Tensor) -> None:
    """Raises ValueError or TypeError unless points [m, 3] and importance [m] are finite, floating-point, and the latter
    >= 0."""
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"{op}: points must have shape [m, 3], got {list(points.shape)}")
    if tuple(importance.shape) != (points.shape[0],):
        raise ValueError(f"{op}: importance must have shape [{points.shape[0]}], got {list(importance.shape)}")
    for name, table in (("points", points), ("importance", importance)):
        if not table.is_floating_point():
            raise TypeError(f"{op}: {name} must be floating-point, got {table.dtype}")
        if not bool(torch.isfinite(table).all()):
            raise ValueError(f"{op}: {name} must be finite, got NaN or infinity")
    if bool((importance < 0).any()):
        raise ValueError(f"{op}: importance must not be negative, got {float(importance.min())}")
