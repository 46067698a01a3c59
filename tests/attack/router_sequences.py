"""Compares random calls of a changing router with a loop over masks, which runs a plain module per cell."""

from __future__ import annotations

import copy
import io
import math
import random
import sys
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.nn.functional as F
from attempts import RIGHT, Failed
from torch import Tensor, nn
from torch.func import functional_call, grad
from torch.nn.utils.parametrizations import weight_norm
from torch.utils._pytree import tree_structure
from torch.utils.checkpoint import checkpoint

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.router import dispatch

sys.path += [str(Path(__file__).parents[1] / "router"), str(Path(__file__).parents[2] / "benchmarks")]
from ops.foreign_fields import Heads, LearnedSine, skip_net
from router_loop import tensors

WAYS = ("fused", "grouped", "loop")
#: The numbers of samples in a call, to choose from.
SAMPLES = (0, 1, 1, 2, 7, 8, 41, 300)
MOST_CELLS = 12
MANY_CELLS = 2048  # from this number on, a diagram keeps an index of its centres
LIBRARY = str(Path(dispatch.__file__).parents[1])


class Changing(nn.Module):
    """A module that reads attributes and buffers, which change between calls."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 8), nn.Linear(8, 4)
        self.gain, self.level, self.doubled, self.bands = 1.0, 1, False, [1.0, 2.0]
        self.register_buffer("scale", torch.ones(8))

    def forward(self, x: Tensor, d: Tensor | None = None) -> Any:
        h = torch.tanh(self.a(x)) * self.scale * self.gain
        for _ in range(self.level):
            h = h + torch.sin(h * self.bands[-1])
        if self.training:
            h = h * 0.5
        y = self.b(h)
        y = y * 2 if self.doubled else y
        return {"density": F.softplus(y[..., :1]), "colour": [torch.sigmoid(y[..., 1:])]}

    def change(self, rng: random.Random) -> None:
        """Sets an attribute, writes into the buffer, or replaces a layer."""
        name = rng.choice(("gain", "level", "doubled", "bands", "scale", "part"))
        if name == "scale":
            self.scale.mul_(rng.uniform(0.8, 1.2))
        elif name == "part":
            self.b = copy.deepcopy(self.b)
        else:
            values = {"gain": rng.random(), "level": rng.randrange(3), "doubled": rng.random() < 0.5}
            setattr(self, name, values.get(name, [rng.random(), rng.random()]))


class Normed(nn.Module):
    """A module with layer norms and RMS norms, with and without weights."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.norm, self.rms = nn.Linear(3, 8), nn.Linear(8, 4), nn.LayerNorm(8), nn.RMSNorm(8)

    def forward(self, x: Tensor) -> Tensor:
        return self.b(F.layer_norm(torch.tanh(self.rms(self.norm(self.a(x)))), (8,)))


class Looked(nn.Module):
    """A module with an embedding table and layers."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self.out = nn.Embedding(16, 4), nn.Sequential(nn.Linear(7, 8), nn.SiLU(), nn.Linear(8, 3))

    def forward(self, x: Tensor) -> Tensor:
        row = (x[..., 0].detach() * 15).long().clamp(0, 15)
        return self.out(torch.cat([x, self.table(row) * self.table(15 - row)], -1))


class Split(nn.Module):
    """A module that splits tensors, computes with the pieces and returns some of them."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(6, 8), nn.Linear(4, 4)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        position, direction = x.split([3, 3], -1)
        left, right = torch.tanh(self.a(torch.cat([direction, position], -1))).chunk(2, -1)
        colour, density = self.b(left * right).tensor_split([3], -1)
        return colour, density.exp(), list(left.unbind(-1)[:2])


class OfRays(nn.Module):
    """A module that reads samples and the directions of their rays."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 8), nn.Linear(11, 4)

    def forward(self, x: Tensor, d: Tensor) -> Tensor:
        d = d[:, None] if d.dim() < x.dim() else d
        return self.b(torch.cat([F.softplus(self.a(x)), d.expand(*x.shape[:-1], 3)], -1))


class Custom(nn.Module):
    """A module with a custom autograd function, and an encoder that cells may share."""

    class Exp(torch.autograd.Function):
        @staticmethod
        def forward(x: Tensor) -> Tensor:
            return x.exp()

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
            ctx.save_for_backward(*inputs)

        @staticmethod
        def backward(ctx: Any, gradient: Tensor) -> Tensor:
            return gradient * ctx.saved_tensors[0].clamp(max=5).exp()

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.out = nn.Sequential(nn.Linear(3, 8), nn.Tanh()), nn.Linear(8, 4)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        y = self.out(self.encoder(x))
        return self.Exp.apply(y[..., 0]), y[..., 1:]


class Again(nn.Module):
    """A module with an activation checkpoint inside."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Sequential(nn.Linear(3, 8), nn.LayerNorm(8), nn.Tanh()), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.b(checkpoint(self.a, x, use_reentrant=False))


