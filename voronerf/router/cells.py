"""A module for each cell: stacked parameters, cells taken out and put in, splits, states of any number of cells.

k cells; ``[k, ...]`` under the module's own names. Parameters stay the same objects when cells are split or loaded, and
get another shape. The state that an optimiser has for them must have that shape too: it follows, or the optimiser says
at its next step what to write.
"""

from __future__ import annotations

import contextlib
import copy
import fnmatch
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_pre_hook

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import finer_diagram
from voronerf.router.grouping import SHARED, cell_parameters, owned_parameters
from voronerf.router.layout import tensors_of
from voronerf.router.optimizers import check_optimizer, drop_state, is_stale, move_state

_OP = "VoronoiRouter"


# Parameters -----------------------------------------------------------------------------------------------------------


def clone_module(module: Any, memo: dict[int, Any] | None = None) -> Any:
    """A deep copy, also of a module that keeps results of its last call (which torch refuses to copy)."""
    memo = {} if memo is None else memo
    detach_results(module, memo)
    return copy.deepcopy(module, memo)


def detach_results(module: nn.Module, memo: dict[int, Any]) -> None:
    """Has ``copy.deepcopy`` take copies without a graph of the results that a module keeps."""
    for part in module.modules():
        for value in vars(part).values():
            if isinstance(value, Tensor) and not value.is_leaf:
                memo[id(value)] = value.detach().clone()


def check_module(module: nn.Module) -> None:
    """Raises TypeError for what cannot be one network for each cell."""
    if not isinstance(module, nn.Module):
        raise TypeError(f"{_OP}: module must be an nn.Module, got {type(module).__name__}")
    for name, part in module.named_modules():
        reason = _refusal(part)
        if reason:
            where = f"`{name}`, a {type(part).__name__}," if name else f"a {type(part).__name__}"
            raise TypeError(f"{_OP}: module must treat samples one by one, but {where} {reason}")


def _refusal(part: nn.Module) -> str:
    if isinstance(part, nn.modules.batchnorm._BatchNorm):
        return "mixes the samples of a batch (use LayerNorm)"
    if isinstance(part, nn.RNNBase):
        return "is recurrent, with weights that cannot be one set for each cell"
    if any(type(one).__name__.endswith("SpectralNorm") for one in (part, *part._forward_pre_hooks.values())):
        return "keeps a state for each weight (spectral norm) that cells cannot share"
    for name, value in vars(part).items():
        plain = isinstance(value, (list, tuple, dict)) and name != "_parameters"
        if plain and any(isinstance(item, nn.Parameter) for item in tensors_of(value)):
            return f"keeps parameters in the plain {type(value).__name__} `{name}` (use nn.ParameterList)"
    return ""


def stack_parameters(module: nn.Module, k: int, share: Sequence[str]) -> None:
    """Gives every parameter of a module k equal entries, in place, but for those that the patterns ``share`` name."""
    named = list(module.named_parameters(remove_duplicate=False))
    for pattern in share:
        if not any(fnmatch.fnmatchcase(name, pattern) for name, _ in named):
            raise ValueError(
                f"{_OP}: share must name parameters of {type(module).__name__}, such as "
                f"{', '.join(name for name, _ in named[:3])}, got {pattern!r}"
            )
    shared = {id(p) for name, p in named if any(fnmatch.fnmatchcase(name, pattern) for pattern in share)}
    stacked: dict[int, nn.Parameter] = {}
    for owner, name, parameter in owned_parameters(module):
        if id(parameter) in shared:
            vars(owner)[SHARED] = (*vars(owner).get(SHARED, ()), name)
            continue
        if id(parameter) not in stacked:
            values = parameter.detach().expand(k, *parameter.shape).clone()
            stacked[id(parameter)] = nn.Parameter(values, requires_grad=parameter.requires_grad)
        owner.register_parameter(name, stacked[id(parameter)])


