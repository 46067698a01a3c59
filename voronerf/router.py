"""VoronoiRouter: one network per Voronoi cell, evaluated for all cells in one pass.

Letters: n samples, k cells, r rays. Positions are in scene units; index tensors are int32.
"""

from __future__ import annotations

import copy
from typing import Any, Literal, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn

from voronerf.diagram import VoronoiDiagram
from voronerf.layers import MLP
from voronerf.ops import cell_sort, grouped_mlp

Assignment = Literal["nearest", "stochastic"]


@runtime_checkable
class LayeredField(Protocol):
    """A field that describes itself by a layer table, as :class:`voronerf.fields.NeRF` does."""

    layers: MLP

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the table's order."""
        ...

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Turns the table's outputs [n, out] into what the field returns."""
        ...


class VoronoiRouter(nn.Module):
    """k copies of a field, one per cell of a Voronoi diagram, each sample evaluated by the copy of its cell.

    The parameters of all copies are stacked, ``[k, ...]`` under the field's own names below ``module.``, so that an
    optimiser sees as many tensors as for one field, and the networks run as grouped products over samples sorted by
    cell rather than as a loop over modules. A diagram of one cell is the field itself.

    Every cell starts as a copy of the field (inheritance, Adaptive Voronoi NeRFs): positions stay global, so identical
    copies render exactly what the field renders, and no seam appears at the split.

    Args:
        module: A field with a layer table (:class:`LayeredField`); copied, never changed.
        diagram: A VoronoiDiagram, or centres [k, 3].
        assignment: "nearest" evaluates a sample in the cell that holds it. "stochastic" draws the cell from the
            distances while training (:meth:`VoronoiDiagram.sample_cell`), and is "nearest" in eval mode.
        temperature: Of the stochastic assignment, in scene units.
        backend: Of every operation, see ``voronerf info``.

    Raises:
        TypeError: When ``module`` has no layer table.
        ValueError: For bad centres, an unknown assignment or a temperature that is not positive.
    """

    def __init__(
        self,
        module: nn.Module,
        diagram: VoronoiDiagram | Tensor,
        *,
        assignment: Assignment = "nearest",
        temperature: float = 0.05,
        backend: str = "auto",
    ) -> None:
        super().__init__()
        if not isinstance(module, LayeredField):
            raise TypeError(
                "VoronoiRouter: module must describe itself by a layer table (`layers`, `linears()`, `activate()`, "
                f"as voronerf.fields.NeRF does), got {type(module).__name__}"
            )
        if assignment not in ("nearest", "stochastic"):
            raise ValueError(f"VoronoiRouter: assignment must be 'nearest' or 'stochastic', got {assignment!r}")
        if not temperature > 0:
            raise ValueError(f"VoronoiRouter: temperature must be positive, got {temperature}")
        self.diagram = copy.deepcopy(diagram) if isinstance(diagram, VoronoiDiagram) else VoronoiDiagram(diagram)
        self.assignment = assignment
        self.temperature = temperature
        self.backend = backend
        self.generator: torch.Generator | None = None

        self.module = copy.deepcopy(module)
        k = self.diagram.num_cells
        for owner, name, parameter in _owned_parameters(self.module):
            stacked = parameter.detach().expand(k, *parameter.shape).clone()
            owner.register_parameter(name, nn.Parameter(stacked, requires_grad=parameter.requires_grad))

    @property
    def field(self) -> LayeredField:
        """The field whose parameters are stacked; its own ``forward`` is not usable any more."""
        return cast(LayeredField, self.module)

    @property
    def num_cells(self) -> int:
        """Cells of the diagram, networks of the router."""
        return self.diagram.num_cells

    def assign(self, positions: Tensor) -> Tensor:
        """The cell that evaluates each position: positions [n, 3] -> int32 [n]."""
        if self.assignment == "stochastic" and self.training and self.num_cells > 1:
            return self.diagram.sample_cell(positions, temperature=self.temperature, generator=self.generator)
        return self.diagram.locate(positions, backend=self.backend)

    def forward(
        self, positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Evaluates each sample in its cell; the order of the results is the order of the positions.

        Args:
            positions: [n, 3] in scene units.
            directions: Unit vectors, [n, 3], or [r, 3] together with ``ray_index``.
            ray_index: int32 [n], the row of ``directions`` that belongs to each sample.

        Returns:
            What the field's ``activate`` gives: (colour [n, 3], density [n]).

        Raises:
            ValueError: For shapes that disagree, or directions that the field needs and did not get.
        """
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"VoronoiRouter: positions must have shape [n, 3], got {list(positions.shape)}")
        table = self.field.layers
        needs_directions = table.uses_directions
        if needs_directions and directions is None:
            raise ValueError("VoronoiRouter: directions must be given, since the field's colour depends on them")
        if not needs_directions:
            directions = ray_index = None
        if directions is not None and ray_index is None and directions.shape[0] != positions.shape[0]:
            raise ValueError(
                "VoronoiRouter: directions must have a row for each position, or come with ray_index, got "
                f"{directions.shape[0]} rows for {positions.shape[0]} positions"
            )

        linears = self.field.linears()
        weights = [layer.weight for layer in linears]
        biases = [layer.bias for layer in linears]
        if self.num_cells == 1:
            offsets = torch.tensor([0, positions.shape[0]], dtype=torch.int32, device=positions.device)
            order = None
        else:
            order, offsets = cell_sort(self.assign(positions.detach()), self.num_cells, backend=self.backend)
            # Positions are three floats a sample, their encoding sixty-three: permute before encoding.
            positions = positions[order]
            if ray_index is not None:
                ray_index = ray_index[order]
            elif directions is not None:
                directions = directions[order]
        raw = grouped_mlp(
            positions,
            offsets,
            weights,
            biases,
            layers=table,
            directions=directions,
            direction_index=ray_index,
            backend=self.backend,
        )
        if order is not None:
            # index_copy rather than indexing by the inverse order: its backward is a gather, not a scatter-add.
            raw = torch.zeros_like(raw).index_copy(0, order.long(), raw)
        return self.field.activate(raw)

    def cell(self, index: int) -> nn.Module:
        """A plain copy of one cell's field, with parameters of its own.

        Raises:
            IndexError: When there is no such cell.
        """
        if not -self.num_cells <= index < self.num_cells:
            raise IndexError(f"VoronoiRouter.cell: index must be below {self.num_cells}, got {index}")
        module = copy.deepcopy(self.module)
        for owner, name, parameter in _owned_parameters(module):
            single = nn.Parameter(parameter.detach()[index].clone(), requires_grad=parameter.requires_grad)
            owner.register_parameter(name, single)
        return module

    @torch.no_grad()
    def subdivide(
        self,
        diagram: VoronoiDiagram,
        parents: Tensor,
        *,
        optimizer: torch.optim.Optimizer | None = None,
        inherit: bool = True,
    ) -> None:
        """Replaces the diagram by a finer one; every new cell starts where its parent stands.

        Parameters and, with ``optimizer``, every per-parameter state of the parameter's shape (Adam's moments,
        momentum) are copied from the parent. The parameter objects are new; those in the optimiser's groups are
        replaced in place, so groups, learning rates and schedules go on.

        Args:
            diagram: The finer diagram, as :meth:`VoronoiDiagram.refine` returns it.
            parents: int64 [new cells], the present cell that each new cell lies in.
            optimizer: The optimiser that holds this router's parameters.
            inherit: False draws fresh parameters for the children of every cell that is split, with moments of zero:
                the ablation that shows ghosting.

        Raises:
            ValueError: When ``parents`` does not fit, or the field cannot draw fresh parameters.
        """
        if parents.ndim != 1 or parents.shape[0] != diagram.num_cells:
            raise ValueError(
                f"VoronoiRouter.subdivide: parents must have shape [{diagram.num_cells}], got {list(parents.shape)}"
            )
        if parents.dtype != torch.int64:
            raise TypeError(f"VoronoiRouter.subdivide: parents must be int64, got {parents.dtype}")
        if int(parents.min()) < 0 or int(parents.max()) >= self.num_cells:
            raise ValueError(
                f"VoronoiRouter.subdivide: parents must lie in 0..{self.num_cells - 1}, got "
                f"{int(parents.min())}..{int(parents.max())}"
            )
        # Children of a cell that is split; the other cells go on as they were, with or without inheritance.
        new = torch.bincount(parents, minlength=self.num_cells)[parents] > 1
        fresh = None if inherit else self._fresh_parameters(diagram.num_cells)
        replaced: dict[Tensor, nn.Parameter] = {}
        for index, (owner, name, parameter) in enumerate(_owned_parameters(self.module)):
            values = parameter[parents.to(parameter.device)]
            if fresh is not None:
                values[new] = fresh[index][new]
            child = nn.Parameter(values, requires_grad=parameter.requires_grad)
            owner.register_parameter(name, child)
            replaced[parameter] = child
        if optimizer is not None:
            _move_state(optimizer, replaced, parents, None if inherit else new)
        self.diagram = copy.deepcopy(diagram).to(self.diagram.centres.device)

    def _fresh_parameters(self, k: int) -> list[Tensor]:
        """Newly drawn parameters [k, ...] of every parameter of the field, in order."""
        template = self.cell(0)
        reset = getattr(template, "reset_parameters", None)
        if reset is None:
            raise ValueError("VoronoiRouter.subdivide: inherit=False needs a field with reset_parameters()")
        drawn: list[list[Tensor]] = []
        with torch.random.fork_rng(devices=[]):
            if self.generator is not None:
                torch.manual_seed(int(torch.randint(2**62, (), generator=self.generator)))
            for _ in range(k):
                reset()
                drawn.append([p.detach().clone() for _, _, p in _owned_parameters(template)])
        return [torch.stack(values) for values in zip(*drawn, strict=True)]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes over the stored diagram first, so that parameters of any number of cells fit.

        Where the number of cells changes, the parameter objects are new: make the optimiser afterwards.
        """
        if f"{prefix}diagram.centres" in state_dict:
            diagram = VoronoiDiagram.from_state(state_dict, f"{prefix}diagram.")
            if diagram.num_cells == self.num_cells:
                self.diagram = diagram.to(self.diagram.centres.device)
            else:
                self.subdivide(diagram, torch.zeros(diagram.num_cells, dtype=torch.int64))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def extra_repr(self) -> str:
        """What ``print(router)`` shows beside the field's modules."""
        return f"num_cells={self.num_cells}, depth={self.diagram.depth}, assignment={self.assignment!r}"


def _owned_parameters(module: nn.Module) -> list[tuple[nn.Module, str, nn.Parameter]]:
    """(owner, name, parameter) of every parameter of a module tree, in the order of ``named_parameters``."""
    return [
        (owner, name, parameter)
        for owner in module.modules()
        for name, parameter in list(owner._parameters.items())
        if parameter is not None
    ]


def _move_state(
    optimizer: torch.optim.Optimizer, replaced: dict[Tensor, nn.Parameter], parents: Tensor, fresh: Tensor | None
) -> None:
    """Puts the new parameters in the place of the old in an optimiser, their state copied from the parent cell.

    The state of the cells that the mask ``fresh`` names is zero instead.
    """
    for group in optimizer.param_groups:
        group["params"] = [replaced.get(parameter, parameter) for parameter in group["params"]]
    for old, new in replaced.items():
        state = optimizer.state.pop(old, None)
        if state is None:
            continue
        for key, value in state.items():
            moved = copy.deepcopy(value)
            if isinstance(value, Tensor) and value.shape == old.shape:
                moved = value[parents.to(value.device)]
                if fresh is not None:
                    moved[fresh] = 0
            optimizer.state[new][key] = moved
