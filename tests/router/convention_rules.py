"""Small fields, each of which combines parameters and samples by one operation, with or without a grouped rule."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from convention_harness import Case, one
from torch import Tensor, nn

from voronerf.router import register


class Odd(nn.Module):
    """A field with parameters of many shapes, and a step that uses some of these parameters."""

    def __init__(self, step: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.fc, self.step = nn.Linear(3, 4), [step]
        self.vector, self.square, self.one = (nn.Parameter(torch.randn(s)) for s in ((4,), (4, 4), (1, 4)))
        self.cube, self.table = nn.Parameter(torch.randn(1, 2, 4)), nn.Embedding(5, 4, padding_idx=0)

    def forward(self, x: Tensor) -> Tensor:
        return self.step[0](self, self.fc(x))


def index(h: Tensor) -> Tensor:
    return (h[:, 0] > 0).long()


STEPS: list[Callable[[Any, Tensor], Tensor]] = [
    lambda net, h: h @ net.vector,
    lambda net, h: (net.square @ h.t()).t(),
    lambda net, h: torch.einsum("ni,oi", h, net.square),
    lambda net, h: torch.einsum("in,oi->no", h.t(), net.square),
    lambda net, h: torch.einsum("ni,oi,o->no", [h, net.square, net.vector]),
    lambda net, h: torch.einsum("nci,oi->nco", h[:, None], net.square)[:, 0],
    lambda net, h: (h[:, None] * net.cube).sum(1),
    lambda net, h: (h[:, None].expand(-1, 2, -1) * net.cube[0]).sum(1),
    lambda net, h: h * net.square.sum(),
    lambda net, h: torch.where(h > 0, h, net.vector),
    lambda net, h: h.add(net.vector).clamp(net.one - 1, net.vector + 1),
    lambda net, h: F.layer_norm(h, (4,), net.vector, torch.ones(4).to(h)),
    lambda net, h: F.rms_norm(h, (4,), net.vector),
    lambda net, h: net.table(index(h)),
    lambda net, h: net.square[index(h) - 1],
    lambda net, h: net.square[:, index(h)].t(),
    lambda net, h: net.cube[0].repeat(len(h), 1, 1).sum(1),
    lambda net, h: net.one.expand(len(h), 4) + net.vector.detach(),
    lambda net, h: h * max(net.vector.tolist()),
    lambda net, h: h * torch.stack(torch.unbind(net.square)).norm(),
    lambda net, h: F.linear(h, net.square, torch.ones(4).to(h)) + F.linear(h, torch.eye(4).to(h), net.vector),
    lambda net, h: h + torch.autograd.grad(net.vector.square().sum(), net.vector, create_graph=True)[0],
    lambda net, h: torch.einsum("bid,iod->bo", h.view(-1, 2, 2), net.square.view(2, 4, 2)),
    lambda net, h: torch.einsum("iod,dbi->bo", net.square.view(4, 2, 2), torch.stack([h.cos(), h.sin()])),
    lambda net, h: torch.einsum("bxd , ode -> boxe", [h.view(-1, 2, 2), net.square.view(4, 2, 2)]).sum((2, 3)),
    lambda net, h: torch.einsum("bi,oi->bio", h, net.square).sum(1) * torch.einsum("bi,i->b", h, net.vector)[:, None],
    lambda net, h: torch.einsum("bix,iox->bo", h.view(-1, 2, 2), net.cube.view(2, 2, 2)).repeat(1, 2),
    lambda net, h: torch.einsum("bix,iox->box", h.view(-1, 2, 2), net.cube.view(2, 2, 2)).flatten(1),
    lambda net, h: torch.einsum("bi,oi->ob", h, net.square).t(),
    lambda net, h: F.conv2d(h[..., None, None], net.square[..., None, None], net.vector)[..., 0, 0],
    lambda net, h: F.conv1d(h.view(-1, 2, 2), net.cube.view(4, 2, 1)).sum(2),
    lambda net, h: F.conv2d(h.t()[None, :, None], net.square[..., None, None])[0, :, 0].t(),
    lambda net, h: F.conv1d(h.t(), net.square[..., None], net.vector, stride=1, padding=0).t(),
    lambda net, h: F.conv1d(h[:, None], net.vector.view(1, 1, 4), padding="same")[:, 0],
    lambda net, h: h.to(net.vector) * net.vector.type_as(h) + net.one.new_ones(len(h), 4),
    lambda net, h: net.one.new_zeros(2, 4).sum(0) + torch.ones(1, 4).to(h).expand_as(h) * net.vector,
    lambda net, h: torch.baddbmm(
        net.one, h.view(-1, 2, 2).movedim(1, 0), net.cube.view(2, 2, 2)[..., [0, 1, 0, 1]]
    ).sum(0),
    lambda net, h: torch.bmm(net.square.view(2, 2, 4), h.t().expand(2, 4, len(h))).flatten(0, 1).t(),
    lambda net, h: torch.addmm(net.vector, h, net.square) + torch.mv(h, net.vector)[:, None],
]


class Corners(nn.Module):
    """A field with several look-ups in one table, mixed by the positions, and one look-up in another table."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self.codes = nn.Parameter(torch.randn(11, 2)), nn.Embedding(7, 3)

    def forward(self, x: Tensor) -> Tensor:
        index = (x[:, :2].abs() * 5).long()
        low, high = self.table[index], self.table[-1 - index]
        mixed = (low * x[:, :2, None] + high * (1 - x[:, :2, None]) ** 2).sum(1)
        return torch.cat([mixed, mixed**2, self.codes(index[:, 0]) * x[:, 2:3] ** 3], 1)


