"""Small modules by kind; each shows a coding habit of some public repository."""

from __future__ import annotations

import itertools
import math
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ops import foreign_fields as fields
from ops.foreign_imports import GridEncoder, SHEncoder
from ops.foreign_rows import Row, evaluated, inner, uniform

W = 24  # width
Part = int | tuple[int, int] | Callable[[], Any]


class Module(nn.Module):
    """A module from named parts; its forward is a function of the module and the arguments."""

    def __init__(self, call: Callable[..., Any], parts: dict[str, Any]) -> None:
        super().__init__()
        for name, part in parts.items():
            if isinstance(part, Tensor) and not isinstance(part, nn.Parameter):
                self.register_buffer(name, part)
            else:
                setattr(self, name, part)
        self.call = call

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return self.call(self, *args, **kwargs)


def mlp(i: int, o: int, activation: Callable[[], nn.Module] = nn.ReLU, width: int = W) -> Callable[[], nn.Module]:
    return lambda: nn.Sequential(
        nn.Linear(i, width), activation(), nn.Linear(width, width), activation(), nn.Linear(width, o)
    )


PARTS: dict[str, Part] = {"a": (3, W), "b": (W, W), "o": (W, 4), "net": 3}


def own(name: str, call: Callable[..., Any], *inputs: Any, second: bool = False, **parts: Part) -> Row:
    """Returns the row of a :class:`Module`.

    Layers a, b and o and a network `net` always exist, used or unused, as in public code.

    Args:
        name: The name of the row.
        call: The forward: a function of the module and the arguments.
        inputs: The arguments, see :class:`Row`. Default: positions.
        second: Whether second derivatives are compared, too.
        parts: The module's attributes by name. A pair (inputs, outputs) makes a linear layer, and a single number of
            inputs makes a network with four outputs. A function makes any other part.
    """

    def build(part: Part) -> Any:
        return nn.Linear(*part) if isinstance(part, tuple) else mlp(part, 4)() if isinstance(part, int) else part()

    def make() -> nn.Module:
        return Module(call, {name: build(part) for name, part in {**PARTS, **parts}.items()})

    return Row(name, make, inputs or (3,), second=second)


def parameter(*shape: int, scale: float = 0.3) -> Callable[[], nn.Parameter]:
    return lambda: nn.Parameter(scale * torch.randn(*shape))


def buffer(*shape: int, scale: float = 2.0) -> Callable[[], Tensor]:
    return lambda: scale * torch.randn(*shape)


def number(value: float) -> Callable[[], nn.Parameter]:
    return lambda: nn.Parameter(torch.tensor(value))


def octaves(count: int) -> Callable[[], Tensor]:
    return lambda: 2.0 ** torch.arange(count)


def layers(*sizes: int) -> Callable[[], nn.ModuleList]:
    return lambda: nn.ModuleList(nn.Linear(i, o) for i, o in itertools.pairwise(sizes))


def images(lead: tuple[int, ...]) -> Tensor:
    return torch.randint(0, 9, lead)


# plain ----------------------------------------------------------------------------------------------------------------


def skipping(s: Any, x: Tensor, d: Tensor) -> Tensor:
    h = x
    for i, layer in enumerate(s.trunk):
        h = F.relu(layer(torch.cat([h, x], -1) if i == 2 else h))
    return torch.cat([s.rgb(F.relu(s.view(torch.cat([h, d], -1)))).sigmoid(), F.softplus(s.sigma(h))], -1)


def trunk() -> nn.ModuleList:
    return nn.ModuleList([nn.Linear(3, W), nn.Linear(W, W), nn.Linear(W + 3, W)])


def counted(s: Any, x: Tensor) -> Tensor:
    for i in range(len(s.net)):
        x = s.net[i](x)
        if i < len(s.net) - 1:
            x = torch.relu_(x)
    return x


def by_name(s: Any, x: Tensor) -> Tensor:
    for i in range(3):
        x = getattr(s, f"lin{i}")(x)
        x = s.act(x) if i < 2 else x
    return x


def narrowed(s: Any, x: Tensor, only: bool = False) -> Tensor:
    h = F.relu(s.a(x[..., :3]))
    sigma = s.sigma(h)
    return sigma if only else torch.cat([s.b(torch.cat([h, x[..., 3:]], -1)), sigma], -1)


PLAIN = [
    Row("NeRF", fields.NeRF, (90,)),
    Row("NeRF of width 32", lambda: fields.NeRF(32), (90,)),
    Row("nerfacc", fields.VanillaField, (3, 3)),
    Row("D-NeRF", fields.DNeRF, (3,)),
    Row("BARF", fields.Barf, (3,)),
    own("skip and view", skipping, 3, 3, trunk=trunk, view=(W + 3, W), rgb=(W, 3), sigma=(W, 1)),
    own("list by number, relu_", counted, net=layers(3, W, W, 4)),
    own("layers by name", by_name, lin0=(3, W), lin1=(W, W), lin2=(W, 4), act=nn.ReLU),
    own("sequential", lambda s, x: s.net(x), net=mlp(3, 4, lambda: nn.ReLU(inplace=True))),
    own("slices", narrowed, 9, sigma=(W, 1), b=(W + 6, 3)),
    own("sum of layers", lambda s, x, d: s.o(F.relu(s.a(x) + s.b(d))), 3, 5, b=(5, W)),
    own("stack of heads", lambda s, x: torch.stack([h(x) for h in s.h], 1).mean(1), h=layers(3, 3, 3, 3)),
]

# encodings ------------------------------------------------------------------------------------------------------------


def harmonics(s: Any, d: Tensor) -> Tensor:
    """Writes spherical harmonics of degree 2 into a new tensor."""
    x, y, z = d.unbind(-1)
    values = d.new_empty(*d.shape[:-1], 9)
    values[..., 0] = 0.282
    values[..., 1], values[..., 2], values[..., 3] = -0.489 * y, 0.489 * z, -0.489 * x
    values[..., 4], values[..., 5] = 1.09 * x * y, -1.09 * y * z
    values[..., 6] = 0.315 * (2 * z * z - x * x - y * y)
    values[..., 7], values[..., 8] = -1.09 * x * z, 0.546 * (x * x - y * y)
    return s.net(values)


