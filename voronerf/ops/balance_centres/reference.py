"""Balancing a diagram's cells. m samples, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.nearest_centre.reference import nearest_centre


@torch.no_grad()
def balance_centres(
    samples: Tensor, masses: Tensor, centres: Tensor, steps: int, alpha: float, neighbours: int
) -> tuple[Tensor, Tensor]:
    """Repeats the update of Elsner et al. 2023; see ``voronerf.ops.balance_centres``."""
    weights = cell_masses(samples, masses, centres)
    for _ in range(steps if centres.shape[0] > 1 else 0):
        centres = published_step(centres, weights, alpha=alpha, neighbours=neighbours)
        weights = cell_masses(samples, masses, centres)
    return centres.clone(), weights


def cell_masses(samples: Tensor, masses: Tensor, centres: Tensor) -> Tensor:
    """Returns float64 [k], the mass in each cell, summed in the order of the samples."""
    cells = nearest_centre(samples, centres)
    return torch.zeros(centres.shape[0], dtype=masses.dtype, device=masses.device).index_add(0, cells, masses)


def published_step(centres: Tensor, weights: Tensor, *, alpha: float, neighbours: int) -> Tensor:
    """Returns the centres [k, 3], k >= 2, after one update; ``weights`` [k] are the masses of their cells."""
    wide = centres.double()
    nearby = min(neighbours, centres.shape[0] - 1)
    distances = (wide[:, None] - wide[None]).square().sum(-1).fill_diagonal_(float("inf"))
    # The sort is stable, so ties go to the lowest index.
    others = distances.sort(dim=1, stable=True).indices[:, :nearby]
    heaviest = torch.maximum(weights[others].amax(1), weights)[:, None]
    # In a neighbourhood of weight 0 all differences are 0, so any positive divisor works.
    pull = (weights[others] - weights[:, None]) / heaviest.clamp(min=torch.finfo(weights.dtype).tiny)
    shift = ((wide[others] - wide[:, None]) * pull[:, :, None]).mean(1)
    return (wide + alpha * shift).to(centres.dtype)
