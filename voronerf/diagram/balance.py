"""Balances a Voronoi diagram: moves the centres until every cell holds the same importance.

Letters: m samples, k centres, d coordinates (1 to 4), W [k] the total importance of the samples in each cell.

Source: Elsner et al. 2023, "Adaptive Voronoi NeRFs", section 3.2. The figure of merit, from the paper, is the
    population standard deviation (divided by k, not k - 1) of `W / max W`; 0 is perfect balance.

Everything runs on the CPU in a fixed order, so the same samples and the same generator give the same diagram on every
machine. With ten thousand samples, a GPU would not be faster. Coordinates are in scene units.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf import ops
from voronerf.ops._core import backends

_STEPS = 200  # maximum number of steps of Lloyd's iteration
_TOLERANCE = 1e-5  # the iteration ends when a step lowers the energy by less than this fraction

CENTRES = ("balanced", "random", "uniform", "centroidal")


@dataclass(frozen=True)
class Balance:
    """The result of `balance`.

    Attributes:
        centres: float32 [k, d], on the device of the samples.
        before: float64 [k], the importance of each cell with the first centres.
        after: float64 [k], the importance of each cell with the returned centres.
        imbalance_before: the figure of merit, std(W / max W), of `before`.
        imbalance_after: the figure of merit, std(W / max W), of `after`.

    Examples:
        >>> import torch
        >>> from voronerf import balance
        >>> result = balance(torch.rand(500, 3), torch.ones(500), 4)
        >>> int(result.after.sum())  # the importance of all cells together
        500
        >>> result.centres.shape  # VoronoiDiagram(result.centres) is the diagram
        torch.Size([4, 3])
    """

    centres: Tensor
    before: Tensor
    after: Tensor
    imbalance_before: float
    imbalance_after: float


def imbalance(weights: Tensor) -> float:
    """Returns the population standard deviation of `W / max W` over the cells, the paper's figure of merit.

    Args:
        weights: the importance of each cell, [k], k >= 1, at least one positive.

    Raises:
        ValueError: The shape is wrong, or no value is positive.

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
    """Returns the total importance of the samples in each cell, float64 [k], summed in the order of the samples."""
    return torch.bincount(cells, weights=importance.double(), minlength=k)