@dataclass(frozen=True)
class Kind:
    """A field, and the options of its router.

    Attributes:
        make: A function that makes the field.
        features: The number of columns of each argument.
        share: A pattern of parameter names that cells may share.
        methods: Additional methods, which take the first argument.
        twice: Whether second derivatives are compared; a custom function may have none.
        plain: Whether the field has no checkpoint inside, so that transforms and checkpoints accept it.
        per_ray: Whether the last argument may have one row per ray.
        leads: Whether samples may have several leading dimensions, and be tensors of inference mode in training.
    """

    make: Callable[[], nn.Module]
    features: tuple[int, ...] = (3,)
    share: str = ""
    methods: tuple[str, ...] = ()
    twice: bool = True
    plain: bool = True
    per_ray: bool = False
    leads: bool = True


def layers() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 8), nn.ReLU(), nn.Linear(8, 4))


def radiance() -> nn.Module:
    return NeRF(width=8, depth=2, view_directions=False)


def weights_of_functions() -> nn.Module:
    return nn.Sequential(weight_norm(nn.Linear(3, 8)), nn.Tanh(), nn.Linear(8, 4))


KINDS = {
    "layers": Kind(layers, share="0.*"),
    "skips": Kind(skip_net, (15,)),
    "sines": Kind(LearnedSine, share="frequency"),
    "heads": Kind(Heads, (3, 3), methods=("density",)),
    "density": Kind(Heads),
    "changing": Kind(Changing),
    "norms": Kind(Normed, share="norm.*"),
    "tables": Kind(Looked, share="table.*"),
    "pieces": Kind(Split, (6,)),
    "rays": Kind(OfRays, (3, 3), per_ray=True),
    "weight norm": Kind(weights_of_functions),
    "custom": Kind(Custom, share="encoder.*", twice=False),
    "program": Kind(radiance, leads=False),
    "checkpoint": Kind(Again, twice=False, plain=False),
}


