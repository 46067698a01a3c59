"""The coarse level of a part: how many voxels it may have, and what they show."""

import pytest
import torch
from torch import nn

from voronerf.router import VoronoiRouter
from voronerf.town.coarse import MOST_ACROSS, make_coarse
from voronerf.town.parts import Part, Similarity, Solid


class Fog(nn.Module):
    """Red fog of density 3."""

    def __init__(self) -> None:
        super().__init__()
        self.red = nn.Parameter(torch.tensor([1.0, 0, 0]))

    def forward(self, positions, directions):
        return 0 * positions + self.red, 0 * positions[:, 0] + 3


@pytest.mark.parametrize(("side", "shape"), [(0.25, [8, 1, 1]), (1e-5, [MOST_ACROSS, 2, 2])])
def test_voxels_along_a_side_are_bounded(side: float, shape: list[int]) -> None:
    """A short step of the scene does not make more of them, in a part of any scale."""
    box = Solid.box((0, 0, 0), (1, 0.01, 0.01))
    part = Part([VoronoiRouter(Fog(), torch.rand(2, 3), coords="first3")], frame=Similarity(scale=2.0), region=[box])
    level = make_coarse(part.eval(), side, None, "auto")
    assert level is not None and level.shape.tolist() == shape
    assert len(level.voxels) == level.shape.prod()
    assert torch.equal(level.values[:, :3], torch.tensor([[255, 0, 0]]).byte().expand(len(level.values), 3))