def integrated(s: Any, mean: Tensor, variance: Tensor) -> Tensor:
    y = (mean[..., None, :] * s.f[:, None]).flatten(-2)
    v = (variance[..., None, :].exp() * s.f[:, None] ** 2).flatten(-2)
    waves = torch.exp(-0.5 * torch.cat([v, v], -1)) * torch.sin(torch.cat([y, y + 0.5 * math.pi], -1))
    return s.net(waves)


def contracted(s: Any, x: Tensor) -> Tensor:
    x = 2 * x
    size = x.norm(dim=-1, keepdim=True).clamp_min(1e-3)
    return s.net(torch.where(size <= 1, x, (2 - 1 / size) * (x / size)))


def listed(s: Any, x: Tensor) -> Tensor:
    out = [x]
    for f in s.f:
        out += [torch.sin(f * x), torch.cos(f * x)]
    return s.net(torch.cat(out, -1))


def products(s: Any, x: Tensor) -> Tensor:
    projected = torch.einsum("ij,k->ijk", x, s.f)
    return s.net(torch.cat([projected.sin(), projected.cos()], 1).transpose(2, 1).contiguous().view(len(x), -1))


ENCODINGS = [
    own("list", listed, f=octaves(4), net=27),
    own("einsum", products, f=octaves(4), net=24),
    own(
        "stack",
        lambda s, x: s.net(torch.stack([(x[..., None] * s.f).sin(), (x[..., None] * s.f).cos()], -1).flatten(-3)),
        f=octaves(4),
        net=24,
    ),
    own("Gaussian", lambda s, x: s.net(torch.cat([(x @ s.b).sin(), (x @ s.b).cos()], -1)), b=buffer(3, 16), net=32),
    own("Gaussian, turned", lambda s, x: s.net(torch.cos(F.linear(x, s.b) + 0.3)), b=buffer(16, 3), net=16),
    own("learned", lambda s, x: s.net((x[:, None] * s.f[:, None]).flatten(1).sin()), f=parameter(5), net=15),
    own("integrated", integrated, 3, 3, f=octaves(4), net=24),
    own("harmonics, written", harmonics, net=9),
    own("harmonics, stacked", lambda s, d: s.net(s.e(d)), e=SHEncoder, net=16),
    own("contraction", contracted),
    own(
        "box",
        lambda s, x: s.net((x - s.box[0]) / (s.box[1] - s.box[0]) * 2 - 1),
        box=lambda: torch.tensor([[-2.0] * 3, [2.0] * 3]),
    ),
    own("octaves by power", lambda s, x: s.net(torch.cat([torch.sin(2.0**i * x) for i in range(4)], -1)), net=12),
]

# outputs --------------------------------------------------------------------------------------------------------------

Field = namedtuple("Field", ["rgb", "sigma"])


def spelled(name: str, call: Callable[[Tensor], Any]) -> Row:
    """Returns the row of a module that applies ``call`` to the four outputs of its network."""
    return own(name, lambda s, x: call(s.net(x)))


OUTPUTS = [
    spelled("tuple of split", lambda h: torch.split(h, [3, 1], -1)),
    spelled("unpacked split", lambda h: (lambda rgb, sigma: (rgb, sigma))(*h.split([3, 1], dim=-1))),
    spelled("piece of split", lambda h: torch.split(h, 2, -1)[1]),
    spelled("dict of split", lambda h: dict(zip(("rgb", "sigma"), torch.split(h, [3, 1], -1)))),
    spelled("chunk", lambda h: h.chunk(2, dim=-1)),
    spelled("piece of chunk", lambda h: torch.chunk(h, 4, -1)[2]),
    spelled("list of unbind", lambda h: list(h.unbind(-1))),
    spelled("piece of unbind", lambda h: torch.unbind(h, dim=1)[0]),
    spelled("tensor_split", lambda h: h.tensor_split((1, 3), dim=-1)),
    spelled("split and a function of it", lambda h: (h.split([3, 1], -1)[0].sigmoid(), h.split([3, 1], -1)[1])),
    spelled("named tuple", lambda h: Field(torch.sigmoid(h[..., :3]), h[..., 3].relu())),
    spelled("nested", lambda h: {"a": {"rgb": h[:, :3]}, "b": [h[:, 3:], None], "name": "field"}),
    spelled("squeezed", lambda h: (h[..., :3], h[..., 3:].squeeze(-1))),
    spelled("the same twice", lambda h: (h, h)),
]

# activations ----------------------------------------------------------------------------------------------------------

NAMES = "ReLU SiLU GELU ELU SELU Mish Tanh Sigmoid Softplus Softsign Hardtanh ReLU6 LogSigmoid Tanhshrink"
GIVEN = [nn.GELU("tanh"), nn.Softplus(100), nn.LeakyReLU(0.2), nn.Softmax(-1)]
ACTIVATIONS = [
    Row(str(kind), lambda kind=kind: fields.Activated(kind, 32), (3,))
    for kind in (*(getattr(nn, name)() for name in NAMES.split()), *GIVEN)
]

# periodic -------------------------------------------------------------------------------------------------------------


def gabor(s: Any, x: Tensor) -> Tensor:
    return s.o(torch.cos(10 * s.a(x)) * torch.exp(-((3 * s.b(x)) ** 2)))


def filters(s: Any, x: Tensor) -> Tensor:
    z = torch.sin(s.f[0](x))
    for f, layer in zip(s.f[1:], s.l):
        z = torch.sin(f(x)) * layer(z)
    return s.o(z)


def distances(s: Any, x: Tensor) -> Tensor:
    """Computes Gabor filters of a multiplicative network, each with its centre and width."""
    d = (x**2).sum(-1)[..., None] + (s.mu**2).sum(-1)[None, :] - 2 * x @ s.mu.T
    return s.o(torch.sin(s.a(x)) * torch.exp(-0.5 * d * s.gamma[None, :]))


def periodic(name: str, wave: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(wave(s, s.b(wave(s, s.a(x))))), second=True, **parts)


