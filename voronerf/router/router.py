"""VoronoiRouter: one network per Voronoi cell, evaluated for all cells in one pass.

Letters: n samples, k cells, r rays, d coordinates (1 to 4). Positions are in scene units; cells and rows are int32,
parents int64.
"""

from __future__ import annotations

import copy
import functools
import inspect
import numbers
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import finer_diagram
from voronerf.diagram.voronoi import MANY_CELLS
from voronerf.ops._core.active import is_recorded
from voronerf.ops._core.backends import BACKENDS
from voronerf.ops._core.compiler import not_compiled
from voronerf.ops.network import Cells
from voronerf.router.arrange import COLUMNS, accepted_names, argument_names, describe_call, find_positions, with_labels
from voronerf.router.call_cache import CachedCall, call_key
from voronerf.router.cells import (
    apply_to_cells,
    check_module,
    clone_module,
    detach_results,
    draw_parameters,
    fill_cell,
    plain_cell,
    renew_cells,
    stack_parameters,
)
from voronerf.router.dispatch import Dispatch
from voronerf.router.grouping import Assigned, Grouping, cell_parameters
from voronerf.router.labels import Labels
from voronerf.router.optimizers import (
    FrozenRows,
    Untrained,
    check_optimizer,
    drop_state,
    freeze_cells,
    keep_frozen,
    move_state,
    watch_optimizers,
)
from voronerf.router.probe import Options
from voronerf.router.program import CellProgram, FieldProgram, each_direction
from voronerf.router.transforms import outside, refuse_transforms, transformed, unwrapped

_NO_GRAPH = (
    "VoronoiRouter: a routed module runs eagerly between two graphs of torch.compile; omit fullgraph=True, or call a "
    "router with fuse=True once beforehand, with gradients on or off as in the graph"
)
# Attributes whose assignment drops all cached calls.
_READ = ("backend", "coords", "diagram", "layout", "methods", "module", "per_ray", "shared", "way")
Assignment = Literal["nearest", "stochastic"]
Coordinates = Literal["first1", "first2", "first3", "first4"] | slice | Callable[..., Tensor]


