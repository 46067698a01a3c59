"""Equal cells by semi-discrete optimal transport: power weights that give every centre the same importance.

Letters: m samples, k centres. Samples are scaled to unit root-mean-square radius, and importances to a mean of 1 per
cell.

Moving plain Voronoi centres cannot balance several separate objects: an object holds 10.4 times the mean of a cell,
say, and cells that stay on one object share that among 10 or 11. The rest must lie in a cell that spans two objects,
and a plain cell cannot: whatever lies on an object is closer to the centres on it. Power weights can. For given
centres, the weights whose cells `|x - v_i|^2 - p_i` hold equal importance exist, and they are the maximum of the
concave dual of an optimal transport problem (Aurenhammer, Hoffmann and Aronov 1998, "Minkowski-type theorems and
least-squares clustering"; Merigot 2011), so finding them does not depend on luck. Two stages:

`anneal` finds them up to the granularity of the samples. Assignment is softened to a softmax of temperature T, which
makes the dual smooth; one damped Newton step is made at each T while T falls from the size of the scene to below the
distance of samples. At first every cell overlaps every other, so that importance flows between objects that have no
common border later.

`polish` then settles the samples at the borders one by one. With 40 samples a cell, a cell misses its share by about
half a sample whatever the weights; but a centre's three coordinates and its weight together choose *which* samples lie
at its border. Small random changes of all four are tried, and the best is taken if it lowers the sum of squares of the
cells' importance. What remains is bounded by the heaviest samples: one that outweighs the mean of a cell cannot be
shared.

With `centroidal`, `centre` comes before: it moves the centres to the centroids of their cells, so that cells of equal
importance are compact as well (Balzer, Schloemer and Deussen 2009, "Capacity-constrained point distributions"; de Goes,
Breeden, Ostromoukhov and Desbrun 2012, "Blue noise through optimal transport").
"""

import torch
from torch import Tensor

_STEPS = 36  # Newton steps, one per temperature
_COOLEST = 0.003  # last temperature, in squared typical distances of neighbouring centres
_RIDGE = 0.01  # added to the Hessian, whose diagonal is about 1: cells that share no sample leave it singular
_LONGEST = 4.0  # longest change of a weight in one step, in temperatures: beyond that the quadratic model says nothing

_ROUNDS = 4  # moves of all centres to the centroids of their cells; more hardly lower the energy

_MOVES = 2048  # centres visited in all, in sweeps over all of them ...
_SWEEPS = (8, 32)  # ... of which there are no fewer and no more
_TRIALS = 256  # random changes tried of each centre in each sweep
_BORDER = 64  # samples nearest to its border that a change is judged by
_TOLERANCE = 1e-3  # sweeps end at this root-mean-square deviation from equal cells


