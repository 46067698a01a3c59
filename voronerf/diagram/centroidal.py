"""Centroidal Voronoi tessellation: every centre is the centroid of its cell, so that cells are compact.

Letters: m samples x_j of mass m_j, k centres v_i. The centres lower the energy

    E = sum_j m_j min_i |x_j - v_i|^2

by Lloyd's iteration: samples go to the nearest centre, and centres to the centroids of their samples (Du, Faber and
Gunzburger 1999, "Centroidal Voronoi tessellations: applications and algorithms", section 5; with masses, section 2).
Neither step raises E.
"""

import torch
from torch import Tensor

from voronerf import ops

_STEPS = 200  # at most
_TOLERANCE = 1e-5  # the iteration ends when a step lowers the energy by less than this part of it


def lloyd(samples: Tensor, masses: Tensor, centres: Tensor, *, backend: str = "auto") -> Tensor:
    """Centres that are the centroids of their Voronoi cells.

    A centre without mass in its cell is moved to the sample with the largest share `m_j |x_j - v|^2` of the energy; it
    stays where it is if that is 0.

    Args:
        samples: float32 [m, 3] on the CPU.
        masses: float64 [m], >= 0, not all 0.
        centres: float32 [k, 3], k >= 1.
        backend: of `nearest_centre`.

    Returns:
        Centres float32 [k, 3].
    """
    k = centres.shape[0]
    precise, energy = samples.double(), float("inf")
    weighted = [masses * axis for axis in precise.unbind(1)]
    for _ in range(_STEPS):
        cells = ops.nearest_centre(samples, centres, backend=backend)
        costs = masses * (precise - centres.double()[cells]).square().sum(1)
        before, energy = energy, float(costs.sum())
        mass = torch.bincount(cells, weights=masses, minlength=k)
        if before - energy <= _TOLERANCE * energy and bool((mass > 0).all()):
            break
        sums = torch.stack([torch.bincount(cells, weights=axis, minlength=k) for axis in weighted], 1)
        moved = torch.where(mass[:, None] > 0, sums / mass[:, None], centres.double())
        for empty in (mass == 0).nonzero().flatten().tolist():
            worst = int(costs.argmax())
            if costs[worst] > 0:
                moved[empty] = precise[worst]
                costs = torch.minimum(costs, masses * (precise - precise[worst]).square().sum(1))
        centres = moved.float()
    return centres