class VoronoiRouter(nn.Module):
    """k copies of a module, one for each Voronoi cell or label; each sample is evaluated by its cell's copy.

    ``router(...)`` takes the arguments of the module's ``forward`` and returns what it returns, in the same order and
    with the same leading dimensions. Every cell starts as a copy of the module (the inheritance of Adaptive Voronoi
    NeRFs). Positions stay global, so identical copies give exactly the result of the module, and no seam appears at a
    split. The parameters of all copies are stacked, ``[k, ...]``, under the module's own names with the prefix
    ``module.``: an optimiser sees as many tensors as for one module. Buffers are shared by all cells.

    The reference is a loop over the cells, which runs each copy on its samples. A call runs as the first possible
    item of the following list; its results are compared with the reference in the first call of a method with these
    types and sizes of arguments. :meth:`explain` says which item, and why an earlier one is impossible:

    - fused: one operation for the whole network. This needs a field with a method ``program``
      (:func:`voronerf.router.layered_program`), or ``fuse=True``.
    - grouped: the module's own ``forward`` runs once, on the samples of all cells sorted by cell. Functions that take
      parameters have a rule for all cells at once: linear layers (also ``F.linear``, ``@``, ``einsum``), recurrent
      layers, embeddings, normalisation layers, scales. :func:`voronerf.router.register` adds a rule.
    - cell by cell: the module runs once for each cell that has samples. A warning names the line of code that
      prevents a faster evaluation.

    A module that mixes samples (BatchNorm in training mode, attention across samples) is refused.

    If ``diagram`` is the number of networks, cells have no centres. Every call then passes the cell of each sample,
    ``router(x, cells=labels)``, such as its speaker, station, object or image. A router with a diagram accepts
    ``cells=`` too, and then skips the look-up. Labels have the leading shape of the samples, ``[n]`` for ``[n, f]``.
    With labels ``[images]``, a row of ``[images, pixels, f]`` is one sample, which the module gets as a whole. With
    labels ``[n, m]``, ``x[:, None]`` gives each of n rows to m networks; results are ``[n, m, ...]``.

    An argument may be:

    - per sample, ``[..., f]``;
    - per ray, ``[rays, f]`` beside ``[rays, samples, f]``;
    - a number, flag, None or tensor of one element, which is passed unchanged;
    - an object that holds tensors, such as nerfstudio's ``RaySamples``.

    Tensors of a subclass are converted to plain tensors; a module whose results would change is refused.

    Args:
        module: Any ``nn.Module`` that treats samples one by one; it is copied and never changed.
        diagram: A VoronoiDiagram (:meth:`VoronoiDiagram.from_points` places its centres), or centres [k, d], in the
            coordinates of the positions; or k, the number of networks, which are then chosen by labels.
        coords: The rule that finds the positions in a call's arguments: ``"first3"``, the first three features of the
            first tensor (``"first2"`` for d = 2 and so on); a slice of its features; or a function of the arguments
            that returns positions [..., d]. A call can pass positions instead, ``router(x, coords=positions)``, unless
            the module itself has an argument ``coords``. For a field with a ``program`` the positions are the first
            argument of the call.
        per_ray: Names or numbers of the arguments that have one row for each ray. If None, shapes decide, and ambiguous
            shapes are refused.
        shared: Names or numbers of tensor arguments that are the same for all samples.
        methods: Names of further methods to route, ``router.density(x)``. Methods that are called with the same
            positions share one assignment to cells.
        share: Names of parameters that all cells share, with wildcards: ``["encoder.*"]``. A shared parameter has one
            copy, with ordinary gradients; other parameters are per cell. Steps with shared parameters run once for all
            samples, also with ``fuse``.
        fuse: A promise that ``forward`` depends only on its arguments and on the state of its submodules. The network
            is traced and runs as one operation; if this is impossible, an error names the line. Changed numbers,
            attributes and buffers take effect, except writes by ``buffer.data`` or in inference mode to buffers above 1
            MiB or on a GPU; write these by ``buffer.copy_(...)``.
        way: The evaluation of calls, see above: "fused" (which needs ``fuse=True``), "grouped" or "loop" (cell by
            cell). If it is impossible, the next one in this order runs. With few cells, "loop" may be faster than
            "grouped".
        layout: The shape in which the module gets samples ``[rays, samples, f]``: "rays" for ``[n, 1, f]``, with
            per-ray arguments as ``[n, f]``; "flat" for ``[n, f]``, for modules that squeeze or flatten.
        assignment: "nearest" evaluates a sample in the cell that holds it. "stochastic" draws the cell at random by the
            distances in training mode (:meth:`VoronoiDiagram.sample_cell`), and acts as "nearest" in eval mode.
        temperature: The temperature of the stochastic assignment, in scene units.
        backend: The backend of every operation; see ``voronerf info``.

    Raises:
        TypeError: For a module that mixes samples, or that cannot be one network for each cell.
        ValueError: For bad centres, coords, methods or layout, an unknown assignment, or a temperature that is not
            positive; for fewer than one network; for coords or a stochastic assignment without centres.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> field = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.ReLU(), torch.nn.Linear(64, 4))
        >>> router = VoronoiRouter(field, torch.rand(16, 3), coords="first3", fuse=True)
        >>> points = torch.rand(1000, 3)
        >>> router(points).shape
        torch.Size([1000, 4])
        >>> bool((router(points) - field(points)).abs().max() < 1e-5)  # all cells are copies
        True
        >>> [tuple(p.shape) for p in router.parameters()]
        [(16, 64, 3), (16, 64), (16, 4, 64), (16, 4)]
        >>> print(router.explain())
        forward: fused
        >>> speakers = VoronoiRouter(torch.nn.Linear(8, 2), 100, fuse=True)  # one network for each of 100 speakers
        >>> speakers(torch.rand(5, 8), cells=torch.tensor([3, 99, 3, 0, 7])).shape
        torch.Size([5, 2])
    """

    @torch.inference_mode(False)  # inference-mode parameters could never be trained
    def __init__(
        self,
        module: nn.Module,
        diagram: VoronoiDiagram | Tensor | int,
        *,
        coords: Coordinates | None = None,
        per_ray: Sequence[str | int] | None = None,
        shared: Sequence[str | int] = (),
        methods: Sequence[str] = (),
        share: Sequence[str] = (),
        fuse: bool = False,
        way: Literal["fused", "grouped", "loop"] = "fused",
        layout: Literal["rays", "flat"] = "rays",
        assignment: Assignment = "nearest",
        temperature: float = 0.05,
        backend: str = "auto",
    ) -> None:
        module = getattr(module, "_orig_mod", module)  # unwrap torch.compile, which would not see the cells' parameters
        check_module(module)
        options = {"coords": coords, "assignment": assignment, "temperature": temperature, "layout": layout, "way": way}
        lists = {"per_ray": per_ray, "shared": shared, "methods": methods, "share": share}
        _check_options(module, lists, **options, backend=backend)
        super().__init__()
        cells = _diagram_of(diagram)
        if cells.centres.shape[1] == 0:
            _refuse_places(coords, assignment)
        parameter = next(module.parameters(), None)
        self.diagram = cells if parameter is None or parameter.is_meta else cells.to(parameter.device)
        self.module: nn.Module = clone_module(module)
        stack_parameters(self.module, cells.num_cells, share)
        self.share, self.generator = tuple(share), cast("torch.Generator | None", None)
        self._watches: list[Any] = []  # hooks on optimisers with stale state
        self._training_checks: list[Untrained | FrozenRows] = [Untrained(self.module)]
        self.assignment, self.temperature = assignment, temperature
        field_program = FieldProgram.of(self.module)
        if coords is None and field_program is not None and cells.centres.shape[1]:
            coords = cast(Coordinates, f"first{cells.centres.shape[1]}")
        self.backend, self.coords, self.fuse, self.way, self.layout = backend, coords, fuse, way, layout
        self.per_ray = None if per_ray is None else tuple(per_ray)
        self.shared, self.methods = tuple(shared), tuple(methods)
        self._names = tuple(name for name, _ in self.module.named_parameters())
        self._argument_names = {name: argument_names(getattr(self.module, name)) for name in ("forward", *self.methods)}
        conflicts = [name for name, arguments in self._argument_names.items() if "cells" in arguments]
        if conflicts and not cells.centres.shape[1]:
            where = f"{type(module).__name__}.{conflicts[0]}"
            raise ValueError(
                f"VoronoiRouter: {where} has an argument cells itself, so a router without centres cannot pass labels"
            )
        self._dispatch = Dispatch()
        self._assigned: Assigned | None = None  # cells of the last batch, if several methods are routed
        self._positions_unchecked = True  # until the first large training batch
        self._resized = False  # parameters may have other sizes than when DistributedDataParallel wrapped them
        self.register_buffer("frozen_cells", None, persistent=False)
        self._field_program = field_program
        if field_program is not None:
            field_program.look(self.module)  # before torch.compile traces a call

    @classmethod
    def from_modules(
        cls, modules: Sequence[nn.Module], diagram: VoronoiDiagram | Tensor | int | None = None, **options: Any
    ) -> VoronoiRouter:
        """Makes a router from one module for each cell, for example separately trained networks as in Mega-NeRF.

        Args:
            modules: k modules of one architecture, in the order of the centres or labels.
            diagram: A VoronoiDiagram of k cells, or centres [k, d]; None for cells that are chosen by labels.
            **options: The options of the constructor.

        Raises:
            ValueError: If there are not exactly k modules, or if they differ in anything but the values of parameters,
                such as buffers, attributes or activations.
        """
        modules, rule = list(modules), "VoronoiRouter.from_modules: modules must hold a module for each"
        if not modules:
            raise ValueError(f"{rule} cell, got none")
        router = cls(modules[0], len(modules) if diagram is None else diagram, **options)
        if len(modules) != router.num_cells:
            raise ValueError(f"{rule} of {router.num_cells} cells, got {len(modules)}")
        for index, module in enumerate(modules):
            fill_cell(router.module, index, module, f"VoronoiRouter.from_modules: modules[{index}]")
        return router

    @torch.inference_mode(False)
    @torch.no_grad()
    def part(self, cells: Sequence[int] | Tensor) -> VoronoiRouter:
        """Returns a router with only the chosen cells. Their results stay the same; shared parameters are copied.

        Args:
            cells: Ascending cell numbers [c], at least one; they become 0 to c - 1.

        Raises:
            ValueError: For no cells, cells out of range, or cells that do not ascend.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 1), torch.rand(8, 3), coords="first3")
            >>> router.part([2, 5]).module.weight.shape
            torch.Size([2, 1, 3])
        """
        chosen = torch.as_tensor(cells, dtype=torch.int64, device=self.diagram.centres.device)
        result = copy.deepcopy(self)
        result.diagram = self.diagram.part(chosen)
        renew_cells(result.module, chosen)
        result._set_frozen(self.frozen[chosen])
        return result

    # Cells ------------------------------------------------------------------------------------------------------------

    @property
    def num_cells(self) -> int:
        """The number of cells, which is the number of networks."""
        diagram: Any = self._modules["diagram"]  # attribute access is six times slower
        count: int = diagram.num_cells
        return count

    @torch.inference_mode(False)
    def cell(self, index: int) -> nn.Module:
        """Returns a plain copy of one cell's module, with parameters of its own.

        Raises:
            IndexError: If there is no cell of this index.
        """
        return plain_cell(self.module, self._check_index("cell", index))

    def load_cell(self, index: int, module: nn.Module) -> None:
        """Copies the parameters of a plain module into one cell. Parameter objects and optimisers stay the same.

        Raises:
            IndexError: If there is no cell of this index.
            ValueError: For parameters of other names or shapes, or buffers, attributes or submodules that differ from
                the router, since all cells share them.
        """
        fill_cell(self.module, self._check_index("load_cell", index), module, "VoronoiRouter.load_cell")
        self._drop_frozen_checks()

    def apply(self, fn: Callable[[nn.Module], Any]) -> VoronoiRouter:
        """Applies a function, such as one that initialises layers, to the modules of each cell in turn.

        The function gets the weights of one cell, [o, i]. ``router.module.apply`` would pass stacked weights, [k, o,
        i], which initialisers would take for the weights of a convolution. Only changes of parameters and buffers are
        kept.

        Raises:
            ValueError: If the function changes names or shapes of parameters.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 2), torch.rand(4, 3), coords="first3")
            >>> _ = router.apply(lambda m: torch.nn.init.orthogonal_(m.weight))
            >>> weight = router.cell(1).weight
            >>> torch.allclose(weight @ weight.T, torch.eye(2), atol=1e-6)
            True
        """
        apply_to_cells(self.module, self.num_cells, fn)
        self._drop_frozen_checks()
        return self

    def _check_index(self, method: str, index: int) -> int:
        if not -self.num_cells <= index < self.num_cells:
            raise IndexError(f"VoronoiRouter.{method}: index must be below {self.num_cells}, got {index}")
        return index

    @property
    def frozen(self) -> Tensor:
        """The mask of frozen cells, bool [k]; see :meth:`freeze`."""
        device = self.diagram.centres.device
        none = torch.zeros(self.num_cells, dtype=torch.bool, device=device)
        return none if self.frozen_cells is None else self.frozen_cells.clone()

    @torch.inference_mode(False)
    def freeze(
        self, cells: Sequence[int] | Tensor | None = None, *, optimizer: torch.optim.Optimizer | None = None
    ) -> None:
        """Freezes some cells: their parameters keep the same bits after any step of the optimiser.

        Results of samples in frozen cells are constants: they have no gradient, neither to parameters nor to arguments,
        and take no part in the backward pass. Momentum, weight decay and the moments of Adam do not change frozen
        cells. Other cells train as usual. Parameters that all cells share (``share=``, such as the table of a hash
        grid) cannot be frozen for some cells. They learn from the samples in the other cells, so the results of frozen
        cells change with them.

        Args:
            cells: Numbers of cells, or bool [k]; None for all. Cells that were frozen before stay frozen.
            optimizer: The optimiser that holds this router's parameters; each later step restores the values of frozen
                cells. :class:`voronerf.nerf.Adam` skips frozen cells by itself. If an optimiser that was not passed
                changes frozen cells in its first steps, a later call raises.

        Raises:
            ValueError: For a cell number out of range, a mask of another length, or an optimiser that holds none of the
                router's parameters.
            TypeError: If ``cells`` are neither numbers of cells nor a mask.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 2), torch.rand(4, 3), coords="first3")
            >>> optimizer = torch.optim.AdamW(router.parameters())
            >>> router.freeze([0, 1, 2], optimizer=optimizer)
            >>> before = router.module.weight.detach().clone()
            >>> router(torch.rand(64, 3)).square().mean().backward()
            >>> optimizer.step()
            >>> (router.module.weight == before).all(dim=2).all(dim=1)
            tensor([ True,  True,  True, False])
        """
        check_optimizer(optimizer, self.module, "freeze")
        self._set_frozen(self.frozen | self._mask("freeze", cells))
        if optimizer is not None:
            keep_frozen(optimizer)
        elif self.frozen_cells is not None:
            self._training_checks.append(FrozenRows(self.module, self.frozen_cells))

    @torch.inference_mode(False)
    def unfreeze(self, cells: Sequence[int] | Tensor | None = None) -> None:
        """Unfreezes cells; the optimiser's moments are as before the freeze. For ``cells`` see `freeze`."""
        self._set_frozen(self.frozen & ~self._mask("unfreeze", cells))

    def _mask(self, method: str, cells: Sequence[int] | Tensor | None) -> Tensor:
        """Returns the cells as a mask, bool [k]."""
        device, k = self.diagram.centres.device, self.num_cells
        if cells is None:
            return torch.ones(k, dtype=torch.bool, device=device)
        chosen = torch.as_tensor(cells, dtype=None if len(cells) else torch.int64, device=device)
        rule = f"VoronoiRouter.{method}: cells must be"
        if chosen.dtype == torch.bool:
            if chosen.shape != (k,):
                raise ValueError(f"{rule} bool [{k}], got {list(chosen.shape)}")
            return chosen
        if chosen.is_floating_point() or chosen.is_complex() or chosen.dim() != 1:
            raise TypeError(f"{rule} numbers of cells or bool [{k}], got {chosen.dtype} {list(chosen.shape)}")
        for number in chosen.tolist():
            if not 0 <= number < k:
                raise ValueError(f"{rule} numbers below {k}, got {number}")
        return torch.zeros(k, dtype=torch.bool, device=device).index_fill(0, chosen.long(), True)

    def _set_frozen(self, frozen: Tensor | None) -> None:
        self._drop_frozen_checks()
        self.frozen_cells = frozen if frozen is not None and bool(frozen.any()) else None
        freeze_cells(self.module, self.frozen_cells)

    @torch.inference_mode(False)
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

        Parameters are copied from the parent. With ``optimizer``, the state of Adam, AdamW, RAdam, SGD and similar
        optimisers is copied too. Moments are divided by the number of children, which share the parent's samples, but
        not if Adam soon forgets them (``betas[1]`` up to 0.99) or if labels choose the networks. The state of other
        optimisers is reset, with a warning. The parameter objects stay the same, so groups, learning rates and
        schedules continue. A wrapper with parameters of its own, such as ``DistributedDataParallel``, must be made
        again.

        Args:
            diagram: The finer diagram, as :meth:`VoronoiDiagram.refine` returns it, or the number of children of each
                cell that has enough samples (:func:`voronerf.split_diagram`). A router without centres takes
                :meth:`VoronoiDiagram.without_centres` together with ``parents``.
            parents: The old cell that contains each new cell, int64 [new cells]; None for the cell that holds the
                new centre.
            optimizer: The optimiser that holds this router's parameters.
            inherit: Whether children start as copies. If False, the children of a split cell get newly drawn parameters
                and zero moments, an ablation that causes ghosting.
            points: Samples [m, d] in scene units, if ``diagram`` is a number of children.
            weights: The importance of the samples, [m], by which the new cells are balanced; None for 1 each.
            **split: Further options of ``split_diagram``, such as cells, centres, min_samples.

        Returns:
            int64 [new cells], the parents.

        Raises:
            ValueError: If ``parents`` does not fit, ``points`` are missing, or the module cannot draw new parameters.
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
        k = self.num_cells
        has_centres = not isinstance(diagram, VoronoiDiagram) or diagram.centres.shape[1] > 0
        if not self._d and (has_centres or parents is None):
            raise ValueError(
                "VoronoiRouter.subdivide: diagram must be VoronoiDiagram.without_centres(k) for a router without "
                "centres, with parents, the old label of each new label"
            )
        if self._d and not has_centres:
            raise ValueError("VoronoiRouter.subdivide: diagram must have centres like the router's, got none")
        finer, parents = finer_diagram(self.diagram, diagram, parents, points, weights, split)
        # Marks the children of split cells. Other cells keep their values, with or without inheritance.
        children = torch.bincount(parents, minlength=k)[parents]
        new = children > 1
        fresh = None if inherit else draw_parameters(self.module, len(new), self.generator)
        renew_cells(self.module, parents, fresh, new)
        self.diagram, self._positions_unchecked = copy.deepcopy(finer).to(self.diagram.centres.device), True
        self._resized = True
        if self.frozen_cells is not None:
            self._set_frozen(self.frozen_cells[parents.to(self.frozen_cells.device)])
        if optimizer is not None:
            shares = children if self._d else torch.ones_like(children)  # labels have samples of their own
            move_state(optimizer, self.module, parents, k, shares, None if fresh is None else new)
        self._watch_optimizers("router.subdivide(..., optimizer=optimizer)", optimizer)
        return parents

    def _watch_optimizers(self, line: str, given: torch.optim.Optimizer | None = None) -> None:
        """Makes an optimiser with state of another number of cells raise at its next step; the error names ``line``."""
        for watch in self._watches:
            watch.remove()
        self._watches = watch_optimizers(self.module, line, given)

    @torch.inference_mode(False)
    @torch.no_grad()
    def load_state_dict(
        self,
        state_dict: Mapping[str, Any],
        strict: bool = True,
        assign: bool = False,
        *,
        optimizer: torch.optim.Optimizer | None = None,
    ) -> Any:
        """Loads a state with any number of cells. Parameter objects stay the same, so an optimiser keeps them.

        Args:
            state_dict: The ``state_dict()`` of a router around the same module.
            strict: See ``nn.Module``.
            assign: See ``nn.Module``; if True, parameters are new objects.
            optimizer: The optimiser that holds this router's parameters. If the number of cells changes, the
                optimiser's state is reset; restore it afterwards with ``optimizer.load_state_dict``. If an optimiser
                that holds state of the old cells is not passed, it raises at its next step.

        Returns:
            Missing and unexpected keys.

        Raises:
            TypeError: If the state is not a mapping, or one of its keys is not a string.
            ValueError: If the optimiser holds none of the router's parameters.
            RuntimeError: If the parameters have other shapes than the router's; the router is unchanged.
        """
        if not isinstance(state_dict, Mapping):
            raise TypeError(f"load_state_dict: state_dict must be a mapping, got {type(state_dict).__name__}")
        if other := [key for key in state_dict if not isinstance(key, str)]:
            raise TypeError(f"load_state_dict: state_dict must have strings as keys, got {other[0]!r:.60}")
        check_optimizer(optimizer, self.module, "load_state_dict")
        result = super().load_state_dict(state_dict, strict, assign)
        if optimizer is not None:
            drop_state(optimizer)
        return result

    @torch.inference_mode(False)
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Loads the stored diagram first, so that parameters of any number of cells fit."""
        if f"{prefix}diagram.centres" not in state_dict:
            names = self.module.state_dict().keys()
            if names and any(all(f"{prefix}{part}{name}" in state_dict for name in names) for part in ("", "module.")):
                raise ValueError(
                    f"VoronoiRouter.load_state_dict: state_dict is of a plain {type(self.module).__name__}, without "
                    "cells; load it into the module before wrapping it, or load the module into cells with "
                    "router.load_cell(i, module)"
                )
        else:
            diagram, k = VoronoiDiagram.from_state(state_dict, f"{prefix}diagram."), self.num_cells
            ours, strict = set(map(id, cell_parameters(self.module))), args[1]
            for name, parameter in self.module.named_parameters():
                wanted, value = [diagram.num_cells, *parameter.shape[1:]], state_dict.get(f"{prefix}module.{name}")
                if id(parameter) in ours and (strict if value is None else list(value.shape) != wanted):
                    actual = "nothing" if value is None else list(value.shape)
                    raise RuntimeError(
                        f"VoronoiRouter.load_state_dict: {prefix}module.{name} must have shape {wanted}, got {actual}"
                    )
            self.diagram = diagram.to(self.diagram.centres.device)
            if diagram.num_cells != k:
                renew_cells(self.module, torch.zeros(diagram.num_cells, dtype=torch.int64, device="cpu"))
                self._set_frozen(None)
                self._resized = True
                self._watch_optimizers("router.load_state_dict(state, optimizer=optimizer)")
        self._drop_frozen_checks()
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # Calls ------------------------------------------------------------------------------------------------------------

    def assign(self, positions: Tensor) -> Tensor:
        """Returns the cell that evaluates each position: positions [n, d] -> int32 [n]."""
        if self.assignment == "stochastic" and self.training and self.num_cells > 1:
            return self.diagram.sample_cell(
                positions, temperature=self.temperature, generator=self.generator, backend=self.backend
            )
        return self.diagram.locate(positions, backend=self.backend)

    def forward(self, *args: Any, coords: Tensor | None = None, cells: Tensor | None = None, **kwargs: Any) -> Any:
        """Evaluates each sample in its cell; results are in the order of the samples.

        Args:
            *args: The arguments of the module's ``forward``. A field with a ``program`` takes positions [n, 3] in scene
                units and directions, unit vectors [n, 3]. Directions may be [r, 3] instead, together with ray_index,
                int32 [n], the row of ``directions`` for each sample.
            coords: Positions [..., d] in scene units that choose the cells, instead of the router's own rule.
            cells: The cell of each sample, 0 to k - 1, int32 or int64 [...], instead of positions. On a GPU the check
                of the values waits for the device. In compiled and captured graphs the operations check labels: invalid
                ones raise on the CPU, and give results of 0 on a GPU. If the module's method has its own argument
                ``cells`` (or ``coords``), the value is passed to it and does not choose cells.
            **kwargs: The keyword arguments of the module's ``forward``.

        Returns:
            The module's results; for a radiance field (colour [n, 3], density [n]).

        Raises:
            ValueError: For shapes that disagree, for missing positions or directions, for arguments that are neither
                per sample nor per ray or could be both, and for labels that are missing or out of range.
            TypeError: For a module that mixes samples, or labels that are not integers.
        """
        return self._route("forward", args, kwargs, coords, cells)

    @property
    def _d(self) -> int:
        """The number of coordinates; 0 for a router without centres."""
        diagram: Any = self._modules["diagram"]  # attribute access is six times slower
        d: int = diagram._buffers["centres"].shape[1]
        return d

    def places(self, positions: Tensor, method: str | None = None) -> Cells:
        """Returns the assignment of samples to cells, with the mask of frozen cells, as the ops take it.

        Args:
            positions: Positions [..., d] in scene units, Gaussians [n, 6], means and variances, or labels,
                int32 [..., 1].
            method: The name of the called method. It reuses the cells that another of ``methods`` has found at the
                same positions. None to find the cells anew.
        """
        diagram: Any = self._modules["diagram"]
        k, centres, frozen = diagram.num_cells, diagram._buffers["centres"], self._buffers["frozen_cells"]
        self._run_training_checks()
        if method is not None and self.methods:
            return Cells(cells=self._group(method, positions).cells, frozen=frozen, k=k)
        if k == 1:
            return Cells(frozen=frozen, k=k)
        coords = positions if positions.dim() == 2 else positions.flatten(0, -2)
        if not coords.is_floating_point():
            return Cells(cells=coords[:, 0], frozen=frozen, k=k)
        d, drawn = centres.shape[1], self.assignment == "stochastic" and self.training
        coords = coords[:, :d] if coords.shape[1] > d else coords
        if drawn or d != 3:
            return Cells(cells=self.assign(coords.detach() if drawn else coords), frozen=frozen, k=k)
        if diagram.depth == 1:
            index = diagram.index() if k >= MANY_CELLS else None
            return Cells(centres=centres, coords=coords, centre_index=index, frozen=frozen, k=k)
        tree = {"child_offsets": diagram.child_offsets, "child": diagram.child, "depth": diagram.depth}
        return Cells(centres=centres, coords=coords, frozen=frozen, k=k, **tree)

    def program(self, *args: Tensor, trace: bool = False) -> CellProgram | str:
        """Returns the program (list of operations) of ``forward``, or the reason why it is unknown.

        A field's method ``program`` defines the program. For a module with ``fuse=True``, the program is known after
        the first call with arguments of the same types and sizes, which traces the module.

        Args:
            *args: Tensors [n, w] as ``forward`` gets them, n >= 2.
            trace: Whether to trace the module on these arguments if it has not been traced; needs n >= 8.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 2), torch.rand(4, 3), coords="first3", fuse=True)
            >>> router.program(torch.rand(8, 3))
            'Linear.forward is traced at its first call'
            >>> known = router.program(torch.rand(8, 3), trace=True)
            >>> [step.op for step in known.program.steps], known.shapes
            (['input', 'linear'], ((2,),))
        """
        if not self._d:
            return "labels decide the cells"
        if callable(self.coords) or isinstance(self.coords, slice):
            return "positions other than the samples' decide the cells"
        k, dispatch = self.num_cells, self._dispatch
        program = "" if self._field_program is None else self._field_program.with_activation(self.module)
        if isinstance(program, str) and (self.fuse or self._field_program is None):
            arguments = args if self._field_program is None else (*args, None)
            positions, device, grouping = args[0][:, : self._d], args[0].device, None
            if trace and self.fuse:
                cells = None if k == 1 else self.diagram.locate(positions, backend=self.backend)
                grouping = Grouping(cells, len(positions), k, device, self.backend)
            call = describe_call(self, "forward", positions, arguments, {})
            program = dispatch.program(call, grouping, device, k, self._options, self.backend)
        if isinstance(program, str) or k == 1:
            return program
        shapes = zip(program.parameters, program.program.parameters)
        return (
            program
            if any(p.shape[0] == k and p.dim() > len(shape) for p, shape in shapes)
            else "all cells share all parameters"
        )

    def note_dependencies(self, noted: Any) -> tuple[Any, ...]:
        """Adds attributes to the dependencies of a recorded training step, which is recorded again if one changes."""
        noted.entries(vars(self), ["assignment", "temperature", "backend", "coords"])
        return ()

    def explain(self) -> str:
        """Returns a line for each method: whether its calls ran fused, grouped or cell by cell, and why.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiRouter
            >>> router = VoronoiRouter(torch.nn.Linear(3, 2), torch.randn(4, 3), coords="first3")
            >>> router.explain()
            'forward: not called yet'
        """
        is_fused = self._field_program is not None and not isinstance(self._field_program.look(self.module), str)
        default_ways = {"forward": "fused"} if is_fused else {}
        return self._dispatch.explain(("forward", *self.methods), default_ways)

    def __setattr__(self, name: str, value: Any) -> None:
        """Sets an attribute; raises AttributeError for an attribute of the module, which is set on ``module``."""
        members = self.__dict__
        is_own = hasattr(type(self), name) or any(name in names for names in (members, self._modules, self._buffers))
        if "_field_program" in members and not is_own and hasattr(self.module, name):
            raise AttributeError(
                f"VoronoiRouter: {name} belongs to {type(self.module).__name__}; set router.module.{name}"
            )
        if name in _READ and "_dispatch" in members:
            self._dispatch.cached = {}
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        """Returns a routed method, or an attribute of ``nn.Module``."""
        for registry in ("_modules", "_buffers"):  # faster than ``super().__getattr__``
            if name in (entries := self.__dict__.get(registry, ())):
                return entries[name]
        methods = self.__dict__.get("methods", ())
        if name in methods:
            return functools.partial(self._routed, name)
        try:
            return super().__getattr__(name)
        except AttributeError:
            module = self.__dict__.get("_modules", {}).get("module")
            if module is None or name not in dir(module):
                raise
            has, place = f"VoronoiRouter: {name} of {type(module).__name__}", f"router.module.{name}"
            if not callable(inspect.getattr_static(module, name, None)):
                raise AttributeError(f"{has} is {place}, whose parameters are stacked, [k, ...]") from None
            raise AttributeError(
                f"{has} is not routed; pass methods={[*methods, name]!r} to the router if it evaluates samples, else "
                f"call {place}"
            ) from None

    def _routed(
        self, method: str, /, *args: Any, coords: Tensor | None = None, cells: Tensor | None = None, **kwargs: Any
    ) -> Any:
        return self._route(method, args, kwargs, coords, cells)

    def _route(
        self,
        method: str,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        coords: Any,
        cells: Tensor | None,
    ) -> Any:
        """Runs one call of a method. A call that is not in the cache causes a graph break in ``torch.compile``."""
        if cells is not None:
            args, kwargs, coords = with_labels(self, method, args, kwargs, coords, cells)
        compiles = torch.compiler.is_compiling()
        if self._resized and not compiles:
            self._check_wrapper()
        if method == "forward" and self._field_program is not None:
            results = self._field_program.run(self, args, kwargs, coords)
            if results is not None:
                return results
        cached: CachedCall | None = None
        if self.fuse:
            module: Any = self._modules["module"]
            key = call_key(method, module.training, args, kwargs, coords)
            cached = None if key is None else self._dispatch.find(key, compiles)
        if cached is not None and (results := cached.run(self, args, kwargs, coords, compiles)) is not None:
            return results
        if torch.compiler.is_exporting():
            raise RuntimeError(
                f"VoronoiRouter: torch.export needs a {method} that is fused whole and has run once; make the router "
                f"with fuse=True, and call it beforehand, with gradients on or off as in the export; {self.explain()}"
            )
        uncompiled = compiles or "torch._dynamo" in sys.modules
        run = self._route_uncompiled if uncompiled else self._route_as_it_is
        return run(method, args, kwargs, coords)

    def _check_wrapper(self) -> None:
        """Raises RuntimeError in a ``DistributedDataParallel`` that was made for parameters of other sizes."""
        wrapper: Any = nn.parallel.DistributedDataParallel._active_ddp_module
        if wrapper is None:
            return
        expected = wrapper._get_ddp_logging_data()["total_parameter_size_bytes"]
        if expected != sum(p.numel() * p.element_size() for p in wrapper._module_parameters if p.requires_grad):
            raise RuntimeError(
                "VoronoiRouter: DistributedDataParallel wraps the parameters of another number of cells; wrap "
                "the router again after subdivide or load_state_dict, on all ranks"
            )
        self._resized = False

    def _route_as_it_is(
        self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | Labels | None
    ) -> Any:
        """Arranges the arguments, runs the call, and restores the order and the shape of the results."""
        refuse_transforms()
        self._run_training_checks()
        if isinstance(coords, Labels):
            coords.ensure(self.num_cells)
        function = getattr(self.module, method)
        key = call_key(method, self.module.training, args, kwargs, coords) if self.fuse else None
        has_program = method == "forward" and self._field_program is not None
        if has_program and (expanded := each_direction(args, kwargs)) is not None:
            (args, kwargs), key = expanded, None
        placed = coords is not None and not isinstance(coords, Labels)
        if placed and "coords" in (accepted_names([function]) or ()):  # coords is an argument of the method
            kwargs, coords, key = {**kwargs, "coords": coords}, None, None
        positions = find_positions(self, args, kwargs, coords)
        call = describe_call(self, method, positions, args, kwargs)
        call.key = key
        grouping = self._group(method, positions)
        return self._dispatch.evaluate(call, grouping, self._options, self.frozen_cells).restored(call.layout)

    def _run_training_checks(self) -> None:
        """Warns in the first training calls if parameters are not trained; raises if frozen cells change."""
        if not self._training_checks or not torch.is_grad_enabled() or torch.compiler.is_compiling() or is_recorded():
            return
        going_on = [check for check in self._training_checks if not check.is_over(self._dispatch.warn_once)]
        if len(going_on) < len(self._training_checks):  # setting an attribute of a module takes 3 us
            self._training_checks = going_on

    def _drop_frozen_checks(self) -> None:
        """Drops the checks of frozen cells, whose set or values may change after this call."""
        self._training_checks = [check for check in self._training_checks if not isinstance(check, FrozenRows)]

    @property
    def _options(self) -> Options:
        return Options(self.fuse, self.way, bool(self.methods), self._names)

    _route_uncompiled = not_compiled(_route_as_it_is, _NO_GRAPH)

    def _group(self, method: str, positions: Tensor) -> Grouping:
        """Groups the samples by cell; methods that are called with the same positions share the grouping."""
        labelled, keeps = not positions.is_floating_point(), bool(self.methods) and not transformed()
        drawn = self.assignment == "stochastic" and self.training and not labelled
        centres = self.diagram.snapshot() if keeps and not labelled else None
        key = self.diagram, centres, drawn, labelled, self.temperature, self.backend
        assigned = self._assigned if keeps else None
        if assigned is not None and assigned.serves(method, positions, key, drawn):
            return assigned.grouping
        with outside(), torch.inference_mode(False):  # a later call with gradients may use the grouping
            positions = unwrapped(positions).detach()
            positions = positions.clone() if keeps else positions  # the caller may write into its labels
            flat, k = positions.flatten(0, -2), self.num_cells
            if flat.shape[0]:
                cells = None if k == 1 else flat[:, 0] if labelled else self.assign(flat)
            else:  # placeholders, since the module may not take an empty batch
                cells = torch.zeros(2, dtype=torch.int32, device=flat.device)
            grouping = Grouping(cells, flat.shape[0] or 2, k, flat.device, self.backend)
        if keeps:
            self._assigned = Assigned(grouping, positions, key, {method})
        return grouping

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_watches": [], "_training_checks": [], "_assigned": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        freeze_cells(self.module, self.frozen_cells)

    @torch.inference_mode(False)
    def __deepcopy__(self, memo: dict[int, Any]) -> VoronoiRouter:
        detach_results(self, memo)
        copied = memo[id(self)] = type(self).__new__(type(self))
        copied.__dict__.update({key: copy.deepcopy(value, memo) for key, value in self.__getstate__().items()})
        freeze_cells(copied.module, copied.frozen_cells)
        return copied

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> VoronoiRouter:
        self._dispatch.forget()
        self._assigned = None
        super()._apply(fn, recurse)
        self._training_checks = [Untrained(self.module)]
        freeze_cells(self.module, self.frozen_cells)
        return self

    def extra_repr(self) -> str:
        """Returns the line that ``print(router)`` shows above the submodules."""
        if not self._d:
            return f"num_cells={self.num_cells}, without centres"
        return f"num_cells={self.num_cells}, depth={self.diagram.depth}, assignment={self.assignment!r}"


def _diagram_of(cells: Any) -> VoronoiDiagram:
    """Makes the router's own diagram from a diagram, centres [k, d] or a number of cells."""
    count = None if isinstance(cells, bool) else cells
    if isinstance(count, numbers.Integral):
        return VoronoiDiagram.without_centres(int(count))
    if not isinstance(cells, (Tensor, VoronoiDiagram)):
        rule = "a VoronoiDiagram, centres [k, d] or a number of networks"
        raise TypeError(f"VoronoiRouter: diagram must be {rule}, got {cells!r:.60}")
    return copy.deepcopy(cells) if isinstance(cells, VoronoiDiagram) else VoronoiDiagram(cells)


