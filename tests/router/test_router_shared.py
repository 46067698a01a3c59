"""Encoders that all cells share (`share=["encoder.*"]`): one look-up for all samples, a small network for each cell.

A loop over cells whose modules have one encoder in common is what values and gradients are compared with.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from router_fields import masked_loop, perturb, tensors
from torch import Tensor, nn

from voronerf import VoronoiRouter

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from ops import foreign_fields as fields


class Lookup(torch.autograd.Function):
    """A compiled look-up, as PyTorch sees it."""

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
    """A box, a table behind a custom function, layers with a norm between them, and harmonics written in place."""

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
        harmonics = torch.empty((*x.shape[:-1], 2))
        harmonics[..., 0] = 0.28
        harmonics[..., 1] = x[..., 0] * x[..., 1]
        return torch.cat([self.norm(self.mix(h)), harmonics], -1)


class Field(nn.Module):
    """An encoder, a network, and a scale of its results that cells share."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.gain = Encoder(), nn.Parameter(torch.rand(4))
        self.net = nn.Sequential(nn.Linear(8, 16), nn.ReLU(), nn.Linear(16, 4))

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        raw = self.net(self.encoder(x)) * self.gain.exp()
        return {"rgb": torch.sigmoid(raw[:, :3]), "sigma": torch.exp(raw[:, 3])}


FIELDS: dict[str, tuple[Callable[[], nn.Module], list[str]]] = {
    "torch-ngp": (lambda: fields.NeRFNetwork(1 << 9, 4, 16), ["encoder.*"]),
    "nerfacto": (lambda: fields.HashTable(1 << 8, 4, 16), ["hash_table"]),
    "hashnerf": (lambda: fields.HashEmbedder(1 << 8, 4, 16), ["embeddings.*"]),
    "tensorf": (lambda: fields.TensorField(8, 4, 16), ["plane.*", "line.*"]),
    "tensorf with its basis": (lambda: fields.TensorField(8, 4, 16), ["plane.*", "line.*", "basis_mat.*"]),
    "k-planes": (lambda: fields.KPlanes((4, 8), 4, 16), ["grids.*"]),
    "layers and functions": (Field, ["encoder.*", "gain"]),
}
SMOOTH = ["torch-ngp", "nerfacto", "hashnerf"]  # torch has no second derivatives of grid_sample


def make(name: str, fuse: bool, k: int = 6) -> VoronoiRouter:
    """A router whose cells differ."""
    torch.manual_seed(k)
    module, share = FIELDS[name][0](), FIELDS[name][1]
    router = VoronoiRouter(module, torch.rand(k, 3) * 2 - 1, coords="first3", share=share, fuse=fuse)
    return perturb(router, torch.Generator().manual_seed(k))


def arguments(name: str, n: int) -> list[Tensor]:
    x = torch.rand(n, 3) * 1.9 - 0.95
    return [x, F.normalize(torch.randn(n, 3), dim=1)] if name == "torch-ngp" else [x]


def of_loop(router: VoronoiRouter, modules: list[nn.Module], gradients: Callable[[list[Tensor]], Any]) -> list[Tensor]:
    """Gradients of a loop's modules as those of a router: summed over cells that share a parameter, else stacked."""
    names = [name for name, _ in router.module.named_parameters()]
    leaves = [module.get_parameter(name) for name in names for module in modules]
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    known = {id(leaf): g for leaf, g in zip(wanted, gradients(wanted), strict=True)}
    found = []
    for name, parameter in router.module.named_parameters():
        own = [known[id(m.get_parameter(name))] for m in modules if parameter.requires_grad]
        if own:
            found.append(torch.stack(own) if parameter.dim() > own[0].dim() else torch.stack(own).sum(0))
    return found


def slopes(out: Tensor, leaves: list[Tensor], **options: Any) -> tuple[Tensor, ...]:
    return torch.autograd.grad(out, leaves, allow_unused=True, materialize_grads=True, **options)


def close(ours: Any, theirs: Any) -> None:
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * (1 + float(b.detach().abs().sum()) / max(b.numel(), 1)))


@pytest.mark.parametrize("fuse", [False, True], ids=["grouped", "fused"])
@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.filterwarnings("ignore:VoronoiRouter")
def test_shared_encoders_run_in_one_pass(name: str, fuse: bool) -> None:
    router = make(name, fuse)
    for n in (200, 63):
        given = arguments(name, n)
        found = tensors(router(*given))
        assert router.explain() == f"forward: {'fused' if fuse else 'grouped'}"
        expected, modules = masked_loop(router, router.assign(given[0]), given)
        close(found, expected)
        weights = [torch.randn(part.shape) for part in found]
        total, theirs = (sum((a * w).sum() for a, w in zip(parts, weights)) for parts in (found, expected))
        ours = slopes(total, [p for p in router.module.parameters() if p.requires_grad])
        close(ours, of_loop(router, modules, lambda leaves, out=theirs: slopes(out, leaves)))  # type: ignore[misc]


