"""Modules that VoronoiRouter refuses because they mix samples, and calls from which it cannot get positions."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from ops.foreign_fields import Heads
from router_loop import Built, uniform
from torch import Tensor, nn

from voronerf import NeRF, VoronoiRouter


@pytest.fixture
def centres() -> Tensor:
    return torch.rand(4, 3) * 2 - 1


class Mixes(nn.Module):
    def __init__(self, step: Callable[[Any, Tensor], Any], **parts: nn.Module) -> None:
        super().__init__()
        self.fc, self.out, self.step = nn.Linear(3, 4), nn.Linear(4, 4), [step]
        for name, part in parts.items():
            self.add_module(name, part)

    def forward(self, x: Tensor) -> Any:
        result = self.step[0](self, self.fc(x))
        return result if isinstance(result, tuple) else self.out(result)


def attention() -> nn.Module:
    return nn.MultiheadAttention(4, 1, batch_first=True)


def transformer() -> nn.Module:
    return nn.TransformerEncoderLayer(4, 2, 16, batch_first=True)


def slope(net: Any, h: Tensor) -> Tensor:
    return torch.autograd.grad(h.square().sum() / h.shape[0], h, create_graph=True)[0]


MIXING: list[tuple[Callable[..., Any], dict[str, Callable[[], nn.Module]]]] = [
    (lambda net, h: net.layer(h[None])[0], {"layer": transformer}),
    (lambda net, h: net.layer(h[None], h[None], h[None])[0][0], {"layer": attention}),
    (lambda net, h: torch.softmax(h @ net.out(h).t(), -1) @ h, {}),
    (lambda net, h: h - h.mean(0), {}),
    (lambda net, h: h + h.roll(1, 0), {}),
    (lambda net, h: h + h[:1], {}),
    (lambda net, h: h.cumsum(0), {}),
    (lambda net, h: h.flip(0), {}),
    (lambda net, h: torch.cat([h[1:], h[:1]]), {}),
    (lambda net, h: h / h.norm(), {}),
    (lambda net, h: h[torch.argsort(h[:, 0])], {}),
    (lambda net, h: h / h.abs().max().item(), {}),
    (lambda net, h: h * (1.0 if h.max() > 0.3 else -1.0) * float(h.sum()), {}),
    (slope, {}),
    (lambda net, h: (h, h.square().mean()), {}),  # a number for the whole batch
]
ALONG_RAYS: list[tuple[Callable[..., Any], dict[str, Callable[[], nn.Module]]]] = [
    (lambda net, h: net.layer(h.mT).mT, {"layer": lambda: nn.Conv1d(4, 4, 3, padding=1)}),
    (lambda net, h: h + net.layer(h, h, h)[0], {"layer": attention}),
    (lambda net, h: torch.cumsum(h, 1), {}),
]


@pytest.mark.filterwarnings("ignore:.*cell by cell")
@pytest.mark.parametrize("number", range(len(MIXING) + len(ALONG_RAYS)))
def test_modules_that_mix_samples_are_refused(number: int, centres: Tensor) -> None:
    """Each sample depends on other samples of the batch or of its ray."""
    step, parts = [*MIXING, *ALONG_RAYS][number]
    module = Mixes(step, **{name: make() for name, make in parts.items()})
    with pytest.raises((ValueError, TypeError), match=r"(?s)VoronoiRouter.*sample"):
        VoronoiRouter(module, centres, coords="first3")(uniform((40,) if number < len(MIXING) else (9, 7)))


WIDE: list[Callable[[Any, Tensor], Any]] = [
    lambda net, h: (torch.cdist(h, h),),
    lambda net, h: (h, h @ h.T),
    lambda net, h: (h[:, None] - h,),
    lambda net, h: (h[:, torch.combinations(torch.arange(len(h))).sum(1) % 4],),  # n (n - 1) / 2 columns
]


WAYS: list[dict[str, Any]] = [{"fuse": True}, {"way": "grouped"}, {"way": "loop"}]


@pytest.mark.parametrize(
    ("number", "options"), [*((i, {}) for i in range(len(WIDE))), *((1, way) for way in WAYS)], ids=str
)
def test_results_as_wide_as_the_batch_are_refused(number: int, options: dict[str, Any], centres: Tensor) -> None:
    """The sizes of the cells do not matter: equal cells would give results of equal width."""
    rule = r"module must treat samples one by one, but Mixes.forward returns \[41, .*\] for 41 samples and \[37, "
    for count in (4, 64):
        equal = centres.repeat(count // 4, 1)
        routers = [VoronoiRouter(Mixes(WIDE[number]), c, coords="first3", **options) for c in (centres, centres[:1])]
        for router, x in ((routers[0], equal), (routers[0], uniform((count,))), (routers[1], equal)):
            with pytest.raises(TypeError, match=rule):
                router(x)
        router = VoronoiRouter(Mixes(WIDE[number]), 4, **options)
        for cells in (torch.arange(count) % 4, torch.arange(count) % 3):
            with pytest.raises(TypeError, match=rule):
                router(equal, cells=cells)


class Field(nn.Module):
    """A field of features, and of optional further features per sample or per ray."""

    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(7, 4)
        self.register_buffer("bands", torch.ones(2))

    def forward(self, x: Tensor, z: Tensor | None = None, note: str = "") -> Tensor:
        return self.fc(x if z is None else torch.cat([x, z.expand(*x.shape[:-1], -1)], -1))


def routed(coords: Any = "first3", **options: Any) -> VoronoiRouter:
    return VoronoiRouter(Field(), torch.rand(4, 3), coords=coords, **options)


def layered(**options: Any) -> VoronoiRouter:
    return VoronoiRouter(NeRF(width=8, depth=2), torch.rand(3, 3), **options)


def single(module: Any) -> VoronoiRouter:
    return VoronoiRouter(module, torch.zeros(2, 3))


def listed() -> nn.Module:
    module = nn.Linear(3, 2)
    module.extra = [{"bias": nn.Parameter(torch.zeros(2))}]
    return module


def holding(value: Any) -> nn.Module:
    module = nn.Linear(3, 2)
    module.held = value
    return nn.Sequential(nn.Linear(3, 3), module)


@dataclasses.dataclass
class Compared(nn.Module):
    """An unhashable module: it compares instances by their fields."""

    width: int = 2

    def __post_init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(3, self.width)


def split(parents: Any) -> None:
    router = layered()
    router.subdivide(router.diagram.refine({0: torch.randn(2, 3)})[0], torch.tensor(parents))


def other_buffer() -> nn.Module:
    field = Field()
    field.bands.mul_(3)
    return field


X, INF, NAN = torch.zeros(6, 7), float("inf"), float("nan")
SPECTRAL = nn.utils.parametrizations.spectral_norm
Errors = list[tuple[Callable[[], Any], type[Exception], str]]
MODULES: Errors = [
    (lambda: single(3), TypeError, "module must be an nn.Module, got int"),
    (
        lambda: single(nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4)))(X, coords=X[:, :3]),
        TypeError,
        "a BatchNorm1d mixes the samples of a batch in training .use LayerNorm, or call router.eval",
    ),
    (
        lambda: single(nn.BatchNorm1d(7, track_running_stats=False)).eval()(X, coords=X[:, :3]),
        TypeError,
        "a BatchNorm1d mixes",
    ),
    (lambda: single(SPECTRAL(nn.Linear(3, 4))), TypeError, "keeps a state for each weight"),
    (lambda: single(listed()), TypeError, "keeps parameters in `extra`, a list, where"),
    (
        lambda: single(holding({"inner": nn.Linear(3, 3)})),
        TypeError,
        "keeps a Linear in `held`, a dict, where parameters.. does not find them",
    ),
    (
        lambda: single(holding([threading.Lock()])),
        TypeError,
        "but `1`, a Linear, keeps in `held` a list, which cannot be copied",
    ),
    (lambda: single(nn.Sequential(Compared())), TypeError, r"must be hashable, .* but a Compared .*\(eq=False\)"),
]
OPTIONS: Errors = [
    (lambda: VoronoiRouter(Field(), torch.randn(8, 5)), ValueError, "centres must"),
    (lambda: routed(assignment="near"), ValueError, "assignment must be 'nearest' or 'stochastic', got 'near'"),
    (lambda: routed(way="quick"), ValueError, "way must be 'fused', 'grouped' or 'loop', got 'quick'"),
    (lambda: routed(temperature=0), ValueError, "temperature must be positive, got 0"),
    (lambda: routed(layout="row"), ValueError, "layout must be 'rays' or 'flat', got 'row'"),
    (lambda: routed(backend="nativ"), ValueError, "backend must be auto, reference, native, warp, got 'nativ'"),
    (lambda: routed("last3"), ValueError, "coords must be 'first1' to 'first4', a slice or a function, got 'last3'"),
    (lambda: routed(methods=["colour_of"]), ValueError, "methods must name methods of Field, got 'colour_of'"),
    (lambda: VoronoiRouter(Heads(), X[:, :3], methods=["cell"]), ValueError, "methods must name methods of Heads"),
    (lambda: routed(methods=["train"]), ValueError, "methods must not name attributes of the router, got 'train'"),
    (lambda: routed(methods="density"), TypeError, "methods must be a list, got 'density'"),
    (lambda: routed(per_ray=["view"]), ValueError, "must name arguments of Field, one of x, z, note, got 'view'"),
    (lambda: routed(share=["out.*"]), ValueError, r"share must name parameters of Field, such as .*, got 'out\.\*'"),
    (lambda: routed(share="fc"), TypeError, "share must be a list, got 'fc'"),
]
CALLS: Errors = [
    (lambda: routed(None)(X), ValueError, "coords must name the positions.*coords=positions"),
    (lambda: routed(slice(0, 4))(X), ValueError, r"coords=slice\(0, 4, None\) of .* must have shape \[\.\.\., 3\]"),
    (lambda: routed(lambda x: None)(X), TypeError, "the result of coords must be a tensor, got NoneType"),
    (lambda: routed()(X, coords=X[:, :2]), ValueError, r"coords must have shape \[\.\.\., 3\], got \[6, 2\]"),
    (lambda: routed()(X, coords=torch.zeros(5, 3)), ValueError, "x must be per sample"),
    (lambda: routed()(X, coords=X[:, :3].long()), TypeError, "coords must be floating-point, got torch.int64"),
    (lambda: routed()("x"), ValueError, "must find a tensor among the arguments, got str; .* a function of the arg"),
    (lambda: routed()(X.numpy()), ValueError, r"tensor among the arguments, got ndarray; pass torch\.as_tensor\("),
    (lambda: routed()(X, coords=X[:, :3].numpy()), TypeError, r"coords must be a tensor, got ndarray; pass torch\.as"),
    (lambda: routed()(X.tolist()), ValueError, r"tensor among the arguments, got list; pass torch\.as_tensor\("),
    (lambda: layered()(X[:, :3].numpy()), TypeError, r"positions must be a tensor, got ndarray; pass torch\.as_tensor"),
    (lambda: routed()(X, X[:4]), ValueError, r"z must be per sample \[6, \.\.\.\], or named in shared=, got \[4, 7\]"),
    (lambda: routed()(X[:, :6]), ValueError, r"x must fit Field\.forward, whose Linear\(.* gets 6 features, got"),
    (lambda: routed(fuse=True)(X.repeat(9, 1)[:, :6]), ValueError, r"x must fit Field\.f.*, got \[54, 6\]; pass"),
    (lambda: routed()(X.double()), TypeError, r"x must be torch.float32, as .* got torch.float64; pass x\.to\(torch"),
    (lambda: routed(way="loop")(X[:, :4], X[:, :3].half().double()), TypeError, "z must be torch.float32, as .* Field"),
    (lambda: layered(coords=lambda p, *_: p.long())(X[:, :3], X[:, :3]), TypeError, "floating-point, got torch.int64"),
    (lambda: layered(coords=lambda p, *_: 3)(X[:, :3], X[:, :3]), TypeError, "must be a tensor, got int"),
    (lambda: layered()(X[:, :2]), ValueError, r"positions must have shape \[n, 3\], got \[6, 2\]"),
    (lambda: layered()(X[:, :3]), ValueError, "directions must be given"),
    (lambda: layered()(X[:, :3], X[:2, :3]), ValueError, r"directions must have shape .* n = 6, got \[2, 3\]"),
]
CELLS: Errors = [
    (lambda: routed().cell(4), IndexError, "index must be below 4, got 4"),
    (lambda: routed().load_cell(4, Field()), IndexError, "index must be below 4, got 4"),
    (lambda: routed().load_cell(0, nn.Linear(7, 4)), ValueError, "module must have the parameters of the routed"),
    (lambda: routed().load_cell(0, other_buffer()), ValueError, "module's bands must equal the router's"),
    (lambda: VoronoiRouter.from_modules([], X[:4, :3]), ValueError, "must hold a module for each cell, got none"),
    (lambda: VoronoiRouter.from_modules([Field()], X[:4, :3]), ValueError, "a module for each of 4 cells, got 1"),
    (
        lambda: VoronoiRouter.from_modules([nn.Linear(7, 2), nn.Linear(7, 3)], X[:2, :3]),
        ValueError,
        r"modules\[1\]: module's weight must have shape \[2, 7\], got \[3, 7\]",
    ),
    (lambda: split([0, 1, 2]), ValueError, r"parents must have shape \[4\], got \[3\]"),
    (lambda: split([0.0, 0, 1, 2]), TypeError, "parents must be int64, got torch.float32"),
    (lambda: split([0, 1, 2, 7]), ValueError, r"parents must lie in 0\.\.2, got 0\.\.7"),
]


@pytest.mark.parametrize(("call", "kind", "says"), [*MODULES, *OPTIONS, *CALLS, *CELLS])
def test_wrong_use_says_what_is_wrong(call: Callable[[], Any], kind: type[Exception], says: str) -> None:
    with pytest.raises(kind, match=says):
        call()


def test_an_error_of_the_field_itself_is_shown(centres: Tensor) -> None:
    def picky(net: Any, x: Tensor) -> Tensor:
        if x.shape[-1] != 3:
            raise KeyError(f"wants three features, not {x.shape[-1]}")
        return F.relu(net.fc(x))

    router = VoronoiRouter(Built(picky, fc=(3, 2)), centres, coords="first3")
    with pytest.raises(KeyError, match="wants three features, not 7"):
        router(X)