def _refuse_places(coords: Any, assignment: str) -> None:
    """Raises ValueError for options about positions, in a router whose cells are chosen by labels."""
    if coords is not None:
        raise ValueError(f"VoronoiRouter: coords must be None without centres, since labels tell cells, got {coords!r}")
    if assignment != "nearest":
        raise ValueError(f"VoronoiRouter: assignment must be 'nearest' without centres, got {assignment!r}")


def _check_options(module: nn.Module, lists: dict[str, Any], **options: Any) -> None:
    """Raises ValueError or TypeError for a wrong option; ``lists`` are the options that must be lists, by name."""
    coords = options["coords"]
    rules = {
        "assignment": (options["assignment"] in ("nearest", "stochastic"), "'nearest' or 'stochastic'"),
        "temperature": (options["temperature"] > 0, "positive"),
        "layout": (options["layout"] in ("rays", "flat"), "'rays' or 'flat'"),
        "way": (options["way"] in ("fused", "grouped", "loop"), "'fused', 'grouped' or 'loop'"),
        "backend": (options["backend"] in ("auto", *BACKENDS), f"auto, {', '.join(BACKENDS)}"),
        "coords": (
            coords in (None, *COLUMNS) or isinstance(coords, slice) or callable(coords),
            "'first1' to 'first4', a slice or a function",
        ),
    }
    for name, (fits, rule) in rules.items():
        if not fits:
            raise ValueError(f"VoronoiRouter: {name} must be {rule}, got {options[name]!r}")
    for name, value in lists.items():
        if isinstance(value, (str, int)):
            raise TypeError(f"VoronoiRouter: {name} must be a list, got {value!r}")
    kind, methods = type(module).__name__, lists["methods"]
    for name in methods:
        if not callable(getattr(module, name, None)):
            raise ValueError(f"VoronoiRouter: methods must name methods of {kind}, got {name!r}")
        if hasattr(VoronoiRouter, name):
            raise ValueError(f"VoronoiRouter: methods must not name attributes of the router, got {name!r}")
    accepted = accepted_names(getattr(module, name) for name in ("forward", *methods))
    for item in (*(lists["per_ray"] or ()), *lists["shared"]):
        if isinstance(item, str) and accepted is not None and item.split(".")[0] not in accepted:
            raise ValueError(
                f"VoronoiRouter: per_ray and shared must name arguments of {kind}, one of {', '.join(accepted)}, "
                f"got {item!r}"
            )
