"""A module for each cell: stacked parameters, cells taken out and put in, splits, states of any number of cells.

Parameters stay the same objects when cells are split or loaded, and get another shape, [k, ...]. The state that an
optimiser has for them must have that shape too: it follows, or the optimiser says at its next step what to write.
"""

from __future__ import annotations

import copy
import warnings
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_pre_hook

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import finer_diagram
from voronerf.router.parameters import (
    cell_parameters,
    clone_module,
    detach_results,
    draw_parameters,
    fill_cell,
    inherit_parameters,
    stack_parameters,
    take_cell,
)

_OP = "VoronoiRouter"
_ELEMENTWISE = "Adam AdamW RAdam NAdam Adamax SGD RMSprop Adagrad Adadelta Rprop ASGD"
_ELEMENTWISE_OPTIMIZERS = tuple(getattr(torch.optim, name) for name in _ELEMENTWISE.split())
"""Optimisers whose state is of the parameter's shape, entry by entry, or a number."""


class CellModules(nn.Module):
    """k modules, one for each cell of a diagram, as one module with stacked parameters.

    Args:
        module: Copied, never changed.
        diagram: Of k cells.
        share: Names of parameters that all cells have in common, as patterns.
    """

    def __init__(self, module: nn.Module, diagram: VoronoiDiagram, share: Sequence[str]) -> None:
        super().__init__()
        self.diagram = diagram
        first = next(module.parameters(), None)
        if first is not None and not first.is_meta:
            self.diagram.to(first.device)
        self.generator: torch.Generator | None = None
        self.backend = "auto"
        self.share = tuple(share)
        self._watch: Any = None  # of optimisers that hold the state of other cells
        self.module: nn.Module = clone_module(module)
        stack_parameters(self.module, self.diagram.num_cells, self.share)

    @property
    def num_cells(self) -> int:
        """Cells of the diagram, networks of the router."""
        return self.diagram.num_cells

    def _forget_assignments(self) -> None:
        """Called after a change of the diagram."""

    def cell(self, index: int) -> nn.Module:
        """A plain copy of one cell's module, with parameters of its own.

        Raises:
            IndexError: If there is no such cell.
        """
        return take_cell(self.module, self._check_index("cell", index))

    def load_cell(self, index: int, module: nn.Module) -> None:
        """Copies the parameters of a plain module into one cell. Parameter objects and optimisers stay the same.

        Raises:
            IndexError: If there is no such cell.
            ValueError: For parameters of other names or shapes, or buffers that differ from those shared by the cells.
        """
        fill_cell(self.module, self._check_index("load_cell", index), module, "VoronoiRouter.load_cell")

    def _check_index(self, method: str, index: int) -> int:
        if not -self.num_cells <= index < self.num_cells:
            raise IndexError(f"VoronoiRouter.{method}: index must be below {self.num_cells}, got {index}")
        return index

    @torch.no_grad()
    def subdivide(
        self,
        diagram: VoronoiDiagram | int,
        parents: Tensor | None = None,
        *,
        optimizer: torch.optim.Optimizer | None = None,
        inherit: bool = True,
        points: Tensor | None = None,
        weights: Tensor | None = None,
        **split: Any,
    ) -> Tensor:
        """Replaces the diagram by a finer one; every new cell starts as a copy of its parent.

        Parameters are copied from the parent and, with ``optimizer``, so is the state of Adam, AdamW, RAdam, SGD and
        similar optimisers; others start afresh, with a warning. The parameter objects stay the same, so groups,
        learning rates and schedules continue. A wrapper with parameters of its own, such as
        ``DistributedDataParallel``, has to be made again.

        Args:
            diagram: The finer diagram, as :meth:`VoronoiDiagram.refine` returns it, or the number of children that
                :func:`voronerf.split_diagram` gives each cell that has enough samples.
            parents: int64 [new cells], the present cell that each new cell lies in; None for the cell that holds the
                new centre.
            optimizer: The optimiser that holds this router's parameters.
            inherit: False draws new parameters for the children of every cell that is split, with moments of zero: the
                ablation that shows ghosting.
            points: [m, 3], samples in scene units, if ``diagram`` is a number of children.
            weights: [m], the importance of the samples, by which the new cells are balanced.
            **split: Further options of ``split_diagram``, such as cells, centres, min_samples.

        Returns:
            int64 [new cells], the parents.

        Raises:
            ValueError: If ``parents`` does not fit, ``points`` or ``weights`` are missing, or the module cannot draw
                new parameters.
            TypeError: If ``diagram`` is neither a diagram nor a number, or ``parents`` are not int64.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 1), torch.zeros(1, 3), coords="first3")
            >>> optimizer = torch.optim.Adam(router.parameters())
            >>> points, weights = torch.rand(500, 3), torch.rand(500)  # see SampleReservoir
            >>> parents = router.subdivide(8, optimizer=optimizer, points=points, weights=weights)
            >>> router.num_cells, router.module.weight.shape
            (8, torch.Size([8, 1, 3]))
        """
        diagram, parents = finer_diagram(
            self.diagram,
            diagram,
            parents,
            points,
            weights,
            {"backend": self.backend, "generator": self.generator, **split},
        )
        # Children of a cell that is split; the other cells go on as they were, with or without inheritance.
        new = torch.bincount(parents, minlength=self.num_cells)[parents] > 1
        fresh = None if inherit else draw_parameters(self.cell(0), diagram.num_cells, self.generator)
        if optimizer is not None:
            check_optimizer(optimizer, self.module)
        before = self.num_cells
        inherit_parameters(self.module, parents, fresh, new)
        self.diagram = copy.deepcopy(diagram).to(self.diagram.centres.device)
        self._forget_assignments()
        if optimizer is not None:
            move_state(optimizer, self.module, parents, before, None if inherit else new)
        else:
            self._watch_optimizers("router.subdivide(..., optimizer=optimizer)")
        return parents

    def _watch_optimizers(self, line: str) -> None:
        if self._watch is not None:
            self._watch.remove()
        self._watch = watch_optimizers(self.module, line)

    def load_state_dict(
        self,
        state_dict: Mapping[str, Any],
        strict: bool = True,
        assign: bool = False,
        *,
        optimizer: torch.optim.Optimizer | None = None,
    ) -> Any:
        """Loads a state of any number of cells; the parameter objects stay, so an optimiser goes on with them.

        Args:
            state_dict: What ``state_dict()`` of a router around the same module gave.
            strict: As of ``nn.Module``.
            assign: As of ``nn.Module``; parameters are new objects then.
            optimizer: The optimiser that holds this router's parameters. Where the number of cells changes, its state
                begins anew, if its own ``load_state_dict`` does not follow. Without it an optimiser that has state of
                the cells before raises at its next step.

        Returns:
            Missing and unexpected keys.

        Raises:
            ValueError: When the optimiser holds none of the router's parameters.
        """
        if optimizer is not None:
            check_optimizer(optimizer, self.module, "load_state_dict")
        result = super().load_state_dict(state_dict, strict, assign)
        if optimizer is not None:
            drop_state(optimizer)
        return result

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes over the stored diagram first, so that parameters of any number of cells fit."""
        self._forget_assignments()
        if f"{prefix}diagram.centres" in state_dict:
            diagram = VoronoiDiagram.from_state(state_dict, f"{prefix}diagram.")
            if diagram.num_cells == self.num_cells:
                self.diagram = diagram.to(self.diagram.centres.device)
            else:
                self.subdivide(diagram, torch.zeros(diagram.num_cells, dtype=torch.int64))
                self._watch_optimizers("router.load_state_dict(state, optimizer=optimizer)")
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_watch": None}

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        detach_results(self, memo)
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        copied.__dict__.update({key: copy.deepcopy(value, memo) for key, value in self.__getstate__().items()})
        return copied


def check_optimizer(optimizer: torch.optim.Optimizer, module: nn.Module, method: str = "subdivide") -> None:
    """Raises ValueError for an optimiser that holds none of a module's parameters."""
    ours = {id(parameter) for parameter in module.parameters()}
    if ours and not any(id(parameter) in ours for group in optimizer.param_groups for parameter in group["params"]):
        raise ValueError(f"{_OP}.{method}: optimizer must hold the router's parameters, got one of others")