def balance(
    points: Tensor,
    importance: Tensor,
    k: int,
    *,
    centres: str = "balanced",
    steps: int = 500,
    generator: torch.Generator | None = None,
    backend: str = "auto",
) -> Balance:
    """Places k centres so that their Voronoi cells hold equal importance.

    Balanced centres start at random samples. Each of `steps` updates moves all centres i at once,

        v_i <- v_i + 0.05 * mean_{j in N(i)} (v_j - v_i) * (W_j - W_i) / norm_i,

    where v_i is centre i, W_i is the importance of its cell, N(i) are the 8 closest centres (all others if there are
    fewer), and `norm_i` is the largest W of i and N(i).
    Light cells move towards heavy neighbours, and heavy cells away from light ones. Each update compares all pairs of
    centres, so balanced centres suit up to some hundreds of cells.

    Args:
        points: floating [m, d], finite.
        importance: floating [m], finite, >= 0, not all 0.
        k: the number of cells, 1 <= k <= number of distinct points.
        centres: "balanced", by the updates above; "centroidal", centres at the importance-weighted centroids of their
            cells, which are then compact but of unequal importance (Du, Faber and Gunzburger 1999); "random", distinct
            samples with equal probabilities; or "uniform", `uniform_centres` over the bounding box of the samples.
        steps: the number of updates of balanced centres.
        generator: the CPU generator for random draws; None for torch's global generator.
        backend: the backend of the ops, see `voronerf.ops._core.backends`.

    Raises:
        ValueError: a wrong shape, an unknown choice, a value that is not finite, a negative importance, no importance
            at all, k below 1, or more cells than distinct points.
        TypeError: points or importance are not floating-point.

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
    if centres not in CENTRES:
        raise ValueError(f"balance: centres must be one of {', '.join(CENTRES)}, got {centres!r}")
    if k < 1 or steps < 0:
        raise ValueError(f"balance: k must be at least 1 and steps at least 0, got {k} and {steps}")
    total = float(importance.double().sum())
    if not 0.0 < total < float("inf"):
        raise ValueError(f"balance: importance must have a positive finite sum, got {total}")

    samples = points.detach().to("cpu", torch.float32).contiguous()
    masses = importance.detach().to("cpu", torch.float64)

    def weigh(centres: Tensor) -> Tensor:
        return cell_weights(ops.nearest_centre(samples, centres, backend=backend), masses, k)

    chosen = first_centres(samples, masses, k, centres, generator)
    before = after = weigh(chosen)
    if centres == "centroidal":
        chosen = lloyd(samples, masses, chosen, backend=backend)
        after = weigh(chosen)
    elif centres == "balanced" and k > 1:
        if (d := samples.shape[1]) > 3:
            chosen, after = in_torch("balance_centres", samples)(samples, masses, chosen, steps, 0.05, 8)
        else:
            arguments = in_space(samples), masses, in_space(chosen)
            chosen, after = ops.balance_centres(*arguments, steps=steps, backend=backend)
        chosen = chosen[:, :d]
    device = points.device
    return Balance(
        centres=chosen.to(device),
        before=before.to(device),
        after=after.to(device),
        imbalance_before=imbalance(before),
        imbalance_after=imbalance(after),
    )


def first_centres(samples: Tensor, masses: Tensor, k: int, centres: str, generator: torch.Generator | None) -> Tensor:
    """Returns initial centres, float32 [k, d]: `uniform_centres` for "uniform", else different samples drawn at random.

    The samples, float32 [m, d], are on the CPU. For "centroidal", the probability of a sample is proportional to its
    mass, [m]; for the other choices, all samples are equally likely.
    """
    if centres != "uniform":
        # Sorting exponential variates divided by the weights draws without replacement in proportion to the weights
        # (Efraimidis and Spirakis 2006). Of several samples at the same point, only the first counts, because two
        # equal centres would make an empty cell.
        keys = torch.empty(len(samples), dtype=torch.float64, device=samples.device).exponential_(generator=generator)
        samples = samples[torch.argsort(keys / masses if centres == "centroidal" else keys, stable=True)]
    first = first_distinct(samples, k)
    if len(first) < k:
        raise ValueError(f"balance: k must be at most the number of distinct points, {len(first)}, got {k}")
    return uniform_centres(torch.stack([samples.amin(0), samples.amax(0)]), k) if centres == "uniform" else first


def first_distinct(points: Tensor, k: int) -> Tensor:
    """Returns the first k distinct points of [m, d], in their order; all distinct points if there are fewer."""
    count = min(k, len(points))
    while True:  # a search among all points takes a second with 400,000
        distinct, member = torch.unique(points[:count], dim=0, return_inverse=True)
        if len(distinct) >= k or count == len(points):
            place = torch.full((len(distinct),), count, device=points.device)
            place.scatter_reduce_(0, member, torch.arange(count, device=points.device), "amin")
            return points[place.sort().values[:k]]
        count = min(2 * count, len(points))


def uniform_centres(box: Tensor, k: int) -> Tensor:
    """Spreads k centres evenly over a box, as close to a regular grid as k allows (the paper's "uniform" ablation).

    The box is cut across its longest side: into 2 equal parts if k is even, into 3 if k is divisible by 3, otherwise
    into 2 parts in proportion to their numbers of centres. Each part is cut in the same way, until it holds one centre,
    which is placed in its middle. All final parts have the same volume. In a cube, 8, 27, 64 ... give cubic grids, 12
    gives 2 x 2 x 3, and 16 gives 4 x 2 x 2.

    Args:
        box: floating [2, d], lowest and highest corner; flat boxes are allowed.
        k: the number of centres, >= 1.

    Returns:
        [k, d] in the dtype and on the device of `box`.

    Raises:
        ValueError: k < 1, a wrong shape, a value that is not finite, or a highest corner below the lowest.

    Examples:
        >>> import torch
        >>> from voronerf import uniform_centres
        >>> box = torch.tensor([[0.0, 0, 0], [2.0, 1, 1]])
        >>> uniform_centres(box, 2)
        tensor([[0.5000, 0.5000, 0.5000],
                [1.5000, 0.5000, 0.5000]])
    """
    if k < 1:
        raise ValueError(f"uniform_centres: k must be at least 1, got {k}")
    if box.dim() != 2 or box.shape[0] != 2 or not 1 <= box.shape[1] <= 4:
        raise ValueError(f"uniform_centres: box must have shape [2, d], d = 1 to 4, got {list(box.shape)}")
    low, high = box.tolist()
    if not bool(torch.isfinite(box).all()) or any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"uniform_centres: box must be finite with box[0] <= box[1], got {box.tolist()}")

    def place(low: list[float], high: list[float], k: int) -> list[list[float]]:
        if k == 1:
            return [[(a + b) / 2 for a, b in zip(low, high, strict=True)]]
        if k % 2 == 0:
            shares = [k // 2] * 2
        elif k % 3 == 0:
            shares = [k // 3] * 3
        else:
            shares = [k // 2, k - k // 2]
        sides = [b - a for a, b in zip(low, high, strict=True)]
        # Sides count as equal up to one part in a million, so that rounding does not choose between equal sides.
        axis = next(i for i, side in enumerate(sides) if side >= max(sides) * (1 - 1e-6))
        centres: list[list[float]] = []
        start, done = low[axis], 0
        for share in shares:
            done += share
            end = low[axis] + sides[axis] * done / k
            centres += place([*low[:axis], start, *low[axis + 1 :]], [*high[:axis], end, *high[axis + 1 :]], share)
            start = end
        return centres

    return torch.tensor(place(low, high, k), dtype=box.dtype, device=box.device)


def lloyd(samples: Tensor, masses: Tensor, centres: Tensor, *, backend: str = "auto") -> Tensor:
    """Moves centres to the centroids of their Voronoi cells, so that cells are compact.

    Lloyd's iteration lowers the energy E = sum_j m_j min_i |x_j - v_i|^2 of samples x_j of mass m_j: each step assigns
    samples to the nearest centre and moves centres to the centroids of their samples (Du, Faber and Gunzburger 1999,
    section 5; with masses, section 2). A centre without mass in its cell moves to the sample x_j that contributes most
    to the energy, unless this contribution is 0.
    """
    k = centres.shape[0]
    precise, energy = samples.double(), float("inf")
    weighted = [masses * axis for axis in precise.unbind(1)]
    for _ in range(_STEPS):
        cells = ops.nearest_centre(samples, centres, backend=backend)
        costs = masses * (precise - centres.double()[cells]).square().sum(1)
        before, energy = energy, float(costs.sum())
        mass = torch.bincount(cells, weights=masses, minlength=k)
        if energy == 0.0 or (before - energy <= _TOLERANCE * energy and bool((mass > 0).all())):
            break
        sums = torch.stack([torch.bincount(cells, weights=axis, minlength=k) for axis in weighted], 1)
        moved = torch.where(mass[:, None] > 0, sums / mass[:, None], centres.double())
        for empty in (mass == 0).nonzero().flatten().tolist():
            worst = int(costs.argmax())
            if costs[worst] == 0:
                break
            moved[empty] = precise[worst]
            costs = torch.minimum(costs, masses * (precise - precise[worst]).square().sum(1))
        centres = moved.float()
    return centres


def check_samples(op: str, points: Tensor, importance: Tensor) -> None:
    """Raises ValueError or TypeError unless points [m, d] and importance [m] are finite and floating-point.

    Also raises ValueError for a negative importance.
    """
    if points.dim() != 2 or not 1 <= points.shape[1] <= 4:
        raise ValueError(f"{op}: points must have shape [m, d], d = 1 to 4, got {list(points.shape)}")
    if tuple(importance.shape) != (points.shape[0],):
        raise ValueError(f"{op}: importance must have shape [{points.shape[0]}], got {list(importance.shape)}")
    for name, table in (("points", points), ("importance", importance)):
        if not table.is_floating_point():
            raise TypeError(f"{op}: {name} must be floating-point, got {table.dtype}")
        if not bool(torch.isfinite(table).all()):
            raise ValueError(f"{op}: {name} must be finite, got NaN or infinity")
    if bool((importance < 0).any()):
        raise ValueError(f"{op}: importance must not be negative, got {float(importance.min())}")


def in_space(points: Tensor) -> Tensor:
    """Pads points [n, d], d = 1 to 3, with zeros to [n, 3] for the operations; distances stay the same."""
    d = points.shape[1]
    return points if d == 3 else torch.nn.functional.pad(points, (0, 3 - d))


def in_torch(op: str, points: Tensor) -> Callable[..., Any]:
    """Returns the PyTorch reference of the operation ``op``, which accepts any number of coordinates."""
    return backends.resolve(op, backend="reference", device=points.device, dtype=points.dtype)