@pytest.mark.parametrize("fuse", [False, True], ids=["grouped", "fused"])
@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.filterwarnings("ignore:VoronoiRouter")
def test_second_derivatives_reach_shared_tables(name: str, fuse: bool) -> None:
    """An eikonal loss: squared slopes of an output along the positions, differentiated by every parameter."""
    router, given = make(name, fuse), arguments(name, 150)
    x = given[0].requires_grad_()

    def loss(out: Tensor) -> Tensor:
        (slope,) = torch.autograd.grad(out[:, 3].sum(), x, create_graph=True)
        return slope.square().sum()

    expected, modules = masked_loop(router, router.assign(x.detach()), given)
    ours, theirs = loss(router(*given)), loss(expected[0])
    assert router.explain() == f"forward: {'fused' if fuse else 'grouped'}"
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    close(
        slopes(ours, list(router.module.parameters())), of_loop(router, modules, lambda leaves: slopes(theirs, leaves))
    )


@pytest.mark.parametrize("name", ["torch-ngp", "k-planes", "layers and functions"])
def test_fused_networks_with_shared_encoders_are_split_saved_and_taken_apart(name: str) -> None:
    router, given = make(name, fuse=True), arguments(name, 120)
    optimizer = torch.optim.Adam(router.parameters(), lr=1e-2)
    sum(part.square().sum() for part in tensors(router(*given))).backward()
    optimizer.step()
    shapes = {key: parameter.shape for key, parameter in router.module.named_parameters()}
    before = tensors(router(*given))
    finer, parents = router.diagram.refine({0: torch.rand(3, 3) * 2 - 1})
    router.subdivide(finer, parents, optimizer=optimizer)
    close(tensors(router(*given)), before)
    for key, parameter in router.module.named_parameters():
        assert parameter.shape in (shapes[key], (8, *shapes[key][1:]))
    router(*given)
    sum(part.square().sum() for part in tensors(router(*given))).backward()
    optimizer.step()

    same = tensors(router(*given))
    module, share = FIELDS[name][0](), FIELDS[name][1]
    other = VoronoiRouter(module, torch.rand(2, 3), coords="first3", share=share, fuse=True)
    other.load_state_dict(router.state_dict())
    modules = [router.cell(cell) for cell in range(8)]
    joined = VoronoiRouter.from_modules(modules, router.diagram, coords="first3", share=share, fuse=True)
    for copied in (other, joined, copy.deepcopy(router)):
        close(tensors(copied(*given)), same)
        assert copied.explain() == "forward: fused"
    close(masked_loop(router, router.assign(given[0]), given)[0], same)
    for few in (0, 1, 7):
        close(tensors(router(*[part[:few] for part in given])), [part[:few] for part in same])
    router.eval().blend = 0.3
    with torch.no_grad():
        assert not torch.allclose(tensors(router(*given))[0], same[0])


class Changed(nn.Module):
    """A layer behind a step."""

    def __init__(self, step: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.net, self.table, self.step = nn.Linear(3, 2), nn.Embedding(5, 3), [step]

    def forward(self, x: Tensor) -> Tensor:
        return self.net(self.step[0](self, x))


@pytest.mark.parametrize(
    ("share", "step", "says"),
    [
        ([], lambda net, x: x + net.table((x[:, 0] > 0).long()), "parameters meet samples in torch.nn.functional.emb"),
        (
            ["table.*"],
            lambda net, x: (x + net.table.weight[0])[:, None].expand(-1, 2, -1),
            "on other than one row for each sample",
        ),
    ],
)
def test_what_does_not_fuse_is_refused_with_its_line(share: list[str], step: Any, says: str) -> None:
    router = VoronoiRouter(Changed(step), torch.rand(4, 3), coords="first3", share=share, fuse=True)
    with pytest.raises(
        ValueError, match=rf"fuse=True needs a network .* in Changed.forward .*{says}.*test_router_shared"
    ):
        router(torch.rand(50, 3))


@pytest.mark.parametrize("fuse", [False, True])
def test_a_module_that_writes_into_its_argument_leaves_that_of_the_call_alone(fuse: bool) -> None:
    def clamped(net: Any, x: Tensor) -> Tensor:
        return x.view(-1, 3).clamp_(0.1, 0.5) + net.table.weight[0]

    router = VoronoiRouter(Changed(clamped), torch.rand(4, 3), coords="first3", share=["table.*"], fuse=fuse)
    x = torch.rand(50, 3)
    before, cells = x.clone(), router.assign(x)
    found = router(x)
    assert torch.equal(x, before) and router.explain() == f"forward: {'fused' if fuse else 'grouped'}"
    torch.testing.assert_close(found, masked_loop(router, cells, [x])[0][0])