PERIODIC = [
    Row("SIREN", fields.Siren, (3,), second=True),
    Row("FiLM", fields.FiLM, (3,)),
    Row("BACON", fields.Bacon, (3,)),
    own("Gabor", gabor, second=True, b=(3, W)),
    own("filters", filters, f=layers(3, 3, 3), l=layers(3, 3, 3), o=(3, 4)),
    own("Gabor filters", distances, mu=parameter(W, 3), gamma=lambda: nn.Parameter(torch.rand(W))),
    periodic("sine", lambda s, h: torch.sin(6 * h)),
    periodic("learned sine", lambda s, h: torch.sin(s.w * h), w=number(3.0)),
    periodic("FINER", lambda s, h: torch.sin(3 * (h.abs() + 1) * h)),
    periodic("Gaussian", lambda s, h: torch.exp(-((2 * h) ** 2) / 2)),
    periodic("sinc", lambda s, h: torch.sin(4 * h) / (4 * h + 9)),
    periodic("cosines", lambda s, h: torch.cos(3 * h) + s.c.cos(), c=parameter(W)),
]

# functions that the router cannot fuse --------------------------------------------------------------------------------


class Clipped(torch.autograd.Function):
    """The exponential of torch-ngp, with a clipped gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * torch.exp(ctx.saved_tensors[0].clamp(max=15))


def wire(s: Any, x: Tensor) -> Tensor:
    h = s.a(x)
    h = s.b(torch.exp(2j * h - h.abs().square()))
    return s.o(torch.exp(1j * h - h.abs().square())).real


def clipped(s: Any, x: Tensor) -> tuple[Tensor, Tensor]:
    h = s.net(x)
    return Clipped.apply(h[..., 0]), torch.sigmoid(h[..., 1:])


def by_angles(s: Any, x: Tensor) -> Tensor:
    x = torch.tanh(x).view(-1, 3, 1).expand(-1, -1, 5)
    return torch.einsum("bid,iod->bo", torch.cos(torch.acos(0.99 * x) * s.n), s.c)


def hyper(s: Any, x: Tensor, z: Tensor) -> Tensor:
    """Applies a layer whose weights come from the sample's code."""
    weight, bias = s.m(z).split([W * 3, W], -1)
    return s.o(torch.relu(torch.bmm(weight.view(-1, W, 3), x.unsqueeze(-1)).squeeze(-1) + bias))


BETWEEN = [
    own("WIRE", wire, b=lambda: nn.Linear(W, W, dtype=torch.cfloat), o=lambda: nn.Linear(W, 3, dtype=torch.cfloat)),
    own(
        "polar",
        lambda s, x: s.o(torch.view_as_real(torch.polar(s.a(x), s.b(x))).flatten(1)),
        a=(3, 4),
        b=(3, 4),
        o=(8, 3),
    ),
    own("exponential of its own", clipped),
    own("nan_to_num", lambda s, x: s.o(torch.nan_to_num(s.net(x))), net=mlp(3, 8), o=(8, 4)),
    own(
        "bucketize",
        lambda s, x: s.o(F.relu(s.a(x)) * torch.bucketize(x[:, :1], s.e).float()),
        e=lambda: torch.linspace(-1, 1, 5),
    ),
    own("one_hot", lambda s, x, i: s.o(F.relu(s.a(torch.cat([x, F.one_hot(i, 9).to(x)], -1)))), 3, images, a=(12, W)),
    own(
        "triangle waves",
        lambda s, x: s.net(torch.abs(torch.remainder((x[..., None] * s.f).flatten(1), 2) - 1)),
        f=octaves(3),
        net=9,
    ),
    own("H-SIREN", lambda s, x: s.b(torch.sin(torch.sinh(s.a(x)))), b=(W, 4), second=True),
    own("Chebyshev of angles", by_angles, c=parameter(3, 4, 5), n=lambda: torch.arange(5).float()),
    own("hypernetwork", hyper, 3, 8, m=(8, 4 * W)),
    own("glu", lambda s, x: s.o(F.glu(s.a(x), -1)), a=(3, 2 * W)),
    own("lerp", lambda s, x: s.o(torch.lerp(s.a(x), s.b(x), 0.3)), b=(3, W)),
    own("power", lambda s, x: s.o(s.a(x).abs() ** s.e), e=lambda: torch.rand(W) + 1),
    Row("CELU", lambda: fields.Activated(nn.CELU(), 32), (3,)),
    Row("Hardswish", lambda: fields.Activated(nn.Hardswish(), 32), (3,)),
]

# signed distances -----------------------------------------------------------------------------------------------------


def finite(s: Any, x: Tensor) -> Tensor:
    steps = 1e-1 * torch.eye(3).to(x)
    return torch.cat([(s.net(x + e) - s.net(x - e)) / 0.2 for e in steps], -1)


def geometric(i: int, o: int) -> Callable[[], nn.Module]:
    return mlp(i, o, lambda: nn.Softplus(100))


DISTANCES = [
    Row("NeuS", fields.SignedDistance, (3,), second=True),
    Row("iSDF of width 96", lambda: fields.SignedDistance(96), (3,), second=True),
    Row("VolSDF", fields.WeightNormed, (3,)),
    own("softplus", lambda s, x: s.net(x), second=True, net=geometric(3, 5)),
    own(
        "sphere", lambda s, x: torch.minimum(s.net(x), 3 - x.norm(2, 1, keepdim=True)), second=True, net=geometric(3, 1)
    ),
    own("tanh", lambda s, x: torch.tanh(s.net(x)), second=True, net=mlp(3, 1, nn.Tanh)),
    own(
        "residual of a sphere",
        lambda s, x: s.net(x) + x.norm(dim=-1, keepdim=True) - 0.5,
        second=True,
        net=geometric(3, 1),
    ),
    own("clamped", lambda s, x: s.net(x).clamp(-0.1, 0.1), net=geometric(3, 1)),
    own("squared ReLU", lambda s, x: s.o(F.relu(s.a(x)) ** 2), second=True, o=(W, 1)),
    own(
        "density",
        lambda s, x: (1 / s.b.abs()) * (0.5 + 0.5 * s.net(x).sign() * torch.expm1(-s.net(x).abs() / s.b.abs())),
        net=geometric(3, 1),
        b=number(0.5),
    ),
    own("S-density", lambda s, x: torch.sigmoid(s.net(x) * torch.exp(s.v * 10)), net=geometric(3, 1), v=number(0.1)),
    own("finite differences", finite, net=geometric(3, 1)),
]