@torch.no_grad()
def fill_cell(routed: nn.Module, index: int, module: nn.Module, op: str) -> None:
    """Puts a plain module's parameters into one cell, or raises ValueError where names, shapes or buffers differ."""
    stacked = {id(parameter) for parameter in cell_parameters(routed)}
    ours, theirs = routed.state_dict(keep_vars=True), module.state_dict()
    odd = sorted(ours.keys() ^ theirs.keys())
    if odd:
        raise ValueError(f"{op}: module must have the parameters of the routed one, got a difference in {odd[0]!r}")
    for name, own in ours.items():
        shape, value = own.shape[id(own) in stacked :], theirs[name]
        if value.shape != shape:
            raise ValueError(f"{op}: module's {name} must have shape {list(shape)}, got {list(value.shape)}")
        if id(own) not in stacked and not torch.equal(value.to(own), own):
            raise ValueError(f"{op}: module's {name} must be that of the routed one, since cells share it")
    for name, own in ours.items():
        if id(own) in stacked:
            own[index] = theirs[name].to(own)


def _replace_values(parameter: nn.Parameter, values: Tensor) -> None:
    """Gives a parameter values of another shape.

    A graph of an earlier call that is still held would sum the gradients of the new cells to the old shape. With
    another dtype in between torch forgets it.
    """
    if values.is_floating_point():
        other = torch.float32 if values.dtype == torch.float64 else torch.float64
        parameter.data = values.new_empty(0, dtype=other)
    parameter.data, parameter.grad = values, None


def _draw_parameters(template: nn.Module, k: int, generator: torch.Generator | None) -> dict[str, Tensor]:
    """Newly drawn parameters [k, ...] of a plain module, by name."""
    parts = {"": template} if hasattr(template, "reset_parameters") else dict(template.named_modules())
    for name, part in parts.items():
        if not hasattr(part, "reset_parameters") and any(p is not None for p in part._parameters.values()):
            raise ValueError(
                f"{_OP}.subdivide: inherit=False needs a field with reset_parameters(), or layers that have it; "
                f"`{name}`, a {type(part).__name__}, has not"
            )
    drawn: dict[str, list[Tensor]] = {name: [] for name, _ in template.named_parameters()}
    # Of GPUs as well, which manual_seed reaches. Without a generator torch's own goes on.
    with torch.random.fork_rng() if generator is not None else contextlib.nullcontext():
        if generator is not None:
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator, device=generator.device)))
        for _ in range(k):
            for part in parts.values():
                if hasattr(part, "reset_parameters"):
                    part.reset_parameters()  # type: ignore[operator]
            for name, parameter in template.named_parameters():
                drawn[name].append(parameter.detach().clone())
    return {name: torch.stack(values) for name, values in drawn.items()}


# Cells ----------------------------------------------------------------------------------------------------------------


class Finer(NamedTuple):
    """What a router becomes: a diagram, int64 parents of its cells, and how they get what their parents have.

    ``take`` gives the entries of this process's new cells, the slice ``own``; ``shards`` says which rank has which.
    """

    diagram: VoronoiDiagram
    parents: Tensor
    take: Callable[[Tensor], Tensor]
    own: slice = slice(None)
    shards: Any = None


