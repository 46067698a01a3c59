"""Small modules by kind; each shows a coding habit of some public repository, or one use of parameters.

Tests of every run compare the rows with ``ways``; long tests compare all rows.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ops import foreign_fields as fields
from ops.foreign_imports import SHEncoder
from ops.foreign_rows import Row, evaluated, inner, numbers, of, per_ray, uniform
from voronerf import NeRF
from voronerf.router import register

W = 24  # width
images = numbers(9)
RAYS = (29, 7)  # rays and samples of a ray: different from all numbers of features
BOTH, GROUPED, BY_CELL = ("fused", "grouped"), ("grouped",), ("cell by cell",)
Part = int | tuple[int, int] | Callable[[], Any]
KINDS: dict[str, list[Row]] = {}
"""The rows of each kind, by its name."""


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


def own(
    name: str,
    call: Callable[..., Any],
    *inputs: Any,
    second: bool = False,
    ways: tuple[str, ...] = (),
    share: tuple[str, ...] = (),
    keywords: dict[str, Any] | None = None,
    **parts: Part,
) -> Row:
    """Returns the row of a :class:`Module`.

    Layers a, b and o and a network `net` always exist, used or unused, as in public code.

    Args:
        name: The name of the row.
        call: The forward: a function of the module and the arguments.
        inputs: The arguments, see :class:`Row`. Default: positions.
        second: Whether second derivatives are compared, too.
        ways: The ways that tests of every run compare.
        share: Patterns of the names of parameters that all cells share.
        keywords: The keyword arguments.
        parts: The module's attributes by name. A pair (inputs, outputs) makes a linear layer, and a single number of
            inputs makes a network with four outputs. A function makes any other part.
    """

    def build(part: Part) -> Any:
        return nn.Linear(*part) if isinstance(part, tuple) else mlp(part, 4)() if isinstance(part, int) else part()

    def make() -> nn.Module:
        return Module(call, {name: build(part) for name, part in {**PARTS, **parts}.items()})

    options = {"share": share} if share else {}
    return Row(name, make, inputs or (3,), keywords=keywords or {}, options=options, second=second, ways=ways)


def parameter(*shape: int, scale: float = 0.3) -> Callable[[], nn.Parameter]:
    return lambda: nn.Parameter(scale * torch.randn(*shape))


def always(*rows: Row, ways: tuple[str, ...] = BOTH) -> list[Row]:
    """Returns rows that tests of every run compare."""
    return [replace(row, ways=ways) for row in rows]


def buffer(*shape: int, scale: float = 2.0) -> Callable[[], Tensor]:
    return lambda: scale * torch.randn(*shape)


def number(value: float) -> Callable[[], nn.Parameter]:
    return lambda: nn.Parameter(torch.tensor(value))


def octaves(count: int) -> Callable[[], Tensor]:
    return lambda: 2.0 ** torch.arange(count)


def layers(*sizes: int) -> Callable[[], nn.ModuleList]:
    return lambda: nn.ModuleList(nn.Linear(i, o) for i, o in itertools.pairwise(sizes))


# plain ----------------------------------------------------------------------------------------------------------------


def skipping(s: Any, x: Tensor, d: Tensor) -> Tensor:
    h = x
    for i, layer in enumerate(s.trunk):
        h = F.relu(layer(torch.cat([h, x], -1) if i == 2 else h))
    return torch.cat([s.rgb(F.relu(s.view(torch.cat([h, d], -1)))).sigmoid(), F.softplus(s.sigma(h))], -1)


def trunk() -> nn.ModuleList:
    return nn.ModuleList([nn.Linear(3, W), nn.Linear(W, W), nn.Linear(W + 3, W)])


def by_name(s: Any, x: Tensor) -> Tensor:
    for i in range(3):
        x = getattr(s, f"lin{i}")(x)
        x = s.act(x) if i < 2 else x
    return x


KINDS["plain"] = [
    own("skip and view", skipping, 3, 3, trunk=trunk, view=(W + 3, W), rgb=(W, 3), sigma=(W, 1), ways=BOTH),
    own("layers by name", by_name, lin0=(3, W), lin1=(W, W), lin2=(W, 4), act=nn.ReLU, ways=BOTH),
    own("sequential", lambda s, x: s.net(x), net=mlp(3, 4, lambda: nn.ReLU(inplace=True))),
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


def contracted(s: Any, x: Tensor) -> Tensor:
    x = 2 * x
    size = x.norm(dim=-1, keepdim=True).clamp_min(1e-3)
    return s.net(torch.where(size <= 1, x, (2 - 1 / size) * (x / size)))


def products(s: Any, x: Tensor) -> Tensor:
    projected = torch.einsum("ij,k->ijk", x, s.f)
    return s.net(torch.cat([projected.sin(), projected.cos()], 1).transpose(2, 1).contiguous().view(len(x), -1))


KINDS["encodings"] = [
    own("einsum", products, f=octaves(4), net=24, ways=BOTH),
    own("Gaussian", lambda s, x: s.net(torch.cat([(x @ s.b).sin(), (x @ s.b).cos()], -1)), b=buffer(3, 16), net=32),
    own("learned", lambda s, x: s.net((x[:, None] * s.f[:, None]).flatten(1).sin()), f=parameter(5), net=15),
    own("harmonics, written", harmonics, net=9, ways=BOTH),
    own("harmonics, stacked", lambda s, d: s.net(s.e(d)), e=SHEncoder, net=16),
    own("contraction", contracted),
    own("octaves by power", lambda s, x: s.net(torch.cat([torch.sin(2.0**i * x) for i in range(4)], -1)), net=12),
]

# outputs --------------------------------------------------------------------------------------------------------------

Field = namedtuple("Field", ["rgb", "sigma"])


def spelled(name: str, call: Callable[[Tensor], Any], **more: Any) -> Row:
    """Returns the row of a module that applies ``call`` to the four outputs of its network."""
    return own(name, lambda s, x: call(s.net(x)), **more)


KINDS["outputs"] = [
    spelled("tuple of split", lambda h: torch.split(h, [3, 1], -1)),
    spelled("piece of split", lambda h: torch.split(h, 2, -1)[1]),
    spelled("chunk", lambda h: h.chunk(2, dim=-1)),
    spelled("list of unbind", lambda h: list(h.unbind(-1))),
    spelled("piece of unbind", lambda h: torch.unbind(h, dim=1)[0]),
    spelled("tensor_split", lambda h: h.tensor_split((1, 3), dim=-1)),
    spelled("split and a function of it", lambda h: (h.split([3, 1], -1)[0].sigmoid(), h.split([3, 1], -1)[1])),
    spelled("named tuple", lambda h: Field(torch.sigmoid(h[..., :3]), h[..., 3].relu())),
    spelled("nested", lambda h: {"a": {"rgb": h[:, :3]}, "b": [h[:, 3:], None], "name": "field"}, ways=BOTH),
    spelled("squeezed", lambda h: (h[..., :3], h[..., 3:].squeeze(-1)), ways=BOTH),
    spelled("the same twice", lambda h: (h, h)),
]

# activations ----------------------------------------------------------------------------------------------------------

NAMES = "ReLU SiLU GELU ELU SELU Mish Tanh Sigmoid Softplus Softsign Hardtanh ReLU6 LogSigmoid Tanhshrink"
GIVEN = [nn.GELU("tanh"), nn.Softplus(100), nn.LeakyReLU(0.2), nn.Softmax(-1)]
KINDS["activations"] = [
    Row(str(kind), lambda kind=kind: fields.Activated(kind, 32), ways=BOTH if kind is GIVEN[1] else ())
    for kind in (*(getattr(nn, name)() for name in NAMES.split()), *GIVEN)
]

# periodic -------------------------------------------------------------------------------------------------------------


def periodic(name: str, wave: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(wave(s, s.b(wave(s, s.a(x))))), second=True, **parts)


KINDS["periodic"] = [
    Row("SIREN", fields.Siren, (3,), second=True),
    Row("FiLM", fields.FiLM, (3,)),
    Row("BACON", fields.Bacon, (3,)),
    periodic("learned sine", lambda s, h: torch.sin(s.w * h), w=number(3.0), ways=BOTH),
    periodic("FINER", lambda s, h: torch.sin(3 * (h.abs() + 1) * h)),
    periodic("sinc", lambda s, h: torch.sin(4 * h) / (4 * h + 9)),
]

# functions that the router cannot fuse --------------------------------------------------------------------------------


class Clipped(torch.autograd.Function):
    """The exponential of torch-ngp, with its autocast decorators and a clipped gradient."""

    @staticmethod
    @torch.amp.custom_fwd(device_type="cpu", cast_inputs=torch.float32)
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    @torch.amp.custom_bwd(device_type="cpu")
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * torch.exp(ctx.saved_tensors[0].clamp(max=-1))


def wire(s: Any, x: Tensor) -> Tensor:
    h = s.a(x)
    h = s.b(torch.exp(2j * h - h.abs().square()))
    return s.o(torch.exp(1j * h - h.abs().square())).real


def clipped(s: Any, x: Tensor) -> dict[str, Tensor]:
    h = s.net(x)
    return {"sigma": Clipped.apply(h[..., 0]), "rgb": torch.sigmoid(h[..., 1:])}


TRUNCATED = own("exponential of its own", clipped, ways=BOTH)
KINDS["between"] = [
    own("WIRE", wire, b=lambda: nn.Linear(W, W, dtype=torch.cfloat), o=lambda: nn.Linear(W, 3, dtype=torch.cfloat)),
    TRUNCATED,
    own("nan_to_num", lambda s, x: s.o(torch.nan_to_num(s.net(x))), net=mlp(3, 8), o=(8, 4)),
    own("one_hot", lambda s, x, i: s.o(F.relu(s.a(torch.cat([x, F.one_hot(i, 9).to(x)], -1)))), 3, images, a=(12, W)),
    own("H-SIREN", lambda s, x: s.b(torch.sin(torch.sinh(s.a(x)))), b=(W, 4), second=True),
    own("glu", lambda s, x: s.o(F.glu(s.a(x), -1)), a=(3, 2 * W)),
    own("lerp", lambda s, x: s.o(torch.lerp(s.a(x), s.b(x), 0.3)), b=(3, W)),
    Row("CELU", lambda: fields.Activated(nn.CELU(), 32), (3,)),
    Row("Hardswish", lambda: fields.Activated(nn.Hardswish(), 32), (3,)),
]

# signed distances -----------------------------------------------------------------------------------------------------


def geometric(i: int, o: int) -> Callable[[], nn.Module]:
    return mlp(i, o, lambda: nn.Softplus(100))


KINDS["distances"] = [
    Row("NeuS", fields.SignedDistance, (3,), second=True),
    own("softplus", lambda s, x: s.net(x), second=True, net=geometric(3, 5), ways=BOTH),
    own(
        "sphere", lambda s, x: torch.minimum(s.net(x), 3 - x.norm(2, 1, keepdim=True)), second=True, net=geometric(3, 1)
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


KINDS["gradients"] = [
    inside("slope", lambda s, x: slope(s.net(x)[:, :1], x)),
    inside("slope and value", lambda s, x: (s.net(x), slope(s.net(x)[:, :1], x))),
    inside("of a sum", lambda s, x: torch.autograd.grad(s.net(x)[:, 0].sum(), x, create_graph=True)[0]),
    inside(
        "colour of normals",
        lambda s, x: s.rgb(torch.cat([x, slope(s.net(x)[:, :1], x), s.net(x)[:, 1:]], -1)).sigmoid(),
        rgb=mlp(10, 3),
        ways=GROUPED,
    ),
    inside("shaded", lambda s, x: s.net(x)[:, 1:4] * slope(s.net(x)[:, :1], x).sum(-1, keepdim=True).clamp(min=0)),
    inside("eikonal", lambda s, x: (slope(s.net(x)[:, :1], x).norm(dim=-1) - 1) ** 2),
    inside("Laplacian", curvature),
]

# KANs -----------------------------------------------------------------------------------------------------------------


def chebyshev(s: Any, x: Tensor) -> Tensor:
    x = torch.tanh(x)
    t = [torch.ones_like(x), x]
    for _ in range(3):
        t.append(2 * x * t[-1] - t[-2])
    return torch.einsum("bid,iod->bo", torch.stack(t, -1), s.c)


KINDS["kans"] = [
    Row("B-splines", lambda: fields.KAN(16), (3,)),
    own("Chebyshev", chebyshev, c=parameter(3, 4, 5), ways=BOTH),
    own("sum of products", lambda s, x: (torch.stack([x, x**2], -1)[:, None] * s.c).sum((2, 3)), c=parameter(4, 3, 2)),
    own("flattened", lambda s, x: torch.stack([x, x**3], -1).flatten(1) @ s.c.flatten(1).T, c=parameter(4, 3, 2)),
]

# norms ----------------------------------------------------------------------------------------------------------------


def normed(norm: Callable[[nn.Module], nn.Module]) -> dict[str, Part]:
    return {"a": lambda: norm(nn.Linear(3, W)), "b": lambda: norm(nn.Linear(W, W))}


def behind(s: Any, x: Tensor) -> Tensor:
    return s.o(F.relu(s.b(F.relu(s.a(x)))))


def between(name: str, call: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(F.silu(call(s, s.a(x)))), **parts)


KINDS["norms"] = [
    own("weight_norm by hooks", behind, **normed(nn.utils.weight_norm), ways=BOTH),
    own("weight_norm", behind, **normed(nn.utils.parametrizations.weight_norm), ways=BOTH),
    between("LayerNorm", lambda s, h: s.n(h), n=lambda: nn.LayerNorm(W), ways=BOTH),
    between("LayerNorm, bare", lambda s, h: s.n(h), n=lambda: nn.LayerNorm(W, elementwise_affine=False)),
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

# tables ---------------------------------------------------------------------------------------------------------------


KINDS["tables"] = [
    Row("K-Planes", lambda: fields.KPlanes((4, 8)), (3,)),
    own(
        "row by index",
        lambda s, x: s.net(torch.cat([x, s.table[(x[:, 0] > 0).long()]], -1)),
        table=parameter(2, 4),
        net=7,
        ways=GROUPED,
    ),
    own(
        "embedding",
        lambda s, x, i: s.net(torch.cat([x, F.embedding(i, s.code)], -1)),
        3,
        images,
        code=parameter(9, 4),
        net=7,
        ways=GROUPED,
    ),
]

# residual blocks ------------------------------------------------------------------------------------------------------


def residual(name: str, call: Callable[..., Tensor], **parts: Part) -> Row:
    return own(name, lambda s, x: s.o(call(s, s.stem(x))), **{"stem": (3, W), "a": (W, W), **parts})


KINDS["residual"] = [
    residual("behind", lambda s, h: F.relu(h + s.b(F.relu(s.a(h))))),
    residual("scaled", lambda s, h: h + 0.1 * s.b(F.gelu(s.a(h)))),
    residual("dense", lambda s, h: s.c(torch.cat([h, s.a(h).relu(), s.b(h).relu()], -1)), c=(3 * W, W)),
    residual("twice the same", lambda s, h: h + s.a(F.relu(s.a(F.relu(h)))) + s.b(h), ways=BOTH),
]

# conditions -----------------------------------------------------------------------------------------------------------


def modulated(s: Any, x: Tensor, z: Tensor) -> Tensor:
    gamma, beta = s.m(z).chunk(2, -1)
    return s.o(torch.sin(gamma * s.a(x) + beta))


def low_rank(s: Any, x: Tensor) -> Tensor:
    return s.o(F.relu(F.linear(x, s.w + s.u @ s.v)))


KINDS["conditions"] = [
    own("code beside the position", lambda s, x, z: s.net(torch.cat([x, z], -1)), 3, 8, net=11),
    own("code of the module", lambda s, x: s.net(torch.cat([x, s.z.expand(len(x), -1)], -1)), z=parameter(1, 5), net=8),
    own("FiLM", modulated, 3, 8, m=mlp(8, 2 * W), ways=BOTH),
    own("low rank", low_rank, w=parameter(W, 3), u=parameter(W, 2), v=parameter(2, 3)),
    own("bilinear", lambda s, x, z: torch.einsum("ni,oij,nj->no", x, s.w, z), 3, 4, w=parameter(4, 3, 4)),
    own(
        "time",
        lambda s, x, t: s.o(F.relu(s.a(torch.cat([x, t.expand(len(x), 1)], -1)))),
        3,
        lambda _: torch.tensor([[0.3]]),
        a=(4, W),
    ),
]

# raw weights ----------------------------------------------------------------------------------------------------------


def raw(name: str, call: Callable[..., Tensor], **more: Any) -> Row:
    return own(name, lambda s, x: s.o(F.relu(call(s, x))), w=parameter(3, W), b=parameter(W), **more)


KINDS["weights"] = [
    raw("matmul", lambda s, x: x @ s.w + s.b, ways=BOTH),
    raw("linear", lambda s, x: F.linear(x, s.w.t(), s.b), ways=BOTH),
    raw("addmm", lambda s, x: torch.addmm(s.b, x, s.w)),
    raw("einsum", lambda s, x: torch.einsum("...i,io->...o", x, s.w) + s.b),
    raw("mm", lambda s, x: torch.mm(x, s.w).add(s.b)),
    raw("tied", lambda s, x: (x @ s.w) @ s.w.T @ s.w + s.b, ways=BOTH),
    raw("inner and T", lambda s, x: torch.inner(x, s.w.T) + s.b),
    raw("tensordot", lambda s, x: torch.tensordot(x, s.w, dims=1) + s.b),
]

# convolutions with kernel size 1 --------------------------------------------------------------------------------------


def conv(i: int, o: int, kind: Callable[..., nn.Module] = nn.Conv1d, **options: Any) -> Callable[[], nn.Module]:
    return lambda: kind(i, o, 1, **options)


KINDS["convolutions"] = [
    own("Conv1d", lambda s, x: s.b(F.relu(s.a(x[..., None]))).squeeze(-1), a=conv(3, W), b=conv(W, 4)),
    own("Conv1d, no bias", lambda s, x: s.o(F.relu(s.a(x.unsqueeze(2))[:, :, 0])), a=conv(3, W, bias=False)),
    own("Conv3d", lambda s, x: s.a(x.view(-1, 3, 1, 1, 1)).view(-1, 4), a=conv(3, 4, nn.Conv3d)),
    own("conv1d", lambda s, x: F.conv1d(x[..., None], s.w, s.b)[..., 0], w=parameter(4, 3, 1), b=parameter(4)),
    own("two in a row", lambda s, x: s.b(s.a(x[..., None])).squeeze(-1), a=conv(3, 8), b=conv(8, 4), ways=BOTH),
]

# methods --------------------------------------------------------------------------------------------------------------


KINDS["methods"] = [
    Row("forward", fields.Heads, (3, 3)),
    Row("density", fields.Heads, (3,), method="density", ways=BOTH),
    Row("color", fields.Heads, (3, 3, 4), method="color"),
]

# samples on other axes, and networks of constants --------------------------------------------------------------------


def tokens(name: str, call: Callable[..., Any], *shape: int, **parts: Part) -> Row:
    """Returns the row of a module whose samples have axes of their own, [n, *shape]."""
    return replace(own(name, call, of(*shape), **parts), coords=inner)


def heads_in_front(s: Any, x: Tensor, between: Callable[[Tensor], Tensor] = lambda q: q) -> Tensor:
    """Computes AutoInt's attention over the fields of a sample, with heads in front of the samples."""
    q, k, v = (torch.stack(torch.split(torch.tensordot(x, w, dims=([-1], [0])), 4, dim=2)) for w in (s.q, s.k, s.v))
    result = torch.matmul(F.softmax(torch.einsum("bnik,bnjk->bnij", between(q), k), dim=-1), v)
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