def slope(y: Tensor, x: Tensor) -> Tensor:
    """Returns the gradient of the sum of ``y`` with respect to ``x``, computed as in public code."""
    ones = torch.ones_like(y, requires_grad=False, device=y.device)
    return torch.autograd.grad(y, x, ones, create_graph=True, retain_graph=True, only_inputs=True)[0]


def inside(name: str, call: Callable[..., Any], **parts: Part) -> Row:
    """Returns the row of a field whose forward differentiates a network with respect to its inputs."""

    def forward(s: Any, x: Tensor) -> Any:
        with torch.enable_grad():
            x = x if x.requires_grad else x.detach().requires_grad_()
            return call(s, x)

    return own(name, forward, **{"net": geometric(3, 5), **parts})


def curvature(s: Any, x: Tensor) -> Tensor:
    first = slope(s.net(x)[:, :1], x)
    return torch.stack([slope(first[:, i : i + 1], x)[:, i] for i in range(3)]).sum(0)


def potential(s: Any, x: Tensor) -> Tensor:
    """Returns a divergence-free velocity: the curl of a potential."""
    a = s.net(x)[:, :3]
    jacobian = [slope(a[:, i : i + 1], x) for i in range(3)]
    return torch.stack([jacobian[2][:, 1] - jacobian[1][:, 2], jacobian[0][:, 2] - jacobian[2][:, 0]], -1)


GRADIENTS = [
    inside("slope", lambda s, x: slope(s.net(x)[:, :1], x)),
    inside("slope and value", lambda s, x: (s.net(x), slope(s.net(x)[:, :1], x))),
    inside("of a sum", lambda s, x: torch.autograd.grad(s.net(x)[:, 0].sum(), x, create_graph=True)[0]),
    inside("unit normals", lambda s, x: F.normalize(slope(s.net(x)[:, :1], x), dim=-1)),
    inside("negative normals", lambda s, x: -slope(s.net(x)[:, :1], x)[:, None]),
    inside(
        "colour of normals",
        lambda s, x: s.rgb(torch.cat([x, slope(s.net(x)[:, :1], x), s.net(x)[:, 1:]], -1)).sigmoid(),
        rgb=mlp(10, 3),
    ),
    inside(
        "detached normals", lambda s, x: s.rgb(torch.cat([x, slope(s.net(x)[:, :1], x).detach()], -1)), rgb=mlp(6, 3)
    ),
    inside("shaded", lambda s, x: s.net(x)[:, 1:4] * slope(s.net(x)[:, :1], x).sum(-1, keepdim=True).clamp(min=0)),
    inside("eikonal", lambda s, x: (slope(s.net(x)[:, :1], x).norm(dim=-1) - 1) ** 2),
    inside("Laplacian", curvature),
    inside("rotation", potential),
    inside("sine", lambda s, x: slope(s.net(x)[:, :1], x), net=lambda: fields.Siren(W, 5)),
]

# KANs -----------------------------------------------------------------------------------------------------------------


def chebyshev(s: Any, x: Tensor) -> Tensor:
    x = torch.tanh(x)
    t = [torch.ones_like(x), x]
    for _ in range(3):
        t.append(2 * x * t[-1] - t[-2])
    return torch.einsum("bid,iod->bo", torch.stack(t, -1), s.c)


def fourier(s: Any, x: Tensor) -> Tensor:
    angles = x.unsqueeze(-1) * s.n
    return torch.einsum("bik,oik->bo", angles.cos(), s.c) + torch.einsum("bik,oik->bo", angles.sin(), s.d)


def radial(s: Any, x: Tensor) -> Tensor:
    basis = torch.exp(-(((x[..., None] - s.g) / 0.5) ** 2))
    return s.o(basis.view(len(x), -1)) + s.base(F.silu(x))


def wavelet(s: Any, x: Tensor) -> Tensor:
    """Sums Mexican hat wavelets, one for each pair of input and output."""
    scaled = (x.unsqueeze(1) - s.shift) / s.scale.exp()
    return ((scaled**2 - 1) * torch.exp(-0.5 * scaled**2) * s.w).sum(2)


KANS = [
    Row("B-splines", lambda: fields.KAN(16), (3,)),
    own("Chebyshev", chebyshev, c=parameter(3, 4, 5)),
    Row("B-splines of width 8", lambda: fields.KAN(8), (3,)),
    own("Fourier", fourier, c=parameter(4, 3, 5), d=parameter(4, 3, 5), n=lambda: torch.arange(5).float()),
    own("radial", radial, g=lambda: torch.linspace(-2, 2, 8), o=(24, 4), base=(3, 4)),
    own("wavelets", wavelet, shift=parameter(4, 3), scale=parameter(4, 3), w=parameter(4, 3)),
    own(
        "Taylor",
        lambda s, x: torch.einsum("bid,oid->bo", torch.stack([x**i for i in range(4)], -1), s.c),
        c=parameter(4, 3, 4),
    ),
    own(
        "Legendre",
        lambda s, x: torch.einsum("bid,iod->bo", torch.stack([x, 1.5 * x * x - 0.5], -1), s.c),
        c=parameter(3, 4, 2),
    ),
    own("sum of products", lambda s, x: (torch.stack([x, x**2], -1)[:, None] * s.c).sum((2, 3)), c=parameter(4, 3, 2)),
    own("flattened", lambda s, x: torch.stack([x, x**3], -1).flatten(1) @ s.c.flatten(1).T, c=parameter(4, 3, 2)),
    own("two layers", lambda s, x: s.b(F.silu(s.a(torch.cat([x, x**2, x**3], -1)))), a=(9, W), b=(W, 4)),
    own(
        "piecewise linear",
        lambda s, x: torch.einsum("big,iog->bo", F.relu(1 - (x[..., None] - s.g).abs() * 2), s.c),
        c=parameter(3, 4, 5),
        g=lambda: torch.linspace(-1, 1, 5),
    ),
]

# tables ---------------------------------------------------------------------------------------------------------------


def voxels(s: Any, x: Tensor) -> Tensor:
    found = F.grid_sample(s.grid, x.view(1, -1, 1, 1, 3), align_corners=True, padding_mode="border")
    return s.net(found.view(4, -1).T)


def triplane(s: Any, x: Tensor) -> Tensor:
    pairs = torch.stack([x[:, [0, 1]], x[:, [0, 2]], x[:, [1, 2]]])[:, :, None]
    return s.net(F.grid_sample(s.planes, pairs, align_corners=False).squeeze(-1).sum(0).T)


