"""Retrains one cell of a trained router; the parameters and results of all other cells stay the same, bit for bit."""

import torch
from torch import Tensor, nn

from voronerf import VoronoiRouter


def colour(x: Tensor) -> Tensor:
    """Returns the target colours [n, 3], a smooth function of the positions [n, 3] in -1..1."""
    return 0.5 + 0.5 * torch.sin(3 * x + x.roll(1, dims=1))


def fit(router: VoronoiRouter, optimizer: torch.optim.Optimizer, target, steps: int) -> None:
    for _ in range(steps):
        x = torch.rand(2048, 3) * 2 - 1
        optimizer.zero_grad()
        (router(x) - target(x)).square().mean().backward()
        optimizer.step()


def main() -> None:
    torch.manual_seed(0)
    field = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 3))
    router = VoronoiRouter(field, torch.rand(8, 3) * 2 - 1, coords="first3", fuse=True)
    optimizer = torch.optim.Adam(router.parameters(), lr=3e-3)
    fit(router, optimizer, colour, 100)

    # The scene changes in cell 5: its colours are inverted.
    points = torch.rand(20_000, 3) * 2 - 1
    inside = router.assign(points) == 5

    def changed(x: Tensor) -> Tensor:
        return torch.where(router.assign(x)[:, None] == 5, 1 - colour(x), colour(x))

    with torch.no_grad():
        before, parameters = router(points), [p.clone() for p in router.parameters()]
    router.freeze([cell for cell in range(router.num_cells) if cell != 5], optimizer=optimizer)
    fit(router, optimizer, changed, 100)

    with torch.no_grad():
        after = router(points)
    others = torch.arange(router.num_cells) != 5
    assert torch.equal(after[~inside], before[~inside])
    assert all(torch.equal(new[others], old[others]) for new, old in zip(router.parameters(), parameters))
    errors = [float((found - changed(points))[inside].square().mean().sqrt()) for found in (before, after)]
    assert errors[1] < errors[0] / 2
    print(f"relearnt one of {router.num_cells} cells: error {errors[0]:.3f} -> {errors[1]:.3f}, the others unchanged")


if __name__ == "__main__":
    main()
