"""Cases of VoronoiRouter around fields of other codebases (``foreign_fields.py``). n samples, k cells.

The main contender of a row is the router with ``fuse=True``. Its alternatives are the router with ``way="grouped"``,
the loop over boolean masks with a module per cell, and one module for all samples. Results and gradients are compared
with the loop over masks. The loop also uses the library's cell lookup.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from ops import foreign_fields as fields
from ops.case import BACKWARD, FORWARD, Case, Contender, NotApplicable, Work, generator, relative_error, uniform_points
from ops.foreign_rows import share, shared_names
from voronerf import VoronoiRouter, ops

Arguments = tuple[Tensor, ...]
Call = Callable[..., Tensor]
TOLERANCE = 1e-2
"""Largest error against the loop over masks. Gradients change by some per mille if rounding switches a ReLU unit."""
SIZES = (1 << 10, 1 << 16)
"""The numbers of samples."""


def positions(x: Tensor) -> Arguments:
    """Returns the positions alone."""
    return (x,)


def encoded(x: Tensor) -> Arguments:
    """Returns encoded positions and directions, concatenated as nerf-pytorch does."""
    return (torch.cat([fields.frequencies(x, 10), fields.frequencies(_directions(x), 4)], -1),)


def with_image(x: Tensor) -> Arguments:
    """Returns positions, directions and the image number of each sample, concatenated as Mega-NeRF does."""
    return (torch.cat([x, _directions(x), torch.arange(len(x))[:, None] // 64 % 100], 1),)


def with_directions(x: Tensor) -> Arguments:
    """Returns positions and directions."""
    return x, _directions(x)


def _directions(x: Tensor) -> Tensor:
    return nn.functional.normalize(torch.randn(x.shape, generator=generator(3)), dim=1)


def values(call: Call, arguments: Arguments) -> list[Tensor]:
    """Evaluates the field."""
    return [call(*arguments)]


def normals(call: Call, arguments: Arguments) -> list[Tensor]:
    """Returns signed distances and their gradients, the inputs of an eikonal loss."""
    x = arguments[0].detach().requires_grad_()
    with torch.enable_grad():
        distance = call(x)
        (normal,) = torch.autograd.grad(distance.sum(), x, create_graph=True)
    return [distance, normal]


def laplacian(call: Call, arguments: Arguments) -> list[Tensor]:
    """Returns the Laplacian of the first output."""
    x = arguments[0].detach().requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(call(x)[:, 0].sum(), x, create_graph=True)
        rows = [torch.autograd.grad(slope[:, i].sum(), x, create_graph=True)[0][:, i] for i in range(3)]
    return [torch.stack(rows).sum(0)]


@dataclass(frozen=True)
class Field:
    """A field and the settings of its rows.

    Attributes:
        make: A function that makes a new module.
        arguments: A function: positions [n, 3] -> arguments of the module's forward.
        evaluate: A function of the module and its arguments that returns the compared results.
        most_cells: The largest number of cells, since the tables of more cells do not fit into memory.
        share: Patterns of the names of the parameters that all cells share. The module's method ``encode`` uses only
            these parameters; its method ``decode`` uses the other ones.
    """

    make: Callable[[], nn.Module]
    arguments: Callable[[Tensor], Arguments] = positions
    evaluate: Callable[[Call, Arguments], list[Tensor]] = values
    most_cells: int = 256
    share: tuple[str, ...] = ()


FIELDS = {
    "nerf-pytorch w64": Field(fields.nerf, encoded),
    "nerf-pytorch w256": Field(functools.partial(fields.nerf, 256), encoded, most_cells=16),
    "appearance": Field(fields.mega_nerf, with_image),
    "nerfacc": Field(fields.VanillaField, with_directions),
    "siren": Field(fields.Siren),
    "siren laplacian": Field(fields.Siren, evaluate=laplacian),
    "sdf eikonal": Field(fields.SignedDistance, evaluate=normals),
    "isdf": Field(functools.partial(fields.SignedDistance, 256), evaluate=normals, most_cells=16),
    "nerfacto table": Field(fields.HashTable),
    "hashnerf 2^14": Field(fields.HashEmbedder),
    "hashnerf 2^19": Field(functools.partial(fields.HashEmbedder, 1 << 19, 4), most_cells=16),
    "tensorf": Field(fields.TensorField),
    "k-planes": Field(fields.KPlanes),
    "kan": Field(fields.KAN),
    "silu": Field(lambda: fields.Activated(nn.SiLU())),
    "leaky relu": Field(lambda: fields.Activated(nn.LeakyReLU(0.2))),
    "tanh": Field(lambda: fields.Activated(nn.Tanh())),
    "gelu": Field(lambda: fields.Activated(nn.GELU())),
    "elu": Field(lambda: fields.Activated(nn.ELU())),
    "softplus w256": Field(lambda: fields.Activated(nn.Softplus(100), 256), most_cells=16),
    "d-nerf": Field(fields.DNeRF),
    "bacon": Field(fields.Bacon),
    "film": Field(fields.FiLM),
    "layer norm": Field(fields.Normed),
    "torch-ngp shared": Field(fields.NeRFNetwork, with_directions, most_cells=16, share=("encoder.*",)),
    "nerfacto shared": Field(fields.HashTable, most_cells=16, share=("hash_table",)),
    "hashnerf shared": Field(fields.HashEmbedder, most_cells=16, share=("embeddings.*",)),
    "tensorf shared": Field(fields.TensorField, most_cells=16, share=("plane.*", "line.*")),
    "k-planes shared": Field(fields.KPlanes, most_cells=16, share=("grids.*",)),
}


def cases() -> list[Case]:
    """Returns a case for each field, number of samples and cells, and direction, all on one thread."""
    rows = []
    for (name, field), n, k, direction in itertools.product(FIELDS.items(), SIZES, (16, 256), (FORWARD, BACKWARD)):
        if k <= field.most_cells:
            work = functools.partial(foreign_work, field, n, k, direction)
            label, quick = f"{name} n={n} k={k} threads=1", (n, k, direction) == (SIZES[0], 16, BACKWARD)
            options: dict[str, Any] = {"quick": quick, "threads": 1, "needs": "grouped_linear"}
            rows.append(Case("foreign", label, torch.float32, direction, n, k, work, **options))
    return rows


class Batch:
    """The modules, samples and gradients of a case, and the result of the loop over masks for the first samples.

    Args:
        field: The field.
        n: The number of samples.
        k: The number of cells.
        direction: ``FORWARD`` or ``BACKWARD``.
    """

    def __init__(self, field: Field, n: int, k: int, direction: str) -> None:
        self.field, self.n, self.k, self.training = field, n, k, direction == BACKWARD
        with torch.random.fork_rng():
            torch.manual_seed(0)
            first = field.make()
            shared, names = shared_names(first, field.share), [name for name, _ in first.named_parameters()]
            self.modules = [first, *[share(field.make(), first, shared) for _ in range(k - 1)]]
        self.leaves = [[m.get_parameter(name) for m in self.modules[: 1 if name in shared else k]] for name in names]
        self.centres = uniform_points(k, 1000, torch.device("cpu"))
        points = [uniform_points(n, seed, torch.device("cpu")) for seed in range(2)]
        self.arguments = [field.arguments(x) for x in points]
        self.gradients: list[Tensor] = []
        self.expected: list[Tensor] = []

    def step(self, call: Call, parameters: Sequence[Tensor], number: int) -> list[Tensor]:
        """Returns the results of call ``number`` and, with backward, the gradients of the parameters."""
        arguments = self.arguments[number % 2]
        if not self.training:
            with torch.no_grad():
                return self.field.evaluate(call, arguments)
        results = self.field.evaluate(call, arguments)
        if not self.gradients:
            self.gradients = [torch.randn(result.shape, generator=generator(5)) for result in results]
        found = torch.autograd.grad(results, parameters, self.gradients, allow_unused=True)
        return [
            *[result.detach() for result in results],
            *[torch.zeros_like(p) if g is None else g for p, g in zip(parameters, found)],
        ]

    def stacked(self, found: list[Tensor]) -> list[Tensor]:
        """Returns results and gradients; gradients of parameters that cells do not share are stacked to [k, ...]."""
        if not self.training:
            return found
        counts = [len(leaves) for leaves in self.leaves]
        split = len(found) - sum(counts)
        results, gradients = found[:split], iter(found[split:])
        parts = [list(itertools.islice(gradients, count)) for count in counts]
        return [*results, *[part[0] if len(part) < self.k else torch.stack(part) for part in parts]]

    def masks(self, encoded: bool = False) -> Contender:
        """Returns the usual loop over masks: each cell's module runs on its samples, whose results are scattered back.

        With ``encoded``, an encoding shared by all cells is computed for all samples at once, before the loop.
        """
        parameters = [leaf for leaves in self.leaves for leaf in leaves]
        calls: Sequence[Call] = self.modules
        if encoded and not self.field.share:
            raise NotApplicable("cells do not share an encoding")
        if encoded:
            calls = [cast(Call, module.decode) for module in self.modules]

        def call(*arguments: Tensor) -> Tensor:
            cells = ops.nearest_centre(arguments[0][:, :3].detach().contiguous(), self.centres)
            if encoded:
                arguments = cast(Call, self.modules[0].encode)(arguments[0]), *arguments[1:]
            parts, rows = [], []
            for cell, module in enumerate(calls):
                mask = cells == cell
                if mask.any():
                    rows.append(mask.nonzero()[:, 0])
                    parts.append(module(*[argument[mask] for argument in arguments]))
            together = torch.cat(parts)
            return torch.empty_like(together).index_copy(0, torch.cat(rows), together)

        return Contender(lambda number: self.step(call, parameters, number), self.stacked)

    def routed(self, **options: Any) -> Contender:
        """Returns the router."""
        router = VoronoiRouter.from_modules(
            self.modules, self.centres, coords="first3", share=self.field.share, **options
        )
        parameters = list(router.parameters())
        return Contender(lambda number: self.step(router, parameters, number))

    def single(self) -> Contender:
        """Returns a single module without cells; its results differ, so only its time counts."""
        module = self.modules[0]
        parameters = list(module.parameters())
        return Contender(lambda number: self.step(module, parameters, number), lambda _: [])

    def error(self, found: list[Tensor]) -> float:
        """Returns the largest difference from the loop over masks, relative to the largest entry of each tensor."""
        if not self.expected:
            contender = self.masks()
            self.expected = contender.adapt(contender.run(0))
        return max((relative_error(a, b) for a, b in zip(found, self.expected)), default=0.0)


def foreign_work(field: Field, n: int, k: int, direction: str, device: torch.device) -> Work:
    """Builds the case of a field.

    Raises:
        NotApplicable: The device is not the CPU.
    """
    if device.type != "cpu":
        raise NotApplicable("measured on the CPU")
    batch = Batch(field, n, k, direction)
    return Work(
        ours=lambda backend: batch.routed(fuse=True, backend=backend),
        alternatives={
            "grouped": lambda: batch.routed(way="grouped"),
            "masks": batch.masks,
            "masks behind one encoding": lambda: batch.masks(encoded=True),
            "one module": batch.single,
        },
        error=batch.error,
        tolerance=TOLERANCE,
        amount=float(n),
        bound="",
    )