class Planes(nn.Module):
    """A field that reads a plane and a volume; samples are dimension 1 of the plane's grid, and 3 of the volume's."""

    def __init__(self) -> None:
        super().__init__()
        self.plane, self.volume = nn.Parameter(torch.randn(1, 3, 5, 4)), nn.Parameter(torch.randn(1, 2, 3, 4, 5))

    def forward(self, x: Tensor) -> Tensor:
        pairs = torch.stack([x[:, :2], x[:, 1:]], 1)
        plane = F.grid_sample(self.plane, pairs[None], align_corners=True)
        volume = F.grid_sample(self.volume, x.view(1, 1, 1, -1, 3), padding_mode="border", align_corners=False)
        return torch.cat([plane[0].permute(1, 0, 2).flatten(1), volume.view(2, -1).T], -1)


class Encoded(nn.Module):
    """A field with an encoder that all cells may share, a table and a head."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(3, 6), nn.ReLU())
        self.table, self.head = nn.Embedding(4, 2), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(torch.cat([self.encoder(x), self.table((x[:, 0] > 0).long())], -1))


def two_layers() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 6), nn.ReLU(), nn.Linear(6, 2))


class Scales(nn.Module):
    """A field that applies a function given by the caller."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__()
        self.fc, self.factor, self.function = nn.Linear(7, 4), nn.Parameter(torch.randn(4)), function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(self.fc(x), self.factor)


def seen(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Returns a function called ``name`` that PyTorch's function modes intercept, like functions of other libraries."""

    def function(rows: Tensor, factor: Tensor) -> Tensor:
        if torch.overrides.has_torch_function((rows, factor)):
            return torch.overrides.handle_torch_function(function, (rows, factor), rows, factor)
        return rows * factor.exp()

    function.__name__ = function.__qualname__ = name
    return function


scale_rows = seen("scale_rows")
register(scale_rows, lambda run, rows, factor: rows * run.rows_of(factor).exp())

SHARED = {"coords": "first3", "share": ["encoder.*", "table.weight"]}
BY_CELL = {2, 4, 13, 15, 18, 21, 33}
RULES = [
    Case("corners", Corners, one(3)),
    Case("planes", Planes, one(3)),
    Case("shared", Encoded, one(3), options=SHARED),
    Case("shared first layer", two_layers, one(3), options={"coords": "first3", "share": ["0.*"]}, fuses=True),
    Case("a rule of one's own", lambda: Scales(scale_rows)),
    *(
        Case(f"step {i}", lambda step=step: Odd(step), one(3), way="cell by cell" if i in BY_CELL else "grouped")
        for i, step in enumerate(STEPS)
    ),
]