def small_grid() -> nn.Module:
    return GridEncoder(num_levels=3, base_resolution=4)


TABLES = [
    Row("nerfacto", lambda: fields.HashTable(1 << 8, 4), (3,)),
    Row("HashNeRF", lambda: fields.HashEmbedder(1 << 8, 4), (3,)),
    Row("torch-ngp", lambda: fields.NeRFNetwork(1 << 8, 4), (3, 3)),
    Row("TensoRF", lambda: fields.TensorField(8), (3,)),
    Row("K-Planes", lambda: fields.KPlanes((4, 8)), (3,)),
    Row("NeRF-W", fields.AppearanceNeRF, (90, images)),
    Row("shared planes", lambda: fields.KPlanes((4, 8)), (3,), options={"share": ["grids.*"]}),
    own("grid", lambda s, x: s.net(s.grid(x)), grid=small_grid, net=6),
    own("voxels", voxels, grid=parameter(1, 4, 5, 5, 5), net=4),
    own("triplane", triplane, planes=parameter(3, 4, 6, 6), net=4),
    own(
        "row by index",
        lambda s, x: s.net(torch.cat([x, s.table[(x[:, 0] > 0).long()]], -1)),
        table=parameter(2, 4),
        net=7,
    ),
    own(
        "embedding",
        lambda s, x, i: s.net(torch.cat([x, F.embedding(i, s.code)], -1)),
        3,
        images,
        code=parameter(9, 4),
        net=7,
    ),
]

# norms ----------------------------------------------------------------------------------------------------------------


def normed(norm: Callable[[nn.Module], nn.Module]) -> dict[str, Part]:
    return {"a": lambda: norm(nn.Linear(3, W)), "b": lambda: norm(nn.Linear(W, W))}


def behind(s: Any, x: Tensor) -> Tensor:
    return s.o(F.relu(s.b(F.relu(s.a(x)))))


def between(name: str, call: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(F.silu(call(s, s.a(x)))), **parts)


NORMS = [
    own("weight_norm by hooks", behind, **normed(nn.utils.weight_norm)),
    own("weight_norm", behind, **normed(nn.utils.parametrizations.weight_norm)),
    own(
        "of g and v",
        lambda s, x: s.o(F.relu(F.linear(x, s.g * s.v / s.v.norm(dim=1, keepdim=True)))),
        g=parameter(W, 1),
        v=parameter(W, 3),
    ),
    Row("ResBlocks", fields.Normed, (3,)),
    between("LayerNorm", lambda s, h: s.n(h), n=lambda: nn.LayerNorm(W)),
    between("LayerNorm, bare", lambda s, h: s.n(h), n=lambda: nn.LayerNorm(W, elementwise_affine=False)),
    between("layer_norm", lambda s, h: F.layer_norm(h, (W,)) * s.g + s.b, g=parameter(W), b=parameter(W)),
    between("RMSNorm", lambda s, h: s.n(h), n=lambda: nn.RMSNorm(W)),
    between(
        "root of mean squares",
        lambda s, h: h * torch.rsqrt(h.pow(2).mean(-1, keepdim=True) + 1e-5) * s.g,
        g=parameter(W),
    ),
    between("normalize", lambda s, h: F.normalize(h, dim=-1)),
    between(
        "standardised",
        lambda s, h: (h - h.mean(-1, keepdim=True)) / (h.var(-1, keepdim=True, unbiased=False) + 1e-5).sqrt(),
    ),
    between("softmax", lambda s, h: F.softmax(h, -1) * h),
]

# residual blocks ------------------------------------------------------------------------------------------------------


def residual(name: str, call: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(call(s, s.stem(x))), **{"stem": (3, W), "a": (W, W), **parts})


def added(s: Any, h: Tensor) -> Tensor:
    identity = h
    out = s.b(F.relu(s.a(h)))
    out += identity
    return F.relu(out)


RESIDUAL = [
    residual("before", lambda s, h: h + s.b(F.relu(s.a(F.relu(h))))),
    residual("behind", lambda s, h: F.relu(h + s.b(F.relu(s.a(h))))),
    residual("in place", added),
    residual("with a shortcut", lambda s, h: s.c(h) + s.b(F.elu(s.a(h))), c=lambda: nn.Linear(W, W, bias=False)),
    residual("scaled", lambda s, h: h + 0.1 * s.b(F.gelu(s.a(h)))),
    residual("learned scale", lambda s, h: h + s.g * s.b(F.gelu(s.a(h))), g=parameter(W)),
    residual("adaptive", lambda s, h: s.t * s.b(F.tanh(s.a(h))) + (1 - s.t) * h, t=number(0.4)),
    residual("highway", lambda s, h: torch.sigmoid(s.a(h)) * s.b(h) + (1 - torch.sigmoid(s.a(h))) * h),
    residual("gated", lambda s, h: h + s.a(h) * torch.sigmoid(s.b(h))),
    residual("dense", lambda s, h: s.c(torch.cat([h, s.a(h).relu(), s.b(h).relu()], -1)), c=(3 * W, W)),
    residual("twice the same", lambda s, h: h + s.a(F.relu(s.a(F.relu(h)))) + s.b(h)),
    residual("gates of two encoders", lambda s, h: s.a(h) * torch.tanh(h) + (1 - torch.tanh(h)) * s.b(h)),
]

# conditions -----------------------------------------------------------------------------------------------------------


def modulated(s: Any, x: Tensor, z: Tensor) -> Tensor:
    gamma, beta = s.m(z).chunk(2, -1)
    return s.o(torch.sin(gamma * s.a(x) + beta))


def of_own_code(s: Any, x: Tensor) -> Tensor:
    weight = s.m(s.z).view(W, 3)
    return s.o(torch.relu(x @ weight.T))


def low_rank(s: Any, x: Tensor) -> Tensor:
    return s.o(F.relu(F.linear(x, s.w + s.u @ s.v)))


