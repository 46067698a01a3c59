"""Encoders that all cells share (`share=["encoder.*"]`): one look-up for all samples, then a network for each cell."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from convention_harness import Case, one, uniform
from torch import Tensor, nn

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from ops import foreign_fields as fields


class Lookup(torch.autograd.Function):
    """A table look-up as a custom autograd function, like compiled look-ups."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.entries = len(table)
        return table[index]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.entries, gradient.shape[-1]).index_add(0, index, gradient), None


class Encoder(nn.Module):
    """An encoder with a box, a table read by a custom function, layers, a norm, and harmonics written in place."""

    def __init__(self) -> None:
        super().__init__()
        self.aabb = nn.Parameter(torch.tensor([[-1.0] * 3, [1.0] * 3]), requires_grad=False)
        self.table, self.waves = nn.Parameter(torch.randn(27, 2)), nn.Parameter(torch.randn(3, 4))
        self.mix, self.norm = nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 6)), nn.LayerNorm(6)

    def forward(self, x: Tensor) -> Tensor:
        x = (x - self.aabb[0]) / (self.aabb[1] - self.aabb[0])
        index = (x.detach() * 2.99).clamp(0, 2.99).long()
        index *= torch.tensor([1, 3, 9])
        h = torch.cat([Lookup.apply(self.table, index.sum(-1)), torch.sin(x @ self.waves)], -1)
        harmonics = torch.empty((*x.shape[:-1], 2), dtype=x.dtype)
        harmonics[..., 0] = 0.28
        harmonics[..., 1] = x[..., 0] * x[..., 1]
        return torch.cat([self.norm(self.mix(h)), harmonics], -1)


class Field(nn.Module):
    """A field with an encoder, a network, and a scale of the results; cells may share the encoder and the scale."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.gain = Encoder(), nn.Parameter(torch.rand(4))
        self.net = nn.Sequential(nn.Linear(8, 16), nn.ReLU(), nn.Linear(16, 4))

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        raw = self.net(self.encoder(x)) * self.gain.exp()
        return {"rgb": torch.sigmoid(raw[:, :3]), "sigma": torch.exp(raw[:, 3])}


def inside(lead: tuple[int, ...]) -> Any:
    """Returns positions inside the range of the tables, and directions."""
    return (uniform(lead) * 0.95, F.normalize(uniform(lead), dim=-1)), {}


def sharing(*names: str) -> dict[str, Any]:
    return {"coords": "first3", "share": list(names)}


FUSED = [
    Case("nerfacto, shared", lambda: fields.HashTable(1 << 8, 4, 16), one(3), options=sharing("hash_table")),
    Case("hashnerf, shared", lambda: fields.HashEmbedder(1 << 8, 4, 16), one(3), options=sharing("embeddings.*")),
    Case("tensorf, shared", lambda: fields.TensorField(8, 4, 16), one(3), options=sharing("plane.*", "line.*")),
    Case(
        "tensorf with its basis, shared",
        lambda: fields.TensorField(8, 4, 16),
        one(3),
        options=sharing("plane.*", "line.*", "basis_mat.*"),
    ),
    Case("k-planes, shared", lambda: fields.KPlanes((4, 8), 4, 16), one(3), options=sharing("grids.*")),
]
ENCODERS = [
    *(case.fused() for case in FUSED),
    Case(
        "torch-ngp, shared", lambda: fields.NeRFNetwork(1 << 9, 4, 16), inside, options=sharing("encoder.*"), fuses=True
    ),
    Case("layers and functions, shared", Field, one(3), options=sharing("encoder.*", "gain"), fuses=True),
]