def of_the_time(s: Any, x: Tensor, t: Tensor) -> Tensor:
    weight, bias = s.m(t.view(1, 1)).view(-1).split([3 * W, W])
    return s.o(torch.tanh(F.linear(x, weight.view(W, 3), bias)))


def deeponet(s: Any, x: Tensor) -> Tensor:
    """Multiplies a branch of the sample with a trunk of places that all samples share."""
    return torch.tanh(s.a(x)) @ torch.tanh(s.trunk(s.sensors)).t() + s.c


def squashed(s: Any, x: Tensor) -> Tensor:
    """Computes ffjord's layer: a gate and a bias that depend on a time alone."""
    return s.a(x) * torch.sigmoid(s.g(torch.ones(1, 1).type_as(x))) + s.c(torch.full((1, 1), 0.3).to(x))


def flow(s: Any, x: Tensor) -> Tensor:
    """Computes torchdiffeq's continuous flow, whose weights come from a network of the time."""
    numbers = s.m(torch.full((1, 1), 0.3).to(x)).reshape(-1)
    inner, outer, bias = numbers[:12].view(4, 3, 1), numbers[12:24].view(4, 1, 3), numbers[24:].view(4, 1, 1)
    return (torch.tanh(x.unsqueeze(0).repeat(4, 1, 1) @ inner + bias) @ outer).mean(0)