CONDITIONS = [
    own("code beside the position", lambda s, x, z: s.net(torch.cat([x, z], -1)), 3, 8, net=11),
    own("code of the module", lambda s, x: s.net(torch.cat([x, s.z.expand(len(x), -1)], -1)), z=parameter(1, 5), net=8),
    own(
        "repeated code", lambda s, x: s.net(torch.cat([x, s.z[None].repeat(x.shape[0], 1)], -1)), z=parameter(5), net=8
    ),
    own("FiLM", modulated, 3, 8, m=mlp(8, 2 * W)),
    own("added code", lambda s, x, z: s.o(F.relu(s.a(x) + s.b(z))), 3, 8, b=(8, W)),
    own("SPADE", lambda s, x, z: s.o(F.relu(s.b(z) * s.a(x) + s.c(z))), 3, 8, b=(8, W), c=(8, W)),
    own("gate", lambda s, x, z: s.o(torch.sigmoid(s.b(z)) * s.a(x)), 3, 8, b=(8, W)),
    own("hypernetwork of its own code", of_own_code, z=parameter(5), m=(5, 3 * W)),
    own("low rank", low_rank, w=parameter(W, 3), u=parameter(W, 2), v=parameter(2, 3)),
    own("bilinear", lambda s, x, z: torch.einsum("ni,oij,nj->no", x, s.w, z), 3, 4, w=parameter(4, 3, 4)),
    own(
        "time",
        lambda s, x, t: s.o(F.relu(s.a(torch.cat([x, t.expand(len(x), 1)], -1)))),
        3,
        lambda _: torch.tensor([[0.3]]),
        a=(4, W),
    ),
    own(
        "attention to codes",
        lambda s, x: F.softmax(s.q(x) @ s.k.T / 3, -1) @ s.v,
        q=(3, 6),
        k=parameter(5, 6),
        v=parameter(5, 4),
    ),
]

# raw weights ----------------------------------------------------------------------------------------------------------


def raw(name: str, call: Callable[..., Tensor]) -> Row:
    return own(name, lambda s, x: s.o(F.relu(call(s, x))), w=parameter(3, W), b=parameter(W))


WEIGHTS = [
    Row("weights of its own", fields.RawWeights, (3,)),
    raw("matmul", lambda s, x: x @ s.w + s.b),
    raw("linear", lambda s, x: F.linear(x, s.w.t(), s.b)),
    raw("addmm", lambda s, x: torch.addmm(s.b, x, s.w)),
    raw("einsum", lambda s, x: torch.einsum("...i,io->...o", x, s.w) + s.b),
    raw("mm", lambda s, x: torch.mm(x, s.w).add(s.b)),
    raw("sum of products", lambda s, x: (x[:, :, None] * s.w).sum(1) + s.b),
    raw("matmul of a row", lambda s, x: torch.matmul(x[:, None], s.w)[:, 0] + s.b),
    raw("positive weights", lambda s, x: x @ F.softplus(s.w) + s.b),
    raw("tied", lambda s, x: (x @ s.w) @ s.w.T @ s.w + s.b),
    raw("inner and T", lambda s, x: torch.inner(x, s.w.T) + s.b),
    raw("tensordot", lambda s, x: torch.tensordot(x, s.w, dims=1) + s.b),
]

# convolutions with kernel size 1 --------------------------------------------------------------------------------------


def conv(i: int, o: int, kind: Callable[..., nn.Module] = nn.Conv1d, **options: Any) -> Callable[[], nn.Module]:
    return lambda: kind(i, o, 1, **options)


CONVOLUTIONS = [
    own("Conv1d", lambda s, x: s.b(F.relu(s.a(x[..., None]))).squeeze(-1), a=conv(3, W), b=conv(W, 4)),
    own("Conv1d, no bias", lambda s, x: s.o(F.relu(s.a(x.unsqueeze(2))[:, :, 0])), a=conv(3, W, bias=False)),
    own(
        "Conv2d",
        lambda s, x: s.b(F.relu(s.a(x[..., None, None]))).flatten(1),
        a=conv(3, W, nn.Conv2d),
        b=conv(W, 4, nn.Conv2d),
    ),
    own("Conv3d", lambda s, x: s.a(x.view(-1, 3, 1, 1, 1)).view(-1, 4), a=conv(3, 4, nn.Conv3d)),
    own("conv1d", lambda s, x: F.conv1d(x[..., None], s.w, s.b)[..., 0], w=parameter(4, 3, 1), b=parameter(4)),
    own("conv2d", lambda s, x: F.conv2d(x[..., None, None], s.w)[..., 0, 0], w=parameter(4, 3, 1, 1)),
    own("two in a row", lambda s, x: s.b(s.a(x[..., None])).squeeze(-1), a=conv(3, 8), b=conv(8, 4)),
    own("SIREN by Conv1d", lambda s, x: s.b(torch.sin(9 * s.a(x[..., None])))[..., 0], a=conv(3, W), b=conv(W, 4)),
    own(
        "with a skip",
        lambda s, x: s.b(torch.cat([x[..., None], F.relu(s.a(x[..., None]))], 1)).squeeze(2),
        a=conv(3, W),
        b=conv(W + 3, 4),
    ),
    own(
        "sequential",
        lambda s, x: s.net(x[:, :, None]).flatten(1),
        net=lambda: nn.Sequential(nn.Conv1d(3, W, 1), nn.ReLU(), nn.Conv1d(W, 4, 1)),
    ),
    own(
        "weight_norm",
        lambda s, x: s.a(x[..., None]).squeeze(-1),
        a=lambda: nn.utils.parametrizations.weight_norm(nn.Conv1d(3, 4, 1)),
    ),
    own("layer behind", lambda s, x: s.o(F.leaky_relu(s.a(x[..., None]), 0.2).mean(-1)), a=conv(3, W)),
]

# methods --------------------------------------------------------------------------------------------------------------