def random_sequence(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Draws a router and a sequence of calls and changes; compares each call with the loop over masks."""
    sequence = Sequence(rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for _ in range(rng.randrange(10, 31)):
                sequence.step()
        except Exception as error:
            kind = "" if isinstance(error, Failed) else f"{type(error).__name__}: "
            raise Failed(f"{kind}{error}\n    {'; '.join(sequence.events)}") from error
    return RIGHT


class Sequence:
    """A router, and a record of its calls and changes."""

    def __init__(self, rng: random.Random) -> None:
        self.rng, name = rng, rng.choice(list(KINDS))
        self.kind, self.dtype = KINDS[name], torch.float32
        options: dict[str, Any] = {
            "fuse": self.kind.plain and rng.random() < 0.6,
            "way": rng.choice(("fused", *WAYS)),
            "layout": rng.choice(("rays", "rays", "flat")),
            "share": [self.kind.share] if self.kind.share and rng.random() < 0.3 else [],
            "methods": self.kind.methods,
        }
        k = MANY_CELLS if rng.random() < 0.2 else rng.randrange(1, 7)
        self.router = VoronoiRouter(self.kind.make(), torch.rand(k, 3), coords="first3", **options)
        self.events = [f"{name} in {self.router.num_cells} cells, {options}"]
        self.forms = [rng.random() for _ in range(3)]  # seeds of calls that differ only in their samples
        self.differ()
        self.states = [copy.deepcopy(self.router.state_dict())]
        if rng.random() < 0.3:
            self.interrupted()
        elif rng.random() < 0.3:
            self.together()

    def interrupted(self) -> None:
        """Raises KeyboardInterrupt in the first call, at a random line of the library."""
        left = int(10 ** self.rng.uniform(0, 4))
        self.events.append(f"interrupted at line {left}")

        def trace(frame: FrameType, event: str, value: Any) -> Any:
            nonlocal left
            if not frame.f_code.co_filename.startswith(LIBRARY):
                return None
            left -= event == "line"
            if not left:
                raise KeyboardInterrupt
            return trace

        _, args = self.arguments((41,), self.rng)
        sys.settrace(trace)
        try:
            ask(self)
            self.router(*args)
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(None)

    def together(self) -> None:
        """Makes the first calls in three threads at the same time, and compares their results."""
        self.events.append("three threads")
        start, faults, old = threading.Barrier(3), list[Exception](), sys.getswitchinterval()

        def run(flat: list[Tensor], args: list[Tensor]) -> None:
            try:
                start.wait(20)
                ask(self)
                for _ in range(2):
                    found = self._tensors(self.router(*args), "forward", (41,))
                    self._compare("value of a thread", found, self._expected("forward", flat)[0])
            except Exception as error:
                faults.append(error)

        threads = [threading.Thread(target=run, args=self.arguments((41,), self.rng)) for _ in range(3)]
        sys.setswitchinterval(1e-6)
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        sys.setswitchinterval(old)
        if faults:
            raise faults[0]

    def step(self) -> None:
        """Calls the router or changes it."""
        if self.rng.random() < 0.6:
            self.call()
        else:
            change = self.rng.choice(CHANGES)
            if isinstance(self.router.module, Changing) and self.rng.random() < 0.5:
                change = attribute
            inside = change in INSIDE and self.rng.random() < 0.3
            self.events.append(f"{change.__name__}{' in inference mode' * inside}")
            with torch.inference_mode(inside):
                change(self)

    def differ(self) -> None:
        """Adds different noise to the parameters of each cell."""
        with torch.no_grad():
            for parameter in self.router.parameters():
                parameter += 0.2 * torch.randn_like(parameter)

    def call(self) -> None:
        """Compares a call and its gradients with the loop over masks."""
        rng, router, kind = random.Random(self.rng.choice(self.forms)), self.router, self.kind
        lead = self._lead(rng)
        way = rng.choice(("plain", "plain", "no_grad", "inference", "checkpoint", "func", "twice"))
        if (way in ("func", "checkpoint") and not kind.plain) or (way == "twice" and not kind.twice):
            way = "plain"
        flat, args = self.arguments(lead, rng)
        method = rng.choice(("forward", *router.methods))
        flat, args = (flat[:1], args[:1]) if method != "forward" else (flat, args)
        x = args[0].requires_grad_(way in ("func", "twice") or rng.random() < 0.5)
        if way == "plain" and not x.requires_grad and kind.leads and rng.random() < 0.3:
            way = "of inference mode"
            with torch.inference_mode():
                args = [a.clone() for a in args]
        self.events.append(f"{method} {way} of {[list(a.shape) for a in args]} {'x' * x.requires_grad}")
        run = getattr(router, method)
        if not len(flat[0]):
            self._tensors(run(*args), method, lead)
            return
        leaf = flat[0].clone().requires_grad_(x.requires_grad)
        expected, modules = self._expected(method, [leaf, *flat[1:]])
        if way in ("no_grad", "inference"):
            with torch.no_grad() if way == "no_grad" else torch.inference_mode():
                found = self._tensors(run(*args), method, lead)
            if any(t.requires_grad for t in found):
                raise Failed("a result has a gradient")
            self._compare("value", found, expected)
            return

        weights = [torch.randn_like(e) for e in expected]
        parameters = {name: p for name, p in router.named_parameters() if p.requires_grad}

        def loss(results: list[Tensor], x: Tensor) -> Tensor:
            total = torch.stack([(r.reshape(w.shape) * w).sum() for r, w in zip(results, weights, strict=True)]).sum()
            if way == "twice" and total.requires_grad:
                (slope,) = torch.autograd.grad(total, x, create_graph=True, materialize_grads=True)
                total = total + slope.square().sum()
            return total

        def transformed(x: Tensor, parameters: dict[str, Tensor]) -> Tensor:
            if method != "forward":
                return loss(tensors(run(x, *args[1:])), x)
            return loss(tensors(functional_call(router, parameters, (x, *args[1:]))), x)

        if way == "func" and method == "forward":
            by_x, by_name = grad(transformed, argnums=(0, 1))(x.detach(), parameters)
            gradients = [by_x, *by_name.values()]
        elif way == "func":
            parameters, gradients = {}, [grad(transformed)(x.detach(), parameters)]
        else:
            result = checkpoint(run, *args, use_reentrant=False) if way == "checkpoint" else run(*args)
            found = self._tensors(result, method, lead)
            self._compare("value", found, expected)
            gradients = self._gradients(loss(found, x), [*[x] * x.requires_grad, *parameters.values()])

        leaves = [module.get_parameter(name[7:]) for name in parameters for module in modules.values()]
        wanted = self._gradients(loss(expected, leaf), [*[leaf] * leaf.requires_grad, *leaves])
        first, rest = wanted[: leaf.requires_grad], wanted[leaf.requires_grad :]
        for i, parameter in enumerate(parameters.values()):
            rows = torch.stack(rest[i * len(modules) : (i + 1) * len(modules)])
            is_shared = parameter.shape == rows.shape[1:]
            number = torch.tensor([*modules])
            first.append(rows.sum(0) if is_shared else torch.zeros_like(parameter).index_copy(0, number, rows))
        self._compare("gradient", gradients, first)

    def _gradients(self, total: Tensor, leaves: list[Tensor]) -> list[Tensor]:
        if not total.requires_grad or not leaves:
            return [torch.zeros_like(leaf) for leaf in leaves]
        return list(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))

    def _lead(self, rng: random.Random) -> tuple[int, ...]:
        n = self.rng.choice(SAMPLES)
        if not self.kind.leads:
            return (n,)
        lead = rng.choice([(n,), (n,), (n, 1), (1, n), (n // 2, 2) if n in (0, 8, 300) else (n,)])
        return lead if len(lead) == 1 or lead[0] != lead[1] or lead == (1, 1) else (n,)

    def arguments(self, lead: tuple[int, ...], rng: random.Random) -> tuple[list[Tensor], list[Tensor]]:
        """Returns the arguments twice: with one row per sample, and in the shapes for the router."""
        n = math.prod(lead)
        flat = [torch.rand(n, f, dtype=self.dtype) for f in self.kind.features]
        args = [a.reshape(*lead, a.shape[1]) for a in flat]
        if self.kind.per_ray and n and rng.random() < 0.4:
            if len(lead) == 1:  # one row for all samples
                args[1] = args[1][:1].clone()
                flat[1] = args[1].expand(n, -1)
            elif self.router.layout == "rays":
                args[1] = args[1][:, 0].clone()
                flat[1] = args[1].repeat_interleave(lead[1], 0)
        return flat, args

    @torch.no_grad()
    def _tensors(self, result: Any, method: str, lead: tuple[int, ...]) -> list[Tensor]:
        """Checks that a result has the module's structure and shapes; returns its tensors."""
        some = [torch.rand(2, f, dtype=self.dtype) for f in self.kind.features]
        plain = getattr(self.router.cell(0), method)(*(some if method == "forward" else some[:1]))
        shapes = [(*lead, *tensor.shape[1:]) for tensor in tensors(plain)]
        if tree_structure(result) != tree_structure(plain) or [tuple(t.shape) for t in tensors(result)] != shapes:
            raise Failed(f"{method} gives {result}, not {tree_structure(plain)} of {shapes}")
        return tensors(result)

    def _expected(self, method: str, flat: list[Tensor]) -> tuple[list[Tensor], dict[int, nn.Module]]:
        """Returns the results of the loop over masks, and the modules by cell; frozen cells have no gradient.

        Cells are found without the library.
        """
        router, results, x = self.router, list[Tensor](), flat[0][:, :3].detach().double()
        if router.diagram.depth > 1 or router.num_cells < MANY_CELLS:
            cells = router.assign(flat[0][:, :3].detach())
        else:
            cells = torch.cdist(x, router.diagram.centres.double()).argmin(1)
        frozen, modules = router.frozen, {i: router.cell(i) for i in cells.unique().tolist()}
        for i, module in modules.items():
            rows = (cells == i).nonzero()[:, 0]
            parts = tensors(getattr(module, method)(*[a[rows] for a in flat]))
            parts = [part.detach() for part in parts] if frozen[i] else parts
            results = results or [part.new_zeros(len(cells), *part.shape[1:]) for part in parts]
            results = [whole.index_copy(0, rows, part) for whole, part in zip(results, parts, strict=True)]
        return results, modules

    def _compare(self, what: str, found: list[Tensor], expected: list[Tensor]) -> None:
        """Raises Failed if tensors differ by more than rounding."""
        for number, (ours, theirs) in enumerate(zip(found, expected, strict=True)):
            ours, theirs = ours.detach().clone().reshape(theirs.shape), theirs.detach()
            if ours.dtype != theirs.dtype:
                raise Failed(f"{what} {number} is {ours.dtype}, not {theirs.dtype}")
            far, size = (float(t.abs().max()) if t.numel() else 0.0 for t in (ours - theirs, theirs))
            if not far <= 1e-3 * size + 1e-5:
                raise Failed(f"{what} {number} differs by {far:.3g} of {size:.3g}; {self.router.explain()}")


# Changes of the router


def mode(s: Sequence) -> None:
    s.router.train(s.rng.random() < 0.5)


def freeze(s: Sequence) -> None:
    s.router.freeze(s.rng.sample(range(s.router.num_cells), s.rng.randrange(s.router.num_cells + 1)))


def unfreeze(s: Sequence) -> None:
    s.router.unfreeze()


def subdivide(s: Sequence) -> None:
    if s.router.num_cells * 2 <= MOST_CELLS:
        points = torch.rand(200, 3, dtype=s.router.diagram.centres.dtype)
        s.router.subdivide(2, min_samples=2, points=points)
        s.differ()
    elif s.router.num_cells == MANY_CELLS and s.router.diagram.depth == 1:
        s.router.subdivide(VoronoiDiagram(torch.cat([s.router.diagram.centres, torch.rand(9, 3)])))


def save(s: Sequence) -> None:
    s.states.append(copy.deepcopy(s.router.state_dict()))


def load(s: Sequence) -> None:
    s.router.load_state_dict(s.rng.choice(s.states))


def ask(s: Sequence) -> None:
    s.router.program(*s.arguments((41,), s.rng)[1], trace=s.rng.random() < 0.5)


def data(s: Sequence) -> None:
    s.router.unfreeze()  # writing to frozen cells is an error
    parameter = s.rng.choice(list(s.router.parameters()))
    parameter.data = parameter.data * 0.9


def written(s: Sequence) -> None:
    """Writes past the version counter into a buffer, such as the centres."""
    buffer = s.rng.choice([b for b in s.router.buffers() if b.is_floating_point()])
    buffer.data.mul_(s.rng.uniform(0.7, 1.3))


def inplace(s: Sequence) -> None:
    s.router.unfreeze()
    s.differ()


def attribute(s: Sequence) -> None:
    if isinstance(s.router.module, Changing):
        s.router.module.change(s.rng)


def copied(s: Sequence) -> None:
    s.router = copy.deepcopy(s.router)


def stored(s: Sequence) -> None:
    if "parametrizations" in str(s.router):  # torch cannot store them
        return
    held = io.BytesIO()
    torch.save(s.router, held)
    held.seek(0)
    s.router = torch.load(held, weights_only=False)


def dtype(s: Sequence) -> None:
    if s.router.num_cells >= MANY_CELLS:  # torch.func keeps a gradient of all cells for each cell of a reference
        return
    s.dtype = torch.float64 if s.dtype == torch.float32 else torch.float32
    s.router.to(s.dtype)


def halves(s: Sequence) -> None:
    s.router.bfloat16().to(s.dtype)


def requires(s: Sequence) -> None:
    parameter = s.rng.choice(list(s.router.parameters()))
    parameter.requires_grad_(not parameter.requires_grad)


def learn(s: Sequence) -> None:
    s.router.unfreeze()
    optimizer = torch.optim.SGD(s.router.parameters(), 1e-3)
    total = torch.stack([t.square().mean() for t in tensors(s.router(*s.arguments((41,), s.rng)[1]))]).sum()
    if total.requires_grad:
        total.backward()
    optimizer.step()
    optimizer.zero_grad()


def cell(s: Sequence) -> None:
    i = s.rng.randrange(s.router.num_cells)
    s.router.load_cell(i, s.router.cell(s.rng.randrange(s.router.num_cells)))


def options(s: Sequence) -> None:
    s.router.way = s.rng.choice(WAYS)


CHANGES = (
    *(mode, freeze, unfreeze, subdivide, save, load, data, written, inplace, attribute, attribute, copied, stored),
    *(dtype, halves, requires, learn, cell, ask, options),
)
#: Changes that may happen in inference mode; others make tensors by torch alone, which would be inference tensors.
INSIDE = {mode, freeze, unfreeze, subdivide, save, load, written, inplace, copied, cell, ask, options}
