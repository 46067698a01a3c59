"""Fields of other codebases, with many uses of parameters: layers, norms, raw weights, tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from convention_harness import Case, one, uniform
from torch import Tensor, nn


class Siren(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = nn.ModuleList([nn.Linear(3, 9), nn.Linear(9, 9), nn.Linear(9, 1)])

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.net[:-1]:
            x = torch.sin(3 * layer(x))
        return self.net[-1](x).squeeze(-1)  # [n]


class LearnedScale(nn.Module):
    """A field with elementwise parameters: [d], [1, d] and a scalar (VolSDF's beta, NeuS's variance)."""

    def __init__(self) -> None:
        super().__init__()
        self.fc, self.out = nn.Linear(7, 6), nn.Linear(6, 3)
        self.scale, self.shift = nn.Parameter(torch.ones(6)), nn.Parameter(torch.zeros(1, 6))
        self.beta = nn.Parameter(torch.tensor(0.1))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        h = torch.tanh(self.scale * self.fc(x) + self.shift)
        inverse = torch.ones([len(x), 1], dtype=x.dtype) * torch.exp(self.beta * 10.0)
        return self.out(h) * self.beta.abs().clamp(min=1e-4), inverse


class OldWeightNorm(nn.Module):
    """NeuS's SDF network: weight norm, softplus with beta = 100, and a skip divided by the square root of two."""

    def __init__(self, norm: Callable[[nn.Module], nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList([norm(nn.Linear(3, 8)), norm(nn.Linear(11, 8)), norm(nn.Linear(8, 4))])

    def forward(self, x: Tensor) -> Tensor:
        h = F.softplus(self.layers[0](x), beta=100)
        h = F.softplus(self.layers[1](torch.cat([h, x], 1) / math.sqrt(2)), beta=100)
        return self.layers[2](h)

    def sdf(self, x: Tensor) -> Tensor:
        return self.forward(x)[:, :1]


def by_hooks() -> nn.Module:
    return OldWeightNorm(nn.utils.weight_norm)


def parametrized() -> nn.Module:
    return OldWeightNorm(nn.utils.parametrizations.weight_norm)


def normed() -> nn.Module:
    return nn.Sequential(nn.utils.weight_norm(nn.Linear(7, 8)), nn.ReLU(), nn.Linear(8, 4))


class Residual(nn.Module):
    def __init__(self, norm: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.stem = nn.Linear(7, 8)
        self.blocks = nn.ModuleList(nn.Sequential(norm(), nn.Linear(8, 8), nn.SiLU(), nn.Linear(8, 8)) for _ in "ab")
        self.head = nn.Sequential(nn.LayerNorm(8), nn.Linear(8, 4))

    def forward(self, x: Tensor) -> Tensor:
        h = self.stem(x)
        for block in self.blocks:
            h = h + block(h)
        return self.head(h)


class RawWeights(nn.Module):
    """A field without ``nn.Linear``, which multiplies weights and samples in one of several ways."""

    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way
        self.w, self.v = nn.Parameter(torch.randn(8, 7) / 3), nn.Parameter(torch.randn(8, 4) / 3)
        self.b, self.c = nn.Parameter(torch.zeros(8)), nn.Parameter(torch.zeros(4))

    def forward(self, x: Tensor) -> Tensor:
        if self.way == "linear":
            h = torch.sigmoid(F.linear(x, self.w, self.b))
            return F.linear(h, self.v.t(), self.c)
        if self.way == "matmul":
            h = torch.sigmoid(x @ self.w.T + self.b)
            return torch.matmul(h, self.v) + self.c
        if self.way == "transposed":
            h = torch.sigmoid(self.w @ x.T + self.b[:, None])
            return (self.v.T @ h).T + self.c
        h = torch.sigmoid(torch.einsum("ni,oi->no", x, self.w) + self.b)
        return torch.einsum("nd,dc->nc", h, self.v) + self.c[None, :]


class Tied(nn.Module):
    """A field with one layer used twice, and two layers that share one weight."""

    def __init__(self) -> None:
        super().__init__()
        self.stem, self.shared, self.twin = nn.Linear(7, 8), nn.Linear(8, 8), nn.Linear(8, 8)
        self.twin.weight = self.shared.weight

    def forward(self, x: Tensor) -> Tensor:
        h = F.relu(self.stem(x))
        h = F.relu(self.shared(h)) + F.relu(self.shared(F.relu(self.twin(h))))
        return F.linear(h, self.stem.weight.t())


class LatentCode(nn.Module):
    """A field with a latent vector as a parameter, which is repeated for every sample."""

    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way
        self.code, self.table = nn.Parameter(torch.randn(1, 4)), nn.Parameter(torch.randn(6, 4))
        self.fc = nn.Linear(11, 3)

    def forward(self, x: Tensor) -> Tensor:
        if self.way == "expand":
            code = self.code.expand(x.shape[0], -1)
        elif self.way == "index":
            code = self.table[(x[:, 0] > 0).long() + 2]
        elif self.way == "row":
            code = self.table[3].expand(len(x), 4)
        else:
            code = self.table.mean(dim=0).expand(len(x), 4)
        return self.fc(torch.cat([x, code], -1))


class Lookup(nn.Module):
    """A field with appearance codes: from nn.Embedding and F.embedding by image, or their average."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding, self.fc = nn.Embedding(6, 4), nn.Linear(11, 3)

    def forward(self, x: Tensor, image: Tensor | None = None) -> Tensor:
        if image is None:
            code = self.embedding.weight.mean(dim=0).expand(x.shape[0], -1)
        else:
            code = self.embedding(image) + F.embedding(image, self.embedding.weight)
        return self.fc(torch.cat([x, code], -1))


class Convolution(nn.Module):
    """A field with a convolution over the features of each sample, which has no grouped version."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.fc = nn.Conv1d(1, 2, 3), nn.Linear(10, 3)

    def forward(self, x: Tensor) -> Tensor:
        assert x.shape[0] > 0, "called without rows"
        return self.fc(self.conv(x[:, None]).flatten(1))


class Between(nn.Module):
    """A field with one layer between two linear layers; ``shape`` is a sample's shape in that layer."""

    def __init__(self, layer: nn.Module, *shape: int) -> None:
        super().__init__()
        self.fc, self.layer, self.out, self.shape = nn.Linear(7, 8), layer, nn.Linear(8, 3), shape or (8,)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.layer(self.fc(x).view(-1, *self.shape)).flatten(1))


class Pairs(nn.Module):
    """A field with a bilinear layer or a tensordot of features and samples."""

    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way
        self.fc, self.pairs = nn.Linear(7, 6), nn.Bilinear(6, 7, 3, bias=way != "bilinear without bias")

    def forward(self, x: Tensor) -> Tensor:
        h = torch.tanh(self.fc(x))
        if self.way == "tensordot":
            return torch.tensordot((h[:, :, None] * x[:, None]), self.pairs.weight, ([1, 2], [1, 2])) + self.pairs.bias
        return self.pairs(h, x)


def batch_norm(kind: type[nn.Module], channels: int, *, affine: bool = True) -> nn.Module:
    """Returns a batch norm in evaluation mode, which treats samples one by one."""
    layer: Any = kind(channels, affine=affine)
    layer.running_mean += torch.linspace(-0.5, 0.5, channels)
    layer.running_var *= torch.linspace(0.5, 2.0, channels)
    return layer.eval()


def images(lead: tuple[int, ...]) -> Any:
    return (uniform(lead, 7), torch.randint(0, 6, lead)), {}


SDF = {"coords": "first3", "methods": ["sdf"]}

LAYERS = [
    Case("siren", Siren, one(3), fuses=True),
    Case("learned scale", LearnedScale),
    Case("weight_norm by hooks", by_hooks, one(3), options=SDF, method="sdf", by_parameters=False),
    Case("weight_norm by parametrization", parametrized, one(3), by_parameters=False),
    Case("weight_norm that fuses", normed, fuses=True, by_parameters=False),
    Case("layer norm", lambda: Residual(lambda: nn.LayerNorm(8))),
    Case("raw weights, transposed", lambda: RawWeights("transposed")),
    Case("raw weights, linear", lambda: RawWeights("linear"), fuses=True),
    *(Case(f"raw weights, {way}", lambda way=way: RawWeights(way)) for way in ("matmul", "einsum")),
    Case("tied", Tied),
    *(Case(f"latent code, {way}", lambda way=way: LatentCode(way)) for way in ("expand", "index", "row", "mean")),
    Case("embedding", Lookup, images),
    Case("embedding's average", Lookup),
    Case("convolution", Convolution, way="cell by cell"),
    Case(
        "batch norm in evaluation, plain",
        lambda: Between(batch_norm(nn.BatchNorm2d, 4, affine=False), 4, 2, 1),
        fuses=True,
    ),
    *(
        Case(name, make, fuses=True)
        for name, make in {
            "PReLU": lambda: Between(nn.PReLU()),
            "PReLU of channels": lambda: Between(nn.PReLU(4), 4, 2),
            "group norm": lambda: Between(nn.GroupNorm(2, 8)),
            "group norm of channels": lambda: Between(nn.GroupNorm(2, 4), 4, 2),
            "instance norm": lambda: Between(nn.InstanceNorm1d(2, affine=True), 2, 4),
            "batch norm in evaluation": lambda: Between(batch_norm(nn.BatchNorm1d, 8)),
            "batch norm in evaluation, of channels": lambda: Between(batch_norm(nn.BatchNorm1d, 4), 4, 2),
            **{way: lambda way=way: Pairs(way) for way in ("bilinear", "bilinear without bias", "tensordot")},
        }.items()
    ),
]