class Methods(nn.Module):
    """A field with many methods that a renderer calls."""

    def __init__(self) -> None:
        super().__init__()
        self.net, self.rgb = mlp(3, 8)(), mlp(7 + 3, 3)()

    def forward(self, x: Tensor, d: Tensor | None = None) -> Any:
        return {**self.density(x), "rgb": self.color(x, d, self.net(x)[..., 1:])}

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"sigma": F.softplus(h[..., 0]), "geo_feat": h[..., 1:]}

    def color(self, x: Tensor, d: Tensor, geo_feat: Tensor) -> Tensor:
        return torch.sigmoid(self.rgb(torch.cat([d, geo_feat], dim=-1)))

    def query_density(self, x: Tensor) -> Tensor:
        return self.density(x)["sigma"][..., None]

    def query_opacity(self, x: Tensor, step_size: float = 0.01) -> Tensor:
        return self.query_density(x) * step_size

    def get_density(self, x: Tensor) -> tuple[Tensor, Tensor]:
        sigma, features = torch.split(self.net(x), [1, 7], dim=-1)
        return F.relu(sigma), features

    def sdf(self, x: Tensor) -> Tensor:
        return self.net(x)[:, :1]

    def occupancy(self, x: Tensor) -> Tensor:
        return torch.sigmoid(-10 * self.sdf(x))

    def features(self, x: Tensor, *, scale: float = 2.0, normalise: bool = True) -> Tensor:
        h = self.net(x)[..., 1:] * scale
        return F.normalize(h, dim=-1) if normalise else h

    def alpha(self, x: Tensor, distance: Tensor) -> Tensor:
        return 1 - torch.exp(-self.query_density(x) * distance)

    def warp(self, x: Tensor, t: Tensor) -> Tensor:
        return x + t * torch.tanh(self.net(x)[..., :3])

    def both(self, x: Tensor, d: Tensor) -> list[Tensor]:
        return [self(x, d)["rgb"], self(x, -d)["rgb"]]


ASKED = {"forward": 2, "density": 1, "query_density": 1, "query_opacity": 1, "get_density": 1, "sdf": 1}
ASKED |= {"occupancy": 1, "features": 1, "both": 2}
METHODS = [Row(name, Methods, (3,) * count, method=name) for name, count in ASKED.items()]
METHODS += [Row("color", Methods, (3, 3, 7), method="color"), Row("alpha", Methods, (3, 1), method="alpha")]
METHODS += [Row("warp", Methods, (3, 1), method="warp")]

# samples on other axes, and networks of constants --------------------------------------------------------------------


def tokens(name: str, call: Callable[..., Any], *shape: int, **parts: Part) -> Row:
    """Returns the row of a module whose samples have axes of their own, [n, *shape]."""
    return replace(own(name, call, lambda lead: uniform(lead, *shape), **parts), coords=inner)


def heads_in_front(s: Any, x: Tensor) -> Tensor:
    q, k, v = (torch.stack(torch.split(torch.tensordot(x, w, dims=([-1], [0])), 4, dim=2)) for w in (s.q, s.k, s.v))
    result = torch.matmul(F.softmax(torch.einsum("bnik,bnjk->bnij", q, k), dim=-1), v)
    return F.relu(torch.squeeze(torch.cat(torch.split(result, 1), dim=-1), dim=0))


