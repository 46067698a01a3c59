"""Fields of other codebases, with unusual calls or unusual operations on samples."""

from __future__ import annotations

import warnings
from typing import Any

import torch
import torch.nn.functional as F
from convention_harness import Case, one, uniform
from convention_listed import pair
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from voronerf import NeRF


class Heads(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.trunk = nn.Linear(7, 8)
        self.heads = nn.ModuleDict({"rgb": nn.Linear(8, 3), "sigma": nn.Linear(8, 1), "semantics": nn.Linear(8, 5)})

    def forward(self, x: Tensor) -> dict[str, Any]:
        h = F.elu(self.trunk(x))
        result: dict[str, Any] = {name: head(h) for name, head in self.heads.items()}
        result["semantics"] = {"logits": result["semantics"], "label": result["semantics"].argmax(-1)}
        return {**result, "normals": None, "kind": "heads"}


class ControlFlow(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.near, self.far, self.out = nn.Linear(7, 8), nn.Linear(3, 8), nn.Linear(8, 3)

    def forward(self, x: Tensor, mode: str = "near", *, scale: float = 1.0, extra: Tensor | None = None) -> Tensor:
        if x.shape[0] == 0:
            return x.new_zeros(0, 3)
        h = self.near(x) if mode == "near" and x.shape[-1] == 7 else self.far(x[..., :3])
        if extra is not None:
            h = h + extra
        if self.training and scale > 1:
            h = h * scale
        while h.shape[-1] > 8:
            h = h[..., :-1]
        return self.out(torch.relu_(h))


class Branches(nn.Module):
    """A field with ``view(-1, C)``, products of activations, chunks, in-place operations and buffers."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("bands", 2.0 ** torch.arange(2))
        self.fc, self.film, self.out = nn.Linear(12, 12), nn.Linear(12, 24), nn.Linear(12, 4)

    def forward(self, x: Tensor) -> Tensor:
        waves = (x[..., :3, None] * self.bands).flatten(-2)
        h = self.fc(torch.cat([waves.sin(), waves.cos()], -1))
        gamma, beta = self.film(h).chunk(2, -1)
        h = h * gamma
        h += beta
        h[..., :2] += 1
        matrix = h.view(-1, 4, 3)
        h = torch.bmm(matrix, matrix.transpose(1, 2)).view(-1, 16)[:, :12]
        h = torch.softmax(h, -1) / h.norm(dim=-1, keepdim=True)
        out = self.out(h)
        return torch.cat([torch.sigmoid(out[..., :3]), out[..., 3:].clamp(min=0)], -1)


class Normals(nn.Module):
    """A field that computes a gradient in ``forward`` and stores a tensor on the module, as in nerfstudio."""

    def __init__(self) -> None:
        super().__init__()
        self.sdf, self.colour = nn.Sequential(nn.Linear(3, 8), nn.Softplus(), nn.Linear(8, 5)), nn.Linear(10, 3)
        self._points: Tensor | None = None

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        with torch.enable_grad():
            self._points = x if x.requires_grad else x.detach().requires_grad_()
            h = self.sdf(self._points)
            (normal,) = torch.autograd.grad(h[:, 0].sum(), self._points, create_graph=True)
        rgb = torch.sigmoid(self.colour(torch.cat([h[:, 1:], normal, x], -1)))
        return h[:, :1], F.normalize(normal, dim=-1), rgb


class Checkpointed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.block, self.out = nn.Sequential(nn.Linear(7, 8), nn.ReLU(), nn.Linear(8, 8)), nn.Linear(8, 3)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(checkpoint(self.block, x, use_reentrant=False))


class RowOrder(nn.Module):
    """A field that selects or sorts its samples in ``forward``, and restores their order."""

    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way
        self.net = nn.Sequential(nn.Linear(7, 8), nn.ReLU(), nn.Linear(8, 3))

    def forward(self, x: Tensor) -> Tensor:
        if self.way == "box":
            inside = (x[:, :3].abs() < 0.6).all(-1)
            out = x.new_zeros(len(x), 3)
            out[inside] = self.net(x[inside])
            return out
        order = x[:, 3].argsort()
        return self.net(x[order])[order.argsort()]


def squareplus(x: Tensor, b: float) -> Tensor:
    return 0.5 * (x + torch.sqrt(x * x + b))


with warnings.catch_warnings():  # TorchScript is deprecated, but old code uses it
    warnings.simplefilter("ignore", DeprecationWarning)
    scripted = torch.jit.script(squareplus)


class Scripted(nn.Module):
    """A field with a TorchScript function, whose operations are hidden from PyTorch function modes."""

    def __init__(self) -> None:
        super().__init__()
        self.fc, self.out = nn.Linear(7, 8), nn.Linear(8, 3)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(scripted(self.fc(x), 4.0))


class TruncExp(torch.autograd.Function):
    """torch-ngp's ``trunc_exp``, with its autocast decorators; the backward pass clamps the exponent."""

    @staticmethod
    @torch.amp.custom_fwd(device_type="cpu", cast_inputs=torch.float32)
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    @torch.amp.custom_bwd(device_type="cpu")
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * torch.exp(x.clamp(max=-1))


class Truncated(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(7, 8), nn.ReLU(inplace=True), nn.Linear(8, 4))

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"sigma": TruncExp.apply(h[..., 0]), "rgb": torch.sigmoid(h[..., 1:])}


CALLS = [
    Case("table", lambda: NeRF(width=10, depth=3, skips=(1,)), pair, options={}, way="fused"),
    Case("heads", Heads),
    Case("control flow, near", ControlFlow, lambda lead: ((uniform(lead, 7),), {"scale": 2.0})),
    Case("control flow, far", ControlFlow, lambda lead: ((uniform(lead, 7), "far"), {"extra": uniform(lead, 8)})),
    Case("branches", Branches, one(3)),
    Case("normals inside", Normals, one(3)),
    *(Case(f"row order, {way}", lambda way=way: RowOrder(way), way="cell by cell") for way in ("box", "sorted")),
    Case("scripted", Scripted, way="cell by cell"),
    Case("truncated exponential", Truncated, fuses=True),
    Case("checkpointed", Checkpointed, way="cell by cell"),
]
