"""Fields whose tensors have samples in other axes, or constants with as many rows as some batch has samples."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from convention_harness import Case, one
from torch import Tensor, nn


class HeadsInFront(nn.Module):
    """The interaction layer of AutoInt: attention over the fields of a sample, with heads in front of the samples."""

    def __init__(self, nonlinear: bool = False) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Parameter(torch.randn(4, 4) / 2) for _ in range(3))
        self.nonlinear = nonlinear

    def forward(self, x: Tensor) -> Tensor:
        x = x.reshape(len(x), 3, 4)
        parts = (torch.tensordot(x, weight, dims=([-1], [0])) for weight in (self.query, self.key, self.value))
        q, k, v = (torch.stack(torch.split(part, 2, dim=2)) for part in parts)
        q = torch.cosh(q) if self.nonlinear else q
        scores = torch.einsum("bnik,bnjk->bnij", q, k).softmax(-1)
        return torch.cat(torch.split(scores @ v, 1), dim=-1).squeeze(0).flatten(1)


class Transposed(nn.Module):
    """A function without a step between two layers, on features in front."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(3, 32), nn.Linear(32, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.outer(torch.cosh(self.inner(x).t()).t())


class Scaled(nn.Module):
    """A scale, a product and a normalisation of features in front of the samples, [features, n]."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.scale = nn.Linear(3, 8), nn.Parameter(torch.rand(8, 1))
        self.left, self.stacked = nn.Parameter(torch.randn(5, 8)), nn.Parameter(torch.randn(4, 5, 2))

    def forward(self, x: Tensor) -> Tensor:
        h = torch.tanh(self.left @ (self.inner(x).t() * self.scale))
        return (h.t().unsqueeze(0) @ self.stacked).movedim(0, 1).flatten(1)


class Sensors(nn.Module):
    """A DeepONet: a branch of the sample, and a trunk of places that all samples share."""

    def __init__(self, places: int) -> None:
        super().__init__()
        self.branch, self.trunk = nn.Linear(3, 4), nn.Linear(2, 4)
        self.register_buffer("places", torch.linspace(-1, 1, 2 * places).view(places, 2))

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(self.branch(x)) @ torch.tanh(self.trunk(self.places)).t()


class Squashed(nn.Module):
    """The ConcatSquash layer of ffjord: a gate and a bias that depend on a time alone."""

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.gate, self.bias = nn.Linear(3, 4), nn.Linear(1, 4), nn.Linear(1, 4, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        time = torch.ones(1, 1).type_as(x)
        return self.layer(x) * torch.sigmoid(self.gate(time)) + self.bias(torch.full((1, 1), 0.3).to(x))


class Flow(nn.Module):
    """The field of torchdiffeq's continuous flow, whose weights come from a network of the time."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(1, 8), nn.Linear(8, 4 * 7)

    def forward(self, x: Tensor) -> Tensor:
        numbers = self.second(torch.tanh(self.first(torch.full((1, 1), 0.3).to(x)))).reshape(-1)
        inner, outer, bias = (
            numbers[:12].reshape(4, 3, 1),
            numbers[12:24].reshape(4, 1, 3),
            numbers[24:].reshape(4, 1, 1),
        )
        h = torch.tanh(x.unsqueeze(0).repeat(4, 1, 1) @ inner + bias)
        return (h @ outer).mean(0)


class Masked(nn.Module):
    """MADE: layers whose weights have a mask."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(3, 12), nn.Linear(12, 3)
        self.register_buffer("mask", (torch.arange(36).view(12, 3) % 5 > 1).float())

    def forward(self, x: Tensor) -> Tensor:
        h = F.relu(F.linear(x, self.inner.weight * self.mask, self.inner.bias))
        return F.linear(h, self.outer.weight * self.mask.t(), self.outer.bias)


class Attention(nn.Module):
    """nanoGPT's block: causal attention over the tokens of a sample."""

    def __init__(self, tokens: int, heads: int) -> None:
        super().__init__()
        self.heads, self.norm = heads, nn.LayerNorm(4)
        self.attend, self.project = nn.Linear(4, 12), nn.Linear(4, 4)
        self.register_buffer("bias", torch.tril(torch.ones(tokens, tokens)).view(1, 1, tokens, tokens))

    def forward(self, x: Tensor) -> Tensor:
        x = x.reshape(len(x), -1, 4)
        size, tokens, width = x.size()
        parts = self.attend(self.norm(x)).split(width, dim=2)
        q, k, v = (p.view(size, tokens, self.heads, width // self.heads).transpose(1, 2) for p in parts)
        scores = (q @ k.transpose(-2, -1)) / math.sqrt(k.size(-1))
        scores = scores.masked_fill(self.bias[:, :, :tokens, :tokens] == 0, float("-inf")).softmax(-1)
        y = torch.cosh(scores @ v).transpose(1, 2).contiguous().view(size, tokens, width)
        return (x + self.project(y)).flatten(1)


class Cells(nn.Module):
    """Single steps of recurrent cells."""

    def __init__(self) -> None:
        super().__init__()
        self.gru, self.lstm, self.rnn = nn.GRUCell(3, 6), nn.LSTMCell(3, 6), nn.RNNCell(3, 6)

    def forward(self, x: Tensor) -> Tensor:
        h, c = self.lstm(x, (self.gru(x), torch.zeros(len(x), 6).to(x)))
        return self.rnn(x, h) * c


class Series(nn.Module):
    """A forecast from the last state of a recurrent layer along 4 steps of 3 features."""

    def __init__(self, kind: type[nn.RNNBase], **options: Any) -> None:
        super().__init__()
        self.layer = kind(3, 5, batch_first=True, **options)
        self.out = nn.Linear(5 * (1 + self.layer.bidirectional), 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.layer(x.reshape(len(x), 4, 3))[0][:, -1])


SIZES = [
    Case("heads in front", HeadsInFront, one(12), fuses=True),
    Case("heads in front, cosh", lambda: HeadsInFront(True), one(12), fuses=True),
    Case("features in front", Transposed, one(3), fuses=True),
    Case("products in front", Scaled, one(3), fuses=True),
    *(Case(f"{places} sensors", lambda places=places: Sensors(places), one(3), fuses=True) for places in (1, 16, 37)),
    Case("gate of a constant", Squashed, one(3), fuses=True),
    Case("weights of a constant", Flow, one(3), fuses=True),
    Case("masked weights", Masked, one(3), fuses=True),
    *(
        Case(f"{t} tokens", lambda t=t, h=h: Attention(t, h), one(4 * t), fuses=True)
        for t, h in ((1, 2), (3, 1), (33, 2))
    ),
    Case("recurrent cells", Cells, one(3), fuses=True),
    Case("LSTM", lambda: Series(nn.LSTM), one(12)),
    Case("LSTM of two layers in both directions", lambda: Series(nn.LSTM, num_layers=2, bidirectional=True), one(12)),
    Case("GRU", lambda: Series(nn.GRU), one(12)),
    Case("RNN without biases", lambda: Series(nn.RNN, bias=False, nonlinearity="relu"), one(12)),
]