def transport(
    samples: Tensor,
    masses: Tensor,
    centres: Tensor,
    *,
    centroidal: bool = False,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Power weights, and slightly moved centres, whose cells hold equal mass.

    Args:
        samples: float32 [m, 3] on the CPU.
        masses: float64 [m], >= 0, not all 0.
        centres: float32 [k, 3], distinct, k >= 2.
        centroidal: move the centres to the centroids of their cells first.
        generator: CPU generator; None for torch's global one.

    Returns:
        Centres float32 [k, 3] and power weights float32 [k] of mean 0, in squared units of the samples.
    """
    masses = masses / fair_share(masses, centres.shape[0])
    origin = samples.mean(0)
    scale = (samples - origin).square().sum(1).mean().sqrt().clamp(min=torch.finfo(torch.float32).tiny)
    samples, centres = (samples - origin) / scale, (centres - origin) / scale
    if centroidal:
        centres = centre(samples, masses, centres)
    power = anneal(samples, masses, centres)
    centres, power = polish(samples, masses, centres, power, generator=generator)
    return centres * scale + origin, (power - power.mean()) * scale.square()


def fair_share(masses: Tensor, k: int) -> float:
    """The mass of a cell in the most equal division into k cells: the mean, less what heavier samples take away.

    A sample that outweighs a cell has one to itself; the other cells share the rest, and so on.
    """
    heaviest = masses.topk(min(k, masses.shape[0])).values.tolist()
    rest = float(masses.sum())
    for cells, mass in zip(range(k, 1, -1), heaviest):
        if mass * cells <= rest:
            return rest / cells
        rest -= mass
    return rest


def anneal(samples: Tensor, masses: Tensor, centres: Tensor) -> Tensor:
    """Power weights float32 [k] at which the cells' masses are equal up to single samples; arguments scaled, see above.

    With soft membership `P_xi = softmax_i((p_i - |x - v_i|^2) / T)`, the dual has the gradient `1 - W` with `W = P^T m`
    and the Hessian `-(diag(W) - P^T diag(m) P) / T`.
    """
    squared = _squared_distances(samples, centres).T.contiguous()
    # A sample heavier than a cell would drive its centre's weight without end; it counts as one full cell.
    masses = masses.clamp(max=1.0).to(squared.dtype)
    apart = torch.cdist(centres, centres).fill_diagonal_(float("inf")).amin(1).median()
    coolest = float((_COOLEST * apart.square()).clamp(1e-7, 0.1))
    power = torch.zeros_like(centres[:, 0])
    for temperature in torch.logspace(0.0, torch.tensor(coolest).log10().item(), _STEPS).tolist():
        member = torch.softmax((power - squared) / temperature, 1)
        cell_mass = masses @ member
        curvature = torch.diag(cell_mass + _RIDGE) - member.T @ (member * masses[:, None])
        step = torch.linalg.solve(curvature.double(), (1 - cell_mass).double())
        step = step * (_LONGEST / step.abs().max()).clamp(max=1.0)
        power = power + temperature * step.to(power.dtype)
    return power


def centre(samples: Tensor, masses: Tensor, centres: Tensor) -> Tensor:
    """Centres float32 [k, 3] near the centroids of their cells of equal mass; arguments scaled, see above.

    Alternates between the weights of the present centres and the centroids of the present cells (de Goes et al. 2012).
    """
    k = centres.shape[0]
    for _ in range(_ROUNDS):
        power = anneal(samples, masses, centres)
        cells = (_squared_distances(samples, centres) - power[:, None]).argmin(0)
        mass = torch.bincount(cells, weights=masses, minlength=k)
        sums = [torch.bincount(cells, weights=masses * axis, minlength=k) for axis in samples.unbind(1)]
        centroids = torch.stack(sums, 1) / mass[:, None]
        centres = torch.where(mass[:, None] > 0, centroids, centres.double()).to(samples.dtype)
    return centres


def polish(
    samples: Tensor, masses: Tensor, centres: Tensor, power: Tensor, *, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Small changes of centres and weights, one centre at a time, each lowering the sum of squared cell masses."""
    centres, power = centres.clone(), power.clone()
    k = centres.shape[0]
    cost = _squared_distances(samples, centres) - power[:, None]
    (best, second), (owner, runner_up) = cost.topk(2, dim=0, largest=False)
    weights = torch.bincount(owner, weights=masses, minlength=k)
    reach = torch.logspace(-2, 1, _TRIALS, dtype=samples.dtype)
    for _ in range(min(max(_MOVES // k, _SWEEPS[0]), _SWEEPS[1])):
        if float((weights - 1).square().mean()) <= _TOLERANCE**2:
            break
        for i in (weights - 1).abs().argsort(descending=True).tolist():
            # Without centre i its samples would go to their second choice: `rival` is the cost they have to be won at.
            owned = owner == i
            rival, rival_cell = torch.where(owned, second, best), torch.where(owned, runner_up, owner)
            gaps, border = (cost[i] - rival).abs().topk(min(_BORDER, samples.shape[0]), largest=False)
            near, mass, taker = samples[border], masses[border], rival_cell[border]
            # Each trial shifts the cell's costs at its border by up to `reach` times the width of that border.
            radius = (near - centres[i]).norm(dim=1).max().clamp(min=1e-12)
            change = torch.randn(_TRIALS, 4, generator=generator)
            change *= (reach * gaps.max() / 2 / change.norm(dim=1))[:, None]
            moved, lifted = centres[i] + change[:, :3] / (2 * radius), power[i] + change[:, 3]
            won = _squared_distances(near, moved) - lifted[:, None] < rival[border]
            given = torch.where(owned[border], mass, 0.0) - torch.where(won, mass, 0.0)
            kept = -given.sum(1)
            takers, slot = taker.unique(return_inverse=True)
            taken = given.new_zeros(_TRIALS, takers.shape[0]).index_add_(1, slot, given)
            # (W + d)^2 - W^2, summed over the cells that a trial changes.
            rise = (taken * (2 * weights[takers] + taken)).sum(1) + kept * (2 * weights[i] + kept)
            choice = int(rise.argmin())

            row = _squared_distances(samples, moved[choice : choice + 1])[0] - lifted[choice]
            outcome = torch.bincount(torch.where(row < rival, i, rival_cell), weights=masses, minlength=k)
            if not float(outcome.square().sum()) < float(weights.square().sum()) * (1 - 1e-12):
                continue
            centres[i], power[i], cost[i], weights = moved[choice], lifted[choice], row, outcome
            stale = torch.nonzero(owned | (runner_up == i) | (row < second)).squeeze(1)
            values, cells = cost[:, stale].topk(2, dim=0, largest=False)
            best[stale], second[stale] = values
            owner[stale], runner_up[stale] = cells
    return centres, power


def _squared_distances(samples: Tensor, centres: Tensor) -> Tensor:
    """[k, m], by differences: the expanded square loses what the border between two centres is made of."""
    return torch.cdist(centres, samples, compute_mode="donot_use_mm_for_euclid_dist").square()