def heads_in_the_batch(s: Any, x: Tensor) -> Tensor:
    q, k, v = (torch.cat(layer(x).split(W // 4, 2), 0) for layer in (s.a, s.k, s.v))
    attention = torch.softmax(q.bmm(k.transpose(1, 2)) / math.sqrt(W), 2)
    return s.o(torch.cat((q + attention.bmm(v)).split(x.size(0), 0), 2))


def causal(s: Any, x: Tensor) -> Tensor:
    n, t, c = x.size()
    q, k, v = (part.view(n, t, 2, c // 2).transpose(1, 2) for part in s.qkv(x).split(c, dim=2))
    y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
    return x + s.out(y.transpose(1, 2).contiguous().view(n, t, c))


def widths(s: Any, x: Tensor) -> Tensor:
    """Computes a hidden layer of one unit for each of W networks, which are the first axis."""
    h = torch.tanh(torch.matmul(x.unsqueeze(0).repeat(W, 1, 1), s.w) + s.c)
    return torch.matmul(h, s.u).mean(0)


def of_the_time(s: Any, x: Tensor, t: Tensor) -> Tensor:
    weight, bias = s.m(t.view(1, 1)).view(-1).split([3 * W, W])
    return s.o(torch.tanh(F.linear(x, weight.view(W, 3), bias)))


def at_noon(_: tuple[int, ...]) -> Tensor:
    return torch.tensor(0.5)


SQUARE: dict[str, Part] = {name: parameter(8, 8) for name in "qkv"}
AXES = [
    tokens("heads in front", heads_in_front, 5, 8, **SQUARE),
    tokens("heads in the batch", heads_in_the_batch, 5, 3, k=(3, W), v=(3, W)),
    tokens("causal attention", causal, 6, 16, qkv=(16, 48), out=(16, 16)),
    tokens("tensordot", lambda s, x: torch.tanh(torch.tensordot(x, s.w, dims=([-1], [0]))), 5, 3, w=parameter(3, W)),
    own("turned between", lambda s, x: s.b(torch.cosh(s.a(x).t()).t()), a=(3, 64), b=(64, 2)),
    own("weights in front", lambda s, x: s.o(torch.relu(s.w @ x.t()).t()), w=parameter(W, 3)),
    own("weights before columns", lambda s, x: s.o(torch.matmul(s.w, x[..., None]).squeeze(-1)), w=parameter(W, 3)),
    own("weights of heads", lambda s, x: s.o(torch.relu(x @ s.w).mean(0)), w=parameter(6, 3, W)),
    own("networks in front", widths, w=parameter(W, 3, 1), c=parameter(W, 1, 1), u=parameter(W, 1, 2)),
    own(
        "trunk of sensors",
        lambda s, x: s.branch(x) @ s.trunk(s.sensors).t() + s.c,
        branch=(3, W),
        trunk=(2, W),
        sensors=buffer(20, 2),
        c=number(0.1),
    ),
    own("gate of a constant", lambda s, x: s.a(x) * torch.sigmoid(s.g(torch.ones(1, 1))), g=(1, W)),
    own("layer of the time", of_the_time, 3, at_noon, m=mlp(1, 4 * W, nn.Tanh)),
    own("layer of a constant", lambda s, x: s.o(torch.relu(x @ s.m(torch.eye(3)))), m=(3, W)),
    own("masked weights", lambda s, x: s.o(F.linear(x, s.w * s.mask)), w=parameter(W, 3), mask=buffer(W, 3)),
]

# layers ---------------------------------------------------------------------------------------------------------------


def evaluating(row: Row) -> Row:
    return replace(row, make=lambda: evaluated(row.make()))


def stepped(s: Any, x: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    h, c = s.cell(x, (h, c))
    return s.o(h), c


def with_states(s: Any, x: Tensor) -> Tensor:
    zeros = torch.zeros(2, x.size(0), W)
    return s.o(s.r(x, (zeros, zeros))[0][:, -1, :])


def attended(s: Any, x: Tensor) -> Tensor:
    h = s.a(x)
    return s.o(h + s.m(h, h, h)[0])


LAYERS = [
    evaluating(between("BatchNorm in eval", lambda s, h: s.n(h), n=lambda: nn.BatchNorm1d(W))),
    evaluating(
        tokens(
            "BatchNorm2d in eval",
            lambda s, x: s.n(s.c(x)),
            3,
            5,
            5,
            c=conv(3, 4, nn.Conv2d),
            n=lambda: nn.BatchNorm2d(4),
        )
    ),
    evaluating(between("Dropout in eval", lambda s, h: s.n(h), n=lambda: nn.Dropout(0.5))),
    between("PReLU", lambda s, h: s.n(h), n=nn.PReLU),
    between("PReLU of channels", lambda s, h: s.n(h), n=lambda: nn.PReLU(W)),
    between("GroupNorm", lambda s, h: s.n(h), n=lambda: nn.GroupNorm(4, W)),
    own("Bilinear", lambda s, x, z: s.o(F.relu(s.n(x, z))), 3, 4, n=lambda: nn.Bilinear(3, 4, W)),
    own("bilinear", lambda s, x, z: s.o(F.bilinear(x, z, s.w)), 3, 4, w=parameter(W, 3, 4)),
    tokens("GRU", lambda s, x: s.o(s.r(x)[0][:, -1]), 5, 3, r=lambda: nn.GRU(3, W, batch_first=True)),
    tokens("LSTM", lambda s, x: s.o(s.r(x)[0]), 5, 3, r=lambda: nn.LSTM(3, W, batch_first=True)),
    tokens("LSTM with states", with_states, 5, 3, r=lambda: nn.LSTM(3, W, 2, batch_first=True)),
    own("GRUCell", lambda s, x, h: s.o(s.cell(x, h)), 3, W, cell=lambda: nn.GRUCell(3, W)),
    own("LSTMCell", stepped, 3, W, W, cell=lambda: nn.LSTMCell(3, W)),
    tokens("MultiheadAttention", attended, 5, 3, m=lambda: nn.MultiheadAttention(W, 4, batch_first=True)),
]

# state ----------------------------------------------------------------------------------------------------------------


class Hidden(nn.Module):
    """A module whose layers are in a list, a dict or an object; their parameters are in a ParameterList."""

    def __init__(self, keep: Callable[[nn.Module, nn.Module], Any], call: Callable[..., Tensor]) -> None:
        super().__init__()
        layers = nn.Linear(3, W), nn.Linear(W, 4)
        self.kept, self.call = keep(*layers), call
        self.weights = nn.ParameterList(parameter for layer in layers for parameter in layer.parameters())

    def forward(self, x: Tensor) -> Tensor:
        return self.call(self.kept, x)


def hidden(name: str, keep: Callable[[nn.Module, nn.Module], Any], call: Callable[..., Tensor]) -> Row:
    return Row(name, lambda: Hidden(keep, call), (3,))


def keeps(s: Any, x: Tensor) -> Tensor:
    s.outputs["h"] = F.relu(s.a(x))
    s.outputs["q"] = s.o(s.outputs["h"])
    return s.outputs["q"]


def kept(s: Any, x: Tensor) -> Tensor:
    s.h, s.parts = F.relu(s.a(x)), [x]
    s.parts.append(s.o(s.h))
    return s.parts[-1]


def annealed(s: Any, x: Tensor) -> Tensor:
    s.step += 1  # the schedule is over
    return s.o(F.relu(s.a(x))) * min(s.step / 50, 1.0)


def numbered(s: Any, x: Tensor) -> Tensor:
    if s.rows is None or len(s.rows) != len(x):
        s.rows = torch.arange(len(x))
    return s.o(F.relu(s.a(x[s.rows])))


def frozen(s: Any, x: Tensor) -> Tensor:
    with torch.no_grad():
        h = F.relu(s.a(x))
    return s.o(F.relu(s.b(h)))


STATE = [
    hidden("layers in a list", lambda a, b: [a, b], lambda kept, x: kept[1](F.relu(kept[0](x)))),
    hidden("layers in a dict", lambda a, b: {"a": a, "b": b}, lambda kept, x: kept["b"](F.relu(kept["a"](x)))),
    hidden("layers in an object", lambda a, b: SimpleNamespace(a=a, b=b), lambda kept, x: kept.b(F.relu(kept.a(x)))),
    own("results in a dict", keeps, outputs=dict),
    own("results as attributes", kept),
    own("counted steps", annealed, step=lambda: 100),
    own("counted steps, buffer", annealed, step=lambda: torch.tensor(100.0)),
    own("cache by the number of samples", numbered, rows=lambda: None),
    own("frozen encoder", frozen),
    own("detached encoder", lambda s, x: s.o(F.relu(s.b(F.relu(s.a(x)).detach())))),
    own("unused head", lambda s, x: (s.o(F.relu(s.a(x))), s.c(x).detach()), c=(3, 2)),
    own("tensor in a list", lambda s, x: s.net(x * s.scale[0]), scale=lambda: [torch.tensor([1.0, 2.0, 3.0])]),
]

KINDS = {
    "plain": PLAIN,
    "encodings": ENCODINGS,
    "outputs": OUTPUTS,
    "activations": ACTIVATIONS,
    "periodic": PERIODIC,
    "distances": DISTANCES,
    "kans": KANS,
    "norms": NORMS,
    "residual": RESIDUAL,
    "conditions": CONDITIONS,
    "weights": WEIGHTS,
    "convolutions": CONVOLUTIONS,
    "methods": METHODS,
    "gradients": GRADIENTS,
    "tables": TABLES,
    "between": BETWEEN,
    "axes": AXES,
    "layers": LAYERS,
    "state": STATE,
}
IN_RUNS = ("gradients", "tables", "between")
"""The kinds whose modules are only partly fused: PyTorch computes functions between the fused parts."""
IN_ANY_WAY = ("axes", "layers", "state")
"""The kinds whose modules run in any way. The modules of the kinds in neither list are fused completely."""