class CellModules(nn.Module):
    """k modules, one for each cell of a diagram, as one module with stacked parameters."""

    def __init__(self, module: nn.Module, diagram: VoronoiDiagram, share: Sequence[str]) -> None:
        super().__init__()
        first = next(module.parameters(), None)
        self.diagram = diagram if first is None or first.is_meta else diagram.to(first.device)
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

    def cell(self, index: int) -> nn.Module:
        """A plain copy of one cell's module, with parameters of its own.

        Raises:
            IndexError: If there is no such cell.
        """
        return self._plain(self._check_index("cell", index))

    def _plain(self, index: int) -> nn.Module:
        own = {id(p): nn.Parameter(p.detach()[index].clone(), p.requires_grad) for p in cell_parameters(self.module)}
        plain: nn.Module = clone_module(self.module, own)
        for part in plain.modules():
            vars(part).pop(SHARED, None)
        return plain

    def load_cell(self, index: int, module: nn.Module) -> None:
        """Copies the parameters of a plain module into one cell. Parameter objects and optimisers stay the same.

        Raises:
            IndexError: If there is no such cell.
            ValueError: For parameters of other names or shapes, or buffers that differ from the shared ones.
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
        split = {"backend": self.backend, "generator": self.generator, **split}
        check_optimizer(optimizer, self.module, "subdivide")
        finer = self._finer(diagram, parents, points, weights, split)
        # Children of a cell that is split; the other cells go on as they were, with or without inheritance.
        new = torch.bincount(finer.parents, minlength=self.num_cells)[finer.parents] > 1
        fresh = None if inherit else _draw_parameters(self._plain(0), len(new), self.generator)
        self._become(finer, optimizer, new[finer.own], fresh)
        if optimizer is None:
            self._watch_optimizers("router.subdivide(..., optimizer=optimizer)")
        return finer.parents

    def _finer(self, diagram: Any, parents: Any, points: Any, weights: Any, split: dict[str, Any]) -> Finer:
        diagram, parents = finer_diagram(self.diagram, diagram, parents, points, weights, split)
        return Finer(diagram, parents, lambda stacked: stacked[parents.to(stacked.device)])

    def _become(self, finer: Finer, optimizer: Any, new: Tensor, fresh: dict[str, Tensor] | None = None) -> None:
        """Replaces the cells; those of ``new``, bool [own cells], get the values of ``fresh``, [all new cells, ...]."""
        names, before = {id(p): name for name, p in self.module.named_parameters()}, 0
        for parameter in cell_parameters(self.module):
            before = len(parameter)
            with torch.inference_mode(False):
                values = finer.take(parameter.detach())
                if fresh is not None:
                    values[new.to(values.device)] = fresh[names[id(parameter)]][finer.own][new].to(values)
                _replace_values(parameter, values)
        self.diagram = copy.deepcopy(finer.diagram).to(self.diagram.centres.device)
        if optimizer is not None:
            move_state(optimizer, self.module, finer.take, before, None if fresh is None else new)

    def _watch_optimizers(self, line: str) -> None:
        """Raises at the next step of an optimiser that holds state of other cells, and says which ``line`` to write."""
        if self._watch is not None:
            self._watch.remove()
        watched = {id(parameter): weakref.ref(parameter) for parameter in cell_parameters(self.module)}

        def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
            held = [p for group in optimizer.param_groups for p in group["params"] if id(p) in watched]
            if any(watched[id(parameter)]() is parameter and is_stale(optimizer, parameter) for parameter in held):
                raise ValueError(
                    f"{_OP}: optimizer ({type(optimizer).__name__}) holds the state of other cells than the router "
                    f"has; write {line}, or make the optimizer afterwards"
                )
            if held:
                watched.clear()  # torch does not let a hook remove itself

        self._watch = register_optimizer_step_pre_hook(check)
        weakref.finalize(self.module, self._watch.remove)

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
            ValueError: If the optimiser holds none of the router's parameters.
        """
        check_optimizer(optimizer, self.module, "load_state_dict")
        result = super().load_state_dict(state_dict, strict, assign)
        if optimizer is not None:
            drop_state(optimizer)
        return result

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes over the stored diagram first, so that parameters of any number of cells fit."""
        if f"{prefix}diagram.centres" in state_dict:
            diagram = VoronoiDiagram.from_state(state_dict, f"{prefix}diagram.")
            if diagram.num_cells == self.num_cells:
                self.diagram = diagram.to(self.diagram.centres.device)
            else:
                finer = self._finer(diagram, torch.zeros(diagram.num_cells, dtype=torch.int64), None, None, {})
                if all(f"{prefix}module.{name}" in state_dict for name, _ in self.module.named_parameters()):
                    own = len(range(diagram.num_cells)[finer.own])  # their values come with the state
                    finer = finer._replace(take=lambda stacked: stacked.new_empty(own, *stacked.shape[1:]))
                self._become(finer, None, torch.zeros(len(finer.parents), dtype=torch.bool)[finer.own])
                self._watch_optimizers("router.load_state_dict(state, optimizer=optimizer)")
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_watch": None}

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        detach_results(self, memo)
        copied = memo[id(self)] = type(self).__new__(type(self))
        copied.__dict__.update({key: copy.deepcopy(value, memo) for key, value in self.__getstate__().items()})
        return copied