def move_state(
    optimizer: torch.optim.Optimizer, module: nn.Module, parents: Tensor, k: int, fresh: Tensor | None
) -> None:
    """Gives every cell the state that an optimiser has for its parent; other optimisers begin anew, which is said.

    Args:
        optimizer: Of a module whose parameters are those of the new cells already.
        module: With stacked parameters.
        parents: int64 [new cells].
        k: Cells before.
        fresh: bool [new cells], whose state is zero instead, or None.
    """
    known, lost = isinstance(optimizer, _ELEMENTWISE_OPTIMIZERS), False
    for parameter in {id(p): p for _, _, p in cell_parameters(module)}.values():
        old, state = (k, *parameter.shape[1:]), optimizer.state.get(parameter, {})
        lost = lost or (bool(state) and not known)
        for key, value in state.items():
            if isinstance(value, Tensor) and value.shape == old and known:
                state[key] = value[parents.to(value.device)]
                if fresh is not None:
                    state[key][fresh.to(value.device)] = 0
    if not known:
        # Some keep what is not a parameter's own, such as the last flattened gradient; nothing of it fits any more.
        optimizer.state.clear()
        if isinstance(optimizer, torch.optim.LBFGS):
            optimizer._numel_cache = None  # the number of entries of all parameters together
    if lost:
        name = type(optimizer).__name__
        warnings.warn(
            f"{_OP}.subdivide: the state of {name} cannot be inherited by cells and begins anew", stacklevel=4
        )