def products_in_front(s: Any, x: Tensor) -> Tensor:
    h = torch.tanh(s.w @ (s.a(x).t() * s.v))  # features in front of the samples
    return (h.t().unsqueeze(0) @ s.u).movedim(0, 1).flatten(1)


def masked_attention(heads: int) -> Callable[..., Tensor]:
    """Returns the forward of nanoGPT's block: causal attention over the tokens of a sample."""

    def forward(s: Any, x: Tensor) -> Tensor:
        n, t, c = x.size()
        q, k, v = (part.view(n, t, heads, c // heads).transpose(1, 2) for part in s.qkv(s.n(x)).split(c, dim=2))
        scores = (q @ k.transpose(-2, -1)) / math.sqrt(k.size(-1))
        scores = scores.masked_fill(s.mask[:, :, :t, :t] == 0, float("-inf")).softmax(-1)
        y = torch.cosh(scores @ v).transpose(1, 2).contiguous().view(n, t, c)
        return (x + s.out(y)).flatten(1)

    return forward


def attention_parts(count: int) -> dict[str, Part]:
    mask = lambda: torch.tril(torch.ones(count, count)).view(1, 1, count, count)  # noqa: E731
    return {"qkv": (4, 12), "out": (4, 4), "n": lambda: nn.LayerNorm(4), "mask": mask}


def at_noon(_: tuple[int, ...]) -> Tensor:
    return torch.tensor(0.5)


SQUARE: dict[str, Part] = {name: parameter(8, 8) for name in "qkv"}
KINDS["axes"] = [
    tokens("heads in front", heads_in_front, 5, 8, **SQUARE, ways=BOTH),
    tokens("heads in the batch", heads_in_the_batch, 5, 3, k=(3, W), v=(3, W)),
    tokens("causal attention", causal, 6, 16, qkv=(16, 48), out=(16, 16)),
    own("turned between", lambda s, x: s.b(torch.cosh(s.a(x).t()).t()), a=(3, 64), b=(64, 2), ways=BOTH),
    own("weights in front", lambda s, x: s.o(torch.relu(s.w @ x.t()).t()), w=parameter(W, 3), ways=GROUPED),
    own("weights before columns", lambda s, x: s.o(torch.matmul(s.w, x[..., None]).squeeze(-1)), w=parameter(W, 3)),
    *(
        own(f"trunk of {n} sensors", deeponet, trunk=(2, W), sensors=buffer(n, 2), c=number(0.1), ways=BOTH)
        for n in (1, 16, 37)
    ),
    own("gate of a constant", squashed, g=(1, W), c=lambda: nn.Linear(1, W, bias=False), ways=BOTH),
    own("weights of a constant", flow, m=mlp(1, 4 * 7, nn.Tanh), ways=BOTH),
    own("products in front", products_in_front, v=parameter(W, 1), w=parameter(5, W), u=parameter(4, 5, 2), ways=BOTH),
    tokens("heads in front, cosh", lambda s, x: heads_in_front(s, x, torch.cosh), 5, 8, ways=BOTH, **SQUARE),
    *(
        tokens(f"masked attention over {t}", masked_attention(heads), t, 4, ways=BOTH, **attention_parts(t))
        for t, heads in ((1, 2), (3, 1), (33, 2))
    ),
    own("layer of the time", of_the_time, 3, at_noon, m=mlp(1, 4 * W, nn.Tanh)),
    own("masked weights", lambda s, x: s.o(F.linear(x, s.w * s.mask)), w=parameter(W, 3), mask=buffer(W, 3), ways=BOTH),
]

# layers ---------------------------------------------------------------------------------------------------------------


def evaluating(row: Row) -> Row:
    return replace(row, make=lambda: evaluated(row.make()))


CELLS: dict[str, Part] = {
    name: lambda kind=kind: kind(3, W)
    for name, kind in zip(["gru", "lstm", "rnn"], (nn.GRUCell, nn.LSTMCell, nn.RNNCell))
}


def cells(s: Any, x: Tensor, h: Tensor) -> Tensor:
    h, c = s.lstm(x, (s.gru(x, h), torch.zeros(len(x), W).to(x)))
    return s.rnn(x, h) * c


def series(name: str, kind: type[nn.RNNBase], **options: Any) -> Row:
    """Returns the row of a forecast from the last state of a recurrent layer."""
    wide = 5 * (1 + options.get("bidirectional", False))
    parts = {"r": lambda: kind(3, 5, batch_first=True, **options), "o": (wide, 4)}
    return tokens(name, lambda s, x: s.o(s.r(x)[0][:, -1]), 5, 3, ways=GROUPED, **parts)


def channels(name: str, layer: Callable[[], nn.Module], *shape: int) -> Row:
    """Returns the row of a layer over channels, whose samples have the given shape."""
    name = f"{name} of channels"
    return own(name, lambda s, x: s.o(s.n(s.a(x).view(-1, *shape)).flatten(1)), n=layer, ways=BOTH)


def convolved(s: Any, x: Tensor) -> Tensor:
    assert x.shape[0] > 0, "called without rows"
    return s.o(s.conv(x[:, None]).flatten(1))


def tensordot(s: Any, x: Tensor, z: Tensor) -> Tensor:
    return s.o(torch.tensordot(x[:, :, None] * z[:, None], s.n.weight, ([1, 2], [1, 2])) + s.n.bias)


def attended(s: Any, x: Tensor) -> Tensor:
    h = s.a(x)
    return s.o(h + s.m(h, h, h)[0])


KINDS["layers"] = [
    evaluating(between("BatchNorm in eval", lambda s, h: s.n(h), n=lambda: nn.BatchNorm1d(W), ways=BOTH)),
    evaluating(between("Dropout in eval", lambda s, h: s.n(h), n=lambda: nn.Dropout(0.5))),
    between("PReLU", lambda s, h: s.n(h), n=nn.PReLU, ways=BOTH),
    channels("PReLU", lambda: nn.PReLU(4), 4, 6),
    channels("GroupNorm", lambda: nn.GroupNorm(2, 4), 4, 6),
    channels("InstanceNorm", lambda: nn.InstanceNorm1d(4, affine=True), 4, 6),
    evaluating(channels("BatchNorm1d", lambda: nn.BatchNorm1d(4), 4, 6)),
    evaluating(channels("BatchNorm2d, bare", lambda: nn.BatchNorm2d(4, affine=False), 4, 3, 2)),
    between("GroupNorm", lambda s, h: s.n(h), n=lambda: nn.GroupNorm(4, W), ways=BOTH),
    own("Bilinear", lambda s, x, z: s.o(F.relu(s.n(x, z))), 3, 4, n=lambda: nn.Bilinear(3, 4, W), ways=BOTH),
    own("bilinear", lambda s, x, z: s.o(F.bilinear(x, z, s.w)), 3, 4, w=parameter(W, 3, 4), ways=BOTH),
    tokens("GRU", lambda s, x: s.o(s.r(x)[0][:, -1]), 5, 3, r=lambda: nn.GRU(3, W, batch_first=True), ways=GROUPED),
    tokens("LSTM", lambda s, x: s.o(s.r(x)[0]), 5, 3, r=lambda: nn.LSTM(3, W, batch_first=True), ways=GROUPED),
    own("recurrent cells", cells, 3, W, ways=BOTH, **CELLS),
    series("LSTM of two layers in both directions", nn.LSTM, num_layers=2, bidirectional=True),
    series("RNN without biases", nn.RNN, bias=False, nonlinearity="relu"),
    own("Conv1d with a kernel", convolved, conv=lambda: nn.Conv1d(1, 2, 2), o=(4, 4), ways=BY_CELL),
    own("tensordot of two axes", tensordot, 3, 4, n=lambda: nn.Bilinear(3, 4, W), ways=BOTH),
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


KINDS["state"] = [
    hidden("layers in a list", lambda a, b: [a, b], lambda kept, x: kept[1](F.relu(kept[0](x)))),
    hidden("layers in a dict", lambda a, b: {"a": a, "b": b}, lambda kept, x: kept["b"](F.relu(kept["a"](x)))),
    own("results in a dict", keeps, outputs=dict, ways=GROUPED),
    own("results as attributes", kept),
    own("counted steps", annealed, step=lambda: 100),
    own("counted steps, buffer", annealed, step=lambda: torch.tensor(100.0)),
    own("cache by the number of samples", numbered, rows=lambda: None),
    own("frozen encoder", frozen),
    own("detached encoder", lambda s, x: s.o(F.relu(s.b(F.relu(s.a(x)).detach())))),
    own("unused head", lambda s, x: (s.o(F.relu(s.a(x))), s.c(x).detach()), c=(3, 2)),
    own("tensor in a list", lambda s, x: s.net(x * s.scale[0]), scale=lambda: [torch.tensor([1.0, 2.0, 3.0])]),
]

# calls ----------------------------------------------------------------------------------------------------------------


def in_a_dict(s: Any, x: Tensor) -> dict[str, Any]:
    h = F.elu(s.a(x))
    result: dict[str, Any] = {name: head(h) for name, head in s.heads.items()}
    result["semantics"] = {"logits": result["semantics"], "label": result["semantics"].argmax(-1)}
    return {**result, "normals": None, "kind": "heads"}


def heads() -> nn.Module:
    return nn.ModuleDict({"rgb": nn.Linear(W, 3), "sigma": nn.Linear(W, 1), "semantics": nn.Linear(W, 5)})


def steered(s: Any, x: Tensor, mode: str = "near", *, scale: float = 1.0, extra: Tensor | None = None) -> Tensor:
    """Computes by flags, sizes and optional arguments."""
    if x.shape[0] == 0:
        return x.new_zeros(0, 4)
    h = s.near(x) if mode == "near" and x.shape[-1] == 7 else s.far(x[..., :3])
    if extra is not None:
        h = h + extra
    if s.training and scale > 1:
        h = h * scale
    while h.shape[-1] > W:
        h = h[..., :-1]
    return s.o(torch.relu_(h))


def written(s: Any, x: Tensor) -> Tensor:
    """Computes with ``view(-1, C)``, products of activations, chunks, in-place operations and a buffer."""
    waves = (x[..., :3, None] * s.bands).flatten(-2)
    h = s.fc(torch.cat([waves.sin(), waves.cos()], -1))
    gamma, beta = s.film(h).chunk(2, -1)
    h = h * gamma
    h += beta
    h[..., :2] += 1
    matrix = h.view(-1, 4, 3)
    h = torch.bmm(matrix, matrix.transpose(1, 2)).view(-1, 16)[:, :12]
    out = s.out(torch.softmax(h, -1) / h.norm(dim=-1, keepdim=True))
    return torch.cat([torch.sigmoid(out[..., :3]), out[..., 3:].clamp(min=0)], -1)


def in_a_box(s: Any, x: Tensor) -> Tensor:
    inside = (x.abs() < 0.6).all(-1)
    out = x.new_zeros(len(x), 4)
    out[inside] = s.net(x[inside])
    return out


def in_order(s: Any, x: Tensor) -> Tensor:
    order = x[:, 2].argsort()
    return s.net(x[order])[order.argsort()]


def squareplus(x: Tensor, b: float) -> Tensor:
    return 0.5 * (x + torch.sqrt(x * x + b))


with warnings.catch_warnings():  # TorchScript is deprecated, but old code uses it
    warnings.simplefilter("ignore", DeprecationWarning)
    scripted = torch.jit.script(squareplus)  # function modes do not see its operations


KINDS["calls"] = always(
    own("heads in a dict", in_a_dict, heads=heads),
    own("flags, near", steered, 7, near=(7, W), far=(3, W), keywords={"scale": 2.0}),
    own("flags, far", steered, 7, "far", near=(7, W), far=(3, W), keywords={"extra": W}),
    own("written in place", written, bands=octaves(2), fc=(12, 12), film=(12, 24), out=(12, 4)),
    ways=GROUPED,
)
KINDS["calls"] += always(
    own("samples in a box", in_a_box),
    own("samples in order", in_order),
    own("scripted", lambda s, x: s.o(scripted(s.a(x), 4.0))),
    own("checkpoint", lambda s, x: s.o(checkpoint(s.block, x, use_reentrant=False)), block=mlp(3, W)),
    ways=BY_CELL,
)
KINDS["calls"] += always(Row("table", lambda: NeRF(width=10, depth=3, skips=(1,)), (3, 3)), ways=("fused",))

# arguments per sample, per ray or for all samples, also in containers and objects -------------------------------------


class CodePerRay(nn.Module):
    """A field that takes a view direction, a code and a time for each ray."""

    def __init__(self, code: int = 5) -> None:
        super().__init__()
        self.net = nn.Linear(3 + 3 + code + 1, 4)

    def forward(self, x: Tensor, d: Tensor, *, code: Tensor | None = None, time: Tensor | None = None) -> Tensor:
        parts = [x, d.expand_as(x), code[:, None].expand(*x.shape[:-1], -1)]
        return self.net(torch.cat([*parts, time[:, None, None].expand(*x.shape[:-1], 1)], -1))


@dataclass
class Frustums:
    """The positions of samples on rays."""

    origins: Tensor
    directions: Tensor
    starts: Tensor

    def positions(self) -> Tensor:
        return self.origins + self.directions * self.starts


@dataclass
class Samples:
    """Samples as an object."""

    frustums: Frustums
    camera: Tensor
    name: str = "ray"
    metadata: dict[str, Any] | None = None


def positions_of(samples: Samples) -> Tensor:
    return samples.frustums.positions()


def takes_samples(s: Any, samples: Samples) -> dict[str, Any]:
    """Takes samples as an object, and looks up a code for each camera."""
    positions, code = samples.frustums.positions(), s.table(samples.camera[..., 0])
    h = s.fc(torch.cat([positions, samples.frustums.directions, code], -1))
    return {"colour": h, "kept": Frustums(positions, h, h[..., :1]), "name": samples.name}


def samples_of(lead: tuple[int, ...]) -> Samples:
    frustums = Frustums(uniform(lead, 3), uniform(lead, 3), uniform(lead, 1))
    return Samples(frustums, torch.randint(4, (*lead, 1)), metadata={"none": None})


OF_RAYS = {"code": per_ray(5), "time": per_ray()}
KINDS["arguments"] = always(
    Row("rows of rays", CodePerRay, (3, per_ray(1, 3)), keywords=OF_RAYS, lead=RAYS),
    replace(
        Row("named rows of rays", CodePerRay, (3, per_ray(1, 3)), keywords=OF_RAYS, lead=RAYS),
        options={"per_ray": ["d", "code", "time"]},
    ),
)
KINDS["arguments"] += always(
    replace(
        own("objects", takes_samples, samples_of, table=lambda: nn.Embedding(4, 2), fc=(8, 3)),
        coords=positions_of,
        lead=RAYS,
    ),
    ways=GROUPED,
)

# single uses of parameters, with or without a grouped rule ------------------------------------------------------------


def index(h: Tensor) -> Tensor:
    return (h[:, 0] > 0).long()


STEPS: list[Callable[[Any, Tensor], Tensor]] = [
    lambda s, h: h @ s.vector,
    lambda s, h: (s.square @ h.t()).t(),
    lambda s, h: torch.einsum("ni,oi", h, s.square),
    lambda s, h: torch.einsum("in,oi->no", h.t(), s.square),
    lambda s, h: torch.einsum("ni,oi,o->no", [h, s.square, s.vector]),
    lambda s, h: torch.einsum("nci,oi->nco", h[:, None], s.square)[:, 0],
    lambda s, h: (h[:, None] * s.cube).sum(1),
    lambda s, h: (h[:, None].expand(-1, 2, -1) * s.cube[0]).sum(1),
    lambda s, h: h * s.square.sum(),
    lambda s, h: torch.where(h > 0, h, s.vector),
    lambda s, h: h.add(s.vector).clamp(s.one - 1, s.vector + 1),
    lambda s, h: F.layer_norm(h, (4,), s.vector, torch.ones(4).to(h)),
    lambda s, h: F.rms_norm(h, (4,), s.vector),
    lambda s, h: s.table(index(h)),
    lambda s, h: s.square[index(h) - 1],
    lambda s, h: s.square[:, index(h)].t(),
    lambda s, h: s.cube[0].repeat(len(h), 1, 1).sum(1),
    lambda s, h: s.one.expand(len(h), 4) + s.vector.detach(),
    lambda s, h: h * max(s.vector.tolist()),
    lambda s, h: h * torch.stack(torch.unbind(s.square)).norm(),
    lambda s, h: F.linear(h, s.square, torch.ones(4).to(h)) + F.linear(h, torch.eye(4).to(h), s.vector),
    lambda s, h: h + torch.autograd.grad(s.vector.square().sum(), s.vector, create_graph=True)[0],
    lambda s, h: torch.einsum("bid,iod->bo", h.view(-1, 2, 2), s.square.view(2, 4, 2)),
    lambda s, h: torch.einsum("iod,dbi->bo", s.square.view(4, 2, 2), torch.stack([h.cos(), h.sin()])),
    lambda s, h: torch.einsum("bxd , ode -> boxe", [h.view(-1, 2, 2), s.square.view(4, 2, 2)]).sum((2, 3)),
    lambda s, h: torch.einsum("bi,oi->bio", h, s.square).sum(1) * torch.einsum("bi,i->b", h, s.vector)[:, None],
    lambda s, h: torch.einsum("bix,iox->bo", h.view(-1, 2, 2), s.cube.view(2, 2, 2)).repeat(1, 2),
    lambda s, h: torch.einsum("bix,iox->box", h.view(-1, 2, 2), s.cube.view(2, 2, 2)).flatten(1),
    lambda s, h: torch.einsum("bi,oi->ob", h, s.square).t(),
    lambda s, h: F.conv2d(h[..., None, None], s.square[..., None, None], s.vector)[..., 0, 0],
    lambda s, h: F.conv1d(h.view(-1, 2, 2), s.cube.view(4, 2, 1)).sum(2),
    lambda s, h: F.conv2d(h.t()[None, :, None], s.square[..., None, None])[0, :, 0].t(),
    lambda s, h: F.conv1d(h.t(), s.square[..., None], s.vector, stride=1, padding=0).t(),
    lambda s, h: F.conv1d(h[:, None], s.vector.view(1, 1, 4), padding="same")[:, 0],
    lambda s, h: h.to(s.vector) * s.vector.type_as(h) + s.one.new_ones(len(h), 4),
    lambda s, h: s.one.new_zeros(2, 4).sum(0) + torch.ones(1, 4).to(h).expand_as(h) * s.vector,
    lambda s, h: torch.baddbmm(s.one, h.view(-1, 2, 2).movedim(1, 0), s.cube.view(2, 2, 2)[..., [0, 1, 0, 1]]).sum(0),
    lambda s, h: torch.bmm(s.square.view(2, 2, 4), h.t().expand(2, 4, len(h))).flatten(0, 1).t(),
    lambda s, h: torch.addmm(s.vector, h, s.square) + torch.mv(h, s.vector)[:, None],
]


def step(number: int, ways: tuple[str, ...]) -> Row:
    """Returns the row of a layer and of a step that uses parameters of many shapes."""
    shapes = {"vector": (4,), "square": (4, 4), "one": (1, 4), "cube": (1, 2, 4)}
    parts: dict[str, Part] = {name: parameter(*shape, scale=1.0) for name, shape in shapes.items()}
    parts |= {"fc": (3, 4), "table": lambda: nn.Embedding(5, 4, padding_idx=0)}
    return own(f"step {number}", lambda s, x: STEPS[number](s, s.fc(x)), ways=ways, **parts)


def corners(s: Any, x: Tensor) -> Tensor:
    """Looks up one table several times, mixed by the positions, and another table once."""
    index = (x[:, :2].abs() * 5).long()
    low, high = s.table[index], s.table[-1 - index]
    mixed = (low * x[:, :2, None] + high * (1 - x[:, :2, None]) ** 2).sum(1)
    return torch.cat([mixed, mixed**2, s.codes(index[:, 0]) * x[:, 2:3] ** 3], 1)


def planes(s: Any, x: Tensor) -> Tensor:
    """Reads a plane and a volume; samples are dimension 1 of the plane's grid, and 3 of the volume's."""
    pairs = torch.stack([x[:, :2], x[:, 1:]], 1)
    plane = F.grid_sample(s.plane, pairs[None], align_corners=True)
    volume = F.grid_sample(s.volume, x.view(1, 1, 1, -1, 3), padding_mode="border", align_corners=False)
    return torch.cat([plane[0].permute(1, 0, 2).flatten(1), volume.view(2, -1).T], -1)


def scales(s: Any, x: Tensor) -> tuple[Tensor, Tensor]:
    """Computes with elementwise parameters: [d], [1, d] and a number (VolSDF's beta, NeuS's variance)."""
    inverse = torch.ones([len(x), 1], dtype=x.dtype) * torch.exp(s.beta * 10.0)
    return s.o(torch.tanh(s.scale * s.a(x) + s.shift)) * s.beta.abs().clamp(min=1e-4), inverse


def tied(s: Any, x: Tensor) -> Tensor:
    h = F.relu(s.a(x))
    return F.linear(F.relu(s.pair[0](h)) + F.relu(s.pair[1](h)), s.a.weight.t())


def tied_pair() -> nn.ModuleList:
    """Returns two layers with the same weight."""
    pair = layers(W, W, W)()
    pair[1].weight = pair[0].weight
    return pair


def average_code(s: Any, x: Tensor, i: Tensor) -> Tensor:
    found = s.codes(i) + F.embedding(i, s.codes.weight)
    average = s.codes.weight.mean(dim=0).expand(x.shape[0], -1)
    return s.net(torch.cat([x, found + average + s.table[3].expand(len(x), 4)], -1))


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

CORNERS = own("corners", corners, table=parameter(11, 2), codes=lambda: nn.Embedding(7, 3))
STEPS_BY_CELL = {2, 4, 13, 15, 18, 21, 33}
RULES = [step(i, BY_CELL if i in STEPS_BY_CELL else GROUPED) for i in range(len(STEPS))]
RULES += always(
    CORNERS,
    own("planes", planes, plane=parameter(1, 3, 5, 4), volume=parameter(1, 2, 3, 4, 5)),
    own("scales", scales, scale=parameter(W), shift=parameter(1, W), beta=number(0.1)),
    own("layers of one weight", tied, pair=tied_pair),
    own(
        "codes and their average",
        average_code,
        3,
        images,
        codes=lambda: nn.Embedding(9, 4),
        table=parameter(6, 4),
        net=7,
    ),
    Row("a rule of one's own", lambda: Scales(scale_rows), (7,)),
    ways=GROUPED,
)

# parameters that all cells share: one look-up for all samples, then a network for each cell ---------------------------


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


def encoded(s: Any, x: Tensor) -> dict[str, Tensor]:
    raw = s.net(s.encoder(x)) * s.gain.exp()
    return {"rgb": torch.sigmoid(raw[:, :3]), "sigma": torch.exp(raw[:, 3])}


def small(s: Any, x: Tensor) -> Tensor:
    return s.head(torch.cat([s.encoder(x), s.table((x[:, 0] > 0).long())], -1))


def sharing(name: str, make: Callable[[], nn.Module], *share: str, inputs: tuple[Any, ...] = (3,)) -> Row:
    return Row(f"{name}, shared", make, inputs, options={"share": list(share)})


def first_layers() -> nn.Module:
    return nn.Sequential(nn.Linear(3, W), nn.ReLU())


def near(lead: tuple[int, ...]) -> Tensor:
    return uniform(lead, 3) * 0.95


SHARED = always(
    sharing("nerfacto", lambda: fields.HashTable(1 << 8, 4, 16), "hash_table"),
    sharing("hashnerf", lambda: fields.HashEmbedder(1 << 8, 4, 16), "embeddings.*"),
    sharing("tensorf", lambda: fields.TensorField(8, 4, 16), "plane.*", "line.*"),
    sharing("tensorf with its basis", lambda: fields.TensorField(8, 4, 16), "plane.*", "line.*", "basis_mat.*"),
    sharing("k-planes", lambda: fields.KPlanes((4, 8), 4, 16), "grids.*"),
    ways=("fused",),
)
SHARED += always(
    sharing("torch-ngp", lambda: fields.NeRFNetwork(1 << 9, 4, 16), "encoder.*", inputs=(near, 3)),
    sharing("first layer", lambda: nn.Sequential(nn.Linear(3, 6), nn.ReLU(), nn.Linear(6, 2)), "0.*"),
    own(
        "layers and functions, shared", encoded, share=("encoder.*", "gain"), encoder=Encoder, gain=parameter(4), net=8
    ),
)
ENCODED = own(
    "layers and a table, shared",
    small,
    share=("encoder.*", "table.weight"),
    encoder=first_layers,
    table=lambda: nn.Embedding(4, 2),
    head=(W + 2, 2),
    ways=GROUPED,
)
SHARED.append(ENCODED)

# the codebases of examples/ -------------------------------------------------------------------------------------------

_NAMES = ("nerf_pytorch", "flexible_nerf", "nerf_pl", "mipnerf_pl", "nerfacc_field", "nerfstudio_field")
pytorch, flexible, nerf_pl, mip, nerfacc, studio = map(fields.example, _NAMES)
ngp, mega = fields.example("torch_ngp"), fields.example("mega_nerf")


def waves(octaves: int, direction_octaves: int | None) -> Callable[[tuple[int, ...]], Tensor]:
    """Returns a function that makes encoded positions and directions."""
    counts = [octaves] if direction_octaves is None else [octaves, direction_octaves]
    return lambda lead: torch.cat([pytorch.encode(uniform(lead, 3), count) for count in counts], -1)


def plain() -> nn.Module:
    return pytorch.NeRF(D=3, W=8, input_ch=15, input_ch_views=0, output_ch=5, skips=[0])


def flexible_field() -> nn.Module:
    return flexible.FlexibleNeRFModel(6, 8, 2, num_encoding_fn_xyz=2, num_encoding_fn_dir=1)


def pl_field() -> nn.Module:
    return nerf_pl.NeRF(3, 8, 15, 9, skips=[1])


def mip_field() -> nn.Module:
    return mip.MLP(net_depth=6, net_width=10, net_width_condition=6, skip_index=2, xyz_dim=12, view_dim=9)


def nerfacc_field() -> nn.Module:
    return nerfacc.VanillaNeRFRadianceField(3, 10, 1, 6)


def ngp_field() -> nn.Module:
    field = ngp.NeRFNetwork(8, 4)
    field.encoder = ngp.GridEncoder(log2_hashmap_size=8)
    return field


def mega_field(**options: Any) -> Callable[[], nn.Module]:
    return lambda: mega.NeRF(layers=3, skip_layers=(1,), layer_dim=10, appearance_dim=5, appearance_count=7, **options)


def of_image(lead: tuple[int, ...]) -> Tensor:
    return torch.cat([uniform(lead, 6), torch.randint(0, 7, (*lead, 1))], -1)


def studio_field() -> nn.Module:
    return studio.AppearanceField(torch.tensor([[-2.0, -2, -2], [2, 2, 2]]), num_images=5, hidden_dim=9, geo_feat_dim=4)


def studio_row(method: str, argument: Any, keywords: dict[str, Any]) -> Row:
    options = {"methods": ["get_density", "get_outputs", "density_fn"]}
    return Row(f"nerfstudio {method}", studio_field, (argument,), method, keywords, studio.positions_of, RAYS, options)


def ray_samples(lead: tuple[int, ...]) -> Any:
    return studio.ray_samples_of(*lead)


PYTORCH = always(
    Row("nerf-pytorch", lambda: fields.skip_net(15, 9), (waves(2, 1),)),
    Row("nerf-pytorch without views", plain, (waves(2, None),), options={"coords": slice(0, 3)}),
)
EXAMPLES = PYTORCH + always(
    Row("FlexibleNeRF", flexible_field, (waves(2, 1),), lead=RAYS),
    Row("nerf_pl", pl_field, (waves(2, 1),)),
    Row("nerf_pl sigma_only", pl_field, (waves(2, None),), keywords={"sigma_only": True}),
    Row("mipnerf_pl", mip_field, (12, per_ray(9)), lead=RAYS, options={"per_ray": ["view_direction"]}),
    Row("mipnerf_pl without views", mip_field, (12,), lead=RAYS),
    Row("nerfacc", nerfacc_field, (3, 3)),
    Row("nerfacc, condition per ray", nerfacc_field, (3, per_ray(3)), lead=RAYS, options={"per_ray": ["condition"]}),
    Row("nerfacc query_density", nerfacc_field, method="query_density"),
    Row("nerfacc query_opacity", nerfacc_field, (3, 0.01), method="query_opacity"),
    Row("torch-ngp color", ngp_field, (3, 3), "color", {"geo_feat": 4}),
    Row("mega-nerf sigma_only", mega_field(), (3, True)),
)
EXAMPLES += always(
    studio_row("forward", ray_samples, {}),
    studio_row("get_density", ray_samples, {}),
    studio_row("get_outputs", ray_samples, {"density_embedding": 4}),
    studio_row("density_fn", 3, {}),
    Row("torch-ngp", ngp_field, (3, 3), options={"methods": ["density", "color"]}),
    Row("torch-ngp density", ngp_field, method="density"),
    Row("mega-nerf", mega_field(), (of_image,), keywords={"sigma_only": False}),
    Row("mega-nerf affine with noise", mega_field(affine=True), (of_image,), keywords={"sigma_noise": 1}),
    ways=GROUPED,
)
EXAMPLES += always(
    Row("torch-ngp color of some", ngp_field, (3, 3, lambda lead: torch.rand(lead) < 0.5), "color", {"geo_feat": 4}),
    ways=BY_CELL,  # the module selects rows
)

KINDS |= {"rules": RULES, "shared": SHARED, "examples": EXAMPLES}
IN_RUNS = ("gradients", "tables", "between")
"""The kinds whose modules are only partly fused: PyTorch computes functions between the fused parts."""
IN_ANY_WAY = ("axes", "layers", "state", "calls", "arguments", "rules", "shared", "examples")
"""The kinds whose modules run in any way. The modules of the kinds in neither list are fused completely."""