def drop_state(optimizer: torch.optim.Optimizer) -> None:
    """Lets an optimiser begin anew where its state has the shapes of other cells than the parameters have."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            if _is_stale(optimizer, parameter):
                optimizer.state.pop(parameter)
                if isinstance(optimizer, torch.optim.Adagrad):  # which makes its state when it is made
                    total = torch.full_like(parameter, group["initial_accumulator_value"])
                    optimizer.state[parameter].update(step=torch.tensor(0.0), sum=total)
    if isinstance(optimizer, torch.optim.LBFGS):
        optimizer.state.clear()
        optimizer._numel_cache = None


def _is_stale(optimizer: torch.optim.Optimizer, parameter: Any) -> bool:
    state = optimizer.state.get(parameter, {})
    return any(isinstance(v, Tensor) and v.dim() > 0 and v.shape != parameter.shape for v in state.values())


def watch_optimizers(module: nn.Module, line: str) -> Any:
    """Raises at the next step of an optimiser that holds state of other cells than a module's parameters have.

    The error says which ``line`` to write, so that the optimiser follows. ``remove()`` of the handle ends the watch.
    """
    watched = {id(parameter): weakref.ref(parameter) for _, _, parameter in cell_parameters(module)}

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        held = [p for group in optimizer.param_groups for p in group["params"] if id(p) in watched] if watched else []
        if any(watched[id(parameter)]() is parameter and _is_stale(optimizer, parameter) for parameter in held):
            raise ValueError(
                f"{_OP}: optimizer ({type(optimizer).__name__}) holds the state of other cells than the router has; "
                f"write {line}, or make the optimizer afterwards"
            )
        if held:
            watched.clear()  # torch does not let a hook remove itself

    handle = register_optimizer_step_pre_hook(check)
    weakref.finalize(module, handle.remove)
    return handle
