"""Nested Voronoi diagrams, which assign points of space to cells.

Letters: n points, k centres of one diagram, m centres of all diagrams of a tree, g diagrams (internal nodes) of a tree,
d coordinates, 1 to 4.

A diagram gives each point of space to its nearest centre, `v(x) = argmin_i |x - v_i|` (Elsner et al. 2023, "Adaptive
Voronoi NeRFs", section 3). A centre may be refined by another diagram, on any number of levels. A query descends level
by level to a leaf, which is a centre that is not refined. The leaves are the cells that own networks. They are numbered
depth-first, so the leaves of a refined cell are contiguous and take the place of their parent.

Coordinates are in scene units, in the world frame of the query points.
"""

import itertools
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from voronerf import ops
from voronerf.diagram.balance import balance, first_distinct, in_space, in_torch
from voronerf.diagram.drawing import draw_cell
from voronerf.ops._core import backends
from voronerf.ops._core.checks import check_integer
from voronerf.ops._core.unchanged import Values

MANY_CELLS = 2048
"""The minimum number of cells for which a flat diagram keeps a search index of its centres."""
_DECIDE, _DECIDE_CELL = 20_000, 4  # maximum number of points in `from_points`: in total or, if more, per cell


class VoronoiDiagram(nn.Module):
    """A Voronoi diagram of any depth, stored as flat tables that `ops.locate_cell` reads.

    No method changes a diagram in place: `refine` returns a new one. The buffers stay float32 when a module that holds
    the diagram is converted to another dtype, because rounded centres would move samples to networks that never saw
    them.

    Attributes:
        centres: float32 [m, d], the centres of all diagrams, diagram after diagram; diagram 0 is the root.
        child_offsets: int32 [g + 1]; diagram j owns rows `child_offsets[j] : child_offsets[j + 1]` of `centres`.
        child: int32 [m], an entry c for each centre; if c >= 0, diagram c refines the centre; if c < 0, the centre is
            leaf number `-c - 1`.
        depth: the number of levels; 1 for a flat diagram.
        num_cells: the number of leaves.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiDiagram
        >>> diagram = VoronoiDiagram(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]))
        >>> diagram.locate(torch.tensor([[0.2, 0, 0], [0.9, 5, 0]]))
        tensor([0, 1], dtype=torch.int32)
        >>> nested, parents = diagram.refine({1: torch.tensor([[0.8, 0, 0], [1.2, 0, 0]])})
        >>> nested
        VoronoiDiagram(cells=3, depth=2)
        >>> parents  # the old cell of each new one
        tensor([0, 1, 1])
        >>> nested.paths()  # the cell on each level; -1 where a branch ends sooner
        tensor([[ 0, -1],
                [ 1,  0],
                [ 1,  1]])
    """

    centres: Tensor
    child_offsets: Tensor
    child: Tensor
    depth: int
    num_cells: int
    _seen: Values | None = None  # the centres at the last call of `snapshot`
    _indexed: tuple[Values, Tensor | None] | None = None  # the centres of the index, and the index

    def __init__(self, centres: Tensor) -> None:
        """Makes a flat diagram. A single centre is allowed; its cell is all of space.

        Args:
            centres: floating [k, d], k >= 1, d = 1 to 4, finite; copied to float32.

        Raises:
            ValueError: a wrong shape, no centre, or a value that is not finite.
            TypeError: the centres are not a floating-point tensor.
        """
        super().__init__()
        _check_centres(centres)
        k = centres.shape[0]
        if k == 0:
            raise ValueError(f"VoronoiDiagram: centres must hold at least one centre, got {list(centres.shape)}")
        device = centres.device
        self._set_tables(
            centres.detach().to(torch.float32, copy=True).contiguous(),
            torch.tensor([0, k], dtype=torch.int32, device=device),
            -1 - torch.arange(k, dtype=torch.int32, device=device),
        )

    def _set_tables(self, centres: Tensor, child_offsets: Tensor, child: Tensor) -> None:
        self.depth, self.num_cells = _check_tree(centres, child_offsets, child)
        with torch.inference_mode(False):  # a training could not use inference tensors
            for name, table in zip(("centres", "child_offsets", "child"), (centres, child_offsets, child)):
                self.register_buffer(name, table.clone() if table.is_inference() else table)

    @classmethod
    def _from_tables(cls, centres: Tensor, child_offsets: Tensor, child: Tensor) -> "VoronoiDiagram":
        diagram = cls.__new__(cls)
        nn.Module.__init__(diagram)
        diagram._set_tables(centres, child_offsets, child)
        return diagram

    @classmethod
    def from_points(
        cls,
        points: Tensor,
        k: int,
        importance: Tensor | None = None,
        *,
        centres: str = "centroidal",
        generator: torch.Generator | None = None,
    ) -> "VoronoiDiagram":
        """Makes a flat diagram of k cells whose centres are placed by samples.

        Args:
            points: finite points, floating [..., d], in the coordinates of the field's positions; for example, the
                samples of a few training batches. At most max(20,000, 4 k) points are used, drawn at random.
            k: the number of cells, at most the number of distinct points.
            importance: floating [...], >= 0, the weight of each point; None for 1 each.
            centres: the method that places the centres, see `balance`.
            generator: the CPU generator for random draws; None for torch's global generator.

        Raises:
            ValueError: more cells than distinct points, or other arguments that `balance` refuses.
            TypeError: points or importance are not floating-point.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiDiagram
            >>> diagram = VoronoiDiagram.from_points(torch.rand(64, 32, 3), 8)  # rays of 32 samples
            >>> diagram
            VoronoiDiagram(cells=8, depth=1)
            >>> VoronoiDiagram.from_points(torch.rand(5000, 2), 16).locate(torch.rand(10, 2)).shape  # 2-D points
            torch.Size([10])
        """
        flat = points.detach().reshape(-1, points.shape[-1])
        weights = torch.ones_like(flat[:, 0]) if importance is None else importance.detach().reshape(-1)
        count = max(_DECIDE, _DECIDE_CELL * k)
        if len(flat) > count and len(weights) == len(flat):
            drawn = torch.randperm(len(flat), generator=generator, device="cpu")[:count].to(flat.device)
            enough = len(first_distinct(flat[drawn].float(), k)) >= k and bool((weights[drawn] > 0).any())
            if enough:  # otherwise all points are needed
                flat, weights = flat[drawn], weights[drawn]
        return cls(balance(flat, weights, k, centres=centres, generator=generator).centres)

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], prefix: str = "") -> "VoronoiDiagram":
        """Makes a diagram of any size and depth from a `state_dict`.

        Args:
            state: the state dict of a diagram, or of a module that holds a diagram under `prefix`.
            prefix: the part of the names before "centres", for example "diagram.".

        Raises:
            ValueError: a table is missing, or the tables do not form a tree.
        """
        names = ("centres", "child_offsets", "child")
        missing = [prefix + name for name in names if prefix + name not in state]
        if missing:
            raise ValueError(f"VoronoiDiagram: state must hold {', '.join(missing)}, got {len(state)} other entries")
        return cls._from_tables(*(state[prefix + name].detach().clone() for name in names))

    @classmethod
    def without_centres(cls, k: int) -> "VoronoiDiagram":
        """Makes a diagram of k cells without centres (`centres` [k, 0]), on the CPU; labels assign samples to cells.

        Args:
            k: the number of cells, at least 1.

        Raises:
            ValueError: k is below 1.
            TypeError: k is not an integer.

        Examples:
            >>> from voronerf import VoronoiDiagram
            >>> VoronoiDiagram.without_centres(8)
            VoronoiDiagram(cells=8, depth=1)
        """
        check_integer("VoronoiDiagram.without_centres", "k", k, 1)
        leaves = -1 - torch.arange(k, dtype=torch.int32, device="cpu")
        centres = torch.empty(k, 0, dtype=torch.float32, device="cpu")
        return cls._from_tables(centres, torch.tensor([0, k], dtype=torch.int32, device="cpu"), leaves)

    @property
    def leaf_rows(self) -> Tensor:
        """The row of each leaf in `centres`, int64 [num_cells]."""
        rows = torch.nonzero(self.child < 0).squeeze(1)
        return rows[torch.argsort(self.child[rows], descending=True)]

    @property
    def leaf_centres(self) -> Tensor:
        """The centre of each leaf, float32 [num_cells, d]."""
        return self.centres[self.leaf_rows]

    def paths(self) -> Tensor:
        """Returns the path to each leaf, int64 [num_cells, depth]: the number of the child on each level.

        The last number belongs to the leaf itself. Shorter paths of an uneven tree are padded with -1.
        `paths()[:, 0]` is the cell of the root diagram in which each leaf lies, useful as a colour in drawings.
        """
        offsets, child = self.child_offsets.tolist(), self.child.tolist()
        paths = torch.full((self.num_cells, self.depth), -1, dtype=torch.int64, device="cpu")
        pending: list[tuple[int, list[int]]] = [(0, [])]
        while pending:
            node, path = pending.pop()
            for row in range(offsets[node], offsets[node + 1]):
                here = [*path, row - offsets[node]]
                if child[row] >= 0:
                    pending.append((child[row], here))
                else:
                    paths[-child[row] - 1, : len(here)] = torch.tensor(here, device="cpu")
        return paths.to(self.centres.device)

    def locate(self, points: Tensor, *, backend: str = "auto") -> Tensor:
        """Finds the leaf in which each point lies.

        Args:
            points: floating [..., d]; half-precision points are compared in float32, float64 points in float64.
            backend: the backend of the op, see `voronerf.ops._core.backends`.

        Returns:
            int32 [...], leaf numbers. On each level, ties go to the lowest index, and points that are not finite to the
            first cell.

        Raises:
            ValueError: the last dimension of points is not d.
            TypeError: points are not floating.
        """
        flat = self._flatten("locate", points)
        dtype = torch.float64 if flat.dtype == torch.float64 else torch.float32
        flat, centres = flat.to(dtype), self.centres.to(dtype)
        if self.depth == 1:
            index = self.index() if dtype == torch.float32 else None
            cells = ops.nearest_centre(flat, centres, index=index, backend=backend)
        elif centres.shape[1] > 3:
            locate = in_torch("locate_cell", flat)
            cells = locate(flat, centres, self.child_offsets, self.child, self.depth)
        else:
            tree = in_space(centres), self.child_offsets, self.child
            cells = ops.locate_cell(in_space(flat), *tree, depth=self.depth, backend=backend)
        return cells.reshape(points.shape[:-1])

    def index(self) -> Tensor | None:
        """Returns an index of the centres (`voronerf.ops.index_centres`), which is cached for later calls.

        The index is rebuilt if centres have changed (:meth:`snapshot`).

        Returns:
            int32 [w]; None without the compiled module, for a nested diagram, fewer than `MANY_CELLS` cells, or centres
            that torch traces or transforms.
        """
        centres = self.centres
        if self.depth > 1 or self.num_cells < MANY_CELLS or centres.shape[1] == 0 or torch.compiler.is_compiling():
            return None
        if backends.compiled() is None:
            return None
        if type(centres) is not Tensor or centres.is_meta or torch._C._are_functorch_transforms_active():
            return None
        seen, kept = self.snapshot(), self._indexed
        if kept is None or kept[0] is not seen:
            with _disable_current_modes(), torch.inference_mode(False):  # keeps the index out of a recorded step
                values = seen.tensor if seen.copy is None else seen.copy
                kept = self._indexed = seen, ops.index_centres(values.detach().float().contiguous())
        return kept[1]

    def note_dependencies(self, noted: Any) -> tuple[Any, ...]:
        """Adds the index of the centres to a recorded training step's dependencies: a change causes a new recording."""
        noted.answer(self.index)
        return ()

    def snapshot(self) -> Values:
        """Returns a key for caches: an object that is replaced by another one when the centres have changed.

        On the CPU, all values are compared (12 bytes per centre). On a GPU, only the version counter and the address
        are compared, to avoid a wait for the device.
        """
        seen = self._seen
        if seen is None or seen.tensor is not self.centres or seen.changed():
            with _disable_current_modes():
                seen = self._seen = Values(self.centres, math.inf)
        return seen

    def sample_cell(
        self, points: Tensor, *, temperature: float, generator: torch.Generator | None = None, backend: str = "auto"
    ) -> Tensor:
        """Draws the leaf of each point at random; near centres are more likely (the paper's stochastic assignment).

        The paper draws the cell "from the vector of distances" and does not give the distribution. Here, on each level
        of the tree, child i of the current diagram is drawn with probability

            p_i = exp(-d_i / temperature) / sum_j exp(-d_j / temperature),     d_i = |x - v_i|.

        The probability of a leaf is the product of the probabilities along its path. The temperature is the same on
        every level. It is a length in scene units: about the width of the band along borders in which cells mix. A
        temperature of 0 gives the same leaves as `locate`. One uniform number in 0 to 1 is drawn for each point and
        level (`diagram.drawing`).

        Args:
            points: floating [..., d]; compared in float32.
            temperature: the temperature in scene units, >= 0.
            generator: a generator on any device; its numbers are moved to the device of `points`. None for torch's
                global generator.
            backend: see `voronerf.ops._core.backends`.

        Returns:
            int32 [...] leaf numbers.

        Raises:
            ValueError: the last dimension of points is not d, or the temperature is negative or not finite.
            TypeError: points are not floating.
        """
        if not 0.0 <= temperature < float("inf"):
            raise ValueError(f"sample_cell: temperature must be finite and at least 0, got {temperature}")
        if temperature == 0.0:
            return self.locate(points, backend=backend)
        flat = self._flatten("sample_cell", points).to(torch.float32)
        drawn_on = flat.device if generator is None else generator.device
        uniforms = torch.rand(flat.shape[0], self.depth, generator=generator, device=drawn_on, dtype=torch.float32)
        tables = self.centres, self.child_offsets, self.child
        cells = draw_cell(flat, *tables, uniforms.to(flat.device), temperature)
        return cells.reshape(points.shape[:-1])

    def refine(self, children: Mapping[int, "Tensor | VoronoiDiagram"]) -> tuple["VoronoiDiagram", Tensor]:
        """Returns a new diagram in which some leaves are refined.

        A leaf whose child has a single cell stays a leaf. Refining a diagram of a single cell returns the child itself,
        without an additional level.

        Args:
            children: a mapping from leaf numbers to the centres [k, d] of the diagram inside the leaf, or to a
                `VoronoiDiagram` of any depth.

        Returns:
            The refined diagram, and `parents`, int64 [new num_cells]: the old leaf in which each new leaf lies.

        Raises:
            ValueError: a leaf number out of range or twice, or centres that `VoronoiDiagram` does not accept.
            TypeError: a leaf that is not an integer, or centres that are not a tensor.
        """
        device = self.centres.device
        grafts: dict[int, VoronoiDiagram] = {}
        for key, value in children.items():
            leaf = operator.index(key)
            if not 0 <= leaf < self.num_cells:
                raise ValueError(f"refine: children must name leaves 0..{self.num_cells - 1}, got {leaf}")
            if leaf in grafts:
                raise ValueError(f"refine: children must name each leaf once, got {leaf} twice")
            graft = value if isinstance(value, VoronoiDiagram) else VoronoiDiagram(value)
            if (d := graft.centres.shape[1]) != self.centres.shape[1]:
                raise ValueError(f"refine: children must have centres [k, {self.centres.shape[1]}], got [k, {d}]")
            grafts[leaf] = graft

        counts = torch.ones(self.num_cells, dtype=torch.int64, device="cpu")
        for leaf, graft in grafts.items():
            counts[leaf] = graft.num_cells
        parents = torch.repeat_interleave(counts).to(device)
        if self.num_cells == 1 and grafts:
            graft = grafts[0]
            copies = (table.to(device, copy=True) for table in (graft.centres, graft.child_offsets, graft.child))
            return VoronoiDiagram._from_tables(*copies), parents

        # The rows and diagrams of the children are appended to the tables. The old rows and diagrams keep their
        # numbers; leaf numbers, and the row and diagram numbers of the children, have to be shifted.
        first_leaf = (counts.cumsum(0) - counts).to(device, torch.int32)
        child = torch.where(self.child < 0, -1 - first_leaf[(-1 - self.child).clamp(min=0)], self.child)
        leaf_rows = self.leaf_rows.tolist()
        tables, offsets_all, links = [self.centres], [self.child_offsets], [child]
        rows, nodes = self.centres.shape[0], self.child_offsets.shape[0] - 1
        for leaf, graft in sorted(grafts.items()):
            if graft.num_cells == 1:
                continue
            inner = graft.child.to(device)
            child[leaf_rows[leaf]] = nodes
            links.append(torch.where(inner < 0, inner - first_leaf[leaf], inner + nodes))
            offsets_all.append(graft.child_offsets[1:].to(device) + rows)
            tables.append(graft.centres.to(device))
            rows, nodes = rows + graft.centres.shape[0], nodes + graft.child_offsets.shape[0] - 1
        return VoronoiDiagram._from_tables(torch.cat(tables), torch.cat(offsets_all), torch.cat(links)), parents

    def part(self, cells: Tensor) -> "VoronoiDiagram":
        """Returns a diagram with only some of the cells. Points in these cells stay in the same cells.

        Args:
            cells: int64 [c], ascending cell numbers, at least one; they become 0 to c - 1.

        Raises:
            ValueError: no cells, cells out of range, or cells that do not ascend.

        Examples:
            >>> import torch
            >>> from voronerf import VoronoiDiagram
            >>> diagram = VoronoiDiagram(torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]))
            >>> diagram.part(torch.tensor([0, 2])).locate(torch.tensor([[0.2, 0, 0], [1.9, 0, 0]]))
            tensor([0, 1], dtype=torch.int32)
        """
        wanted = cells.tolist()
        if not wanted or not 0 <= wanted[0] <= wanted[-1] < self.num_cells or wanted != sorted(set(wanted)):
            raise ValueError(f"part: cells must be ascending numbers of 0..{self.num_cells - 1}, got {wanted}")
        offsets, child, number = self.child_offsets.tolist(), self.child.tolist(), {c: i for i, c in enumerate(wanted)}
        rows: list[list[int]] = [[] for _ in offsets[1:]]
        for node in reversed(range(len(rows))):  # a refined centre comes before the diagram that refines it
            for row in range(offsets[node], offsets[node + 1]):
                if -child[row] - 1 in number if child[row] < 0 else rows[child[row]]:
                    rows[node].append(row)
        nodes = {node: i for i, node in enumerate(node for node, node_rows in enumerate(rows) if node_rows)}
        kept = [row for node_rows in rows for row in node_rows]
        links = [nodes[child[row]] if child[row] >= 0 else -1 - number[-child[row] - 1] for row in kept]
        ends = torch.tensor([0, *(len(node_rows) for node_rows in rows if node_rows)], device="cpu")
        device = self.centres.device
        table = torch.tensor(links, dtype=torch.int32, device=device)
        return VoronoiDiagram._from_tables(self.centres[kept], ends.cumsum(0).to(device, torch.int32), table)

    def extra_repr(self) -> str:
        """Returns the text that `print` shows in parentheses."""
        return f"cells={self.num_cells}, depth={self.depth}"

    def _flatten(self, op: str, points: Tensor) -> Tensor:
        d = self.centres.shape[1]
        if d == 0:
            raise ValueError(f"{op}: a diagram without centres cannot locate points; pass labels")
        if points.dim() == 0 or points.shape[-1] != d:
            raise ValueError(f"{op}: points must have shape [..., {d}], got {list(points.shape)}")
        if not points.is_floating_point():
            raise TypeError(f"{op}: points must be floating-point, got {points.dtype}")
        return points.detach().reshape(-1, d)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_seen": None, "_indexed": None}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "VoronoiDiagram":
        kept = self.centres
        super()._apply(fn, recurse)
        if self.centres.dtype != kept.dtype:
            self.centres = kept.to(self.centres.device)
        return self

    @torch.inference_mode(False)
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Loads a diagram of any size and depth; torch would refuse another size."""
        if prefix + "centres" in state_dict:
            device = self.centres.device
            loaded = VoronoiDiagram.from_state(state_dict, prefix)
            self._set_tables(loaded.centres.to(device), loaded.child_offsets.to(device), loaded.child.to(device))
        super()._load_from_state_dict(state_dict, prefix, *args)


def _check_centres(centres: Tensor, least: int = 1) -> None:
    """Raises ValueError or TypeError unless centres [k, d] are floating and finite, with d from `least` to 4."""
    if not isinstance(centres, Tensor) or not centres.is_floating_point():
        got = centres.dtype if isinstance(centres, Tensor) else type(centres).__name__
        raise TypeError(f"VoronoiDiagram: centres must be a floating-point tensor, got {got}")
    if centres.dim() != 2 or not least <= centres.shape[1] <= 4:
        raise ValueError(f"VoronoiDiagram: centres must have shape [k, d], d = 1 to 4, got {list(centres.shape)}")
    if not bool(torch.isfinite(centres).all()):
        raise ValueError("VoronoiDiagram: centres must be finite, got NaN or infinity")


def _check_tree(centres: Tensor, child_offsets: Tensor, child: Tensor) -> tuple[int, int]:
    """Checks the tables of a tree, which may come from a damaged file; returns its depth and number of leaves."""

    def refuse(rule: str) -> ValueError:
        return ValueError(f"VoronoiDiagram: tables of a tree must {rule}")

    _check_centres(centres, 0)
    m = centres.shape[0]
    if any(table.dtype != torch.int32 or table.dim() != 1 for table in (child_offsets, child)):
        raise refuse("hold child_offsets and child as int32 vectors")
    offsets, links = child_offsets.tolist(), child.tolist()
    if len(links) != m or len(offsets) < 2 or offsets[0] != 0 or offsets[-1] != m:
        raise refuse(f"cover all {m} centres, got {len(links)} links and offsets {offsets[:1]}..{offsets[-1:]}")
    if any(a >= b for a, b in itertools.pairwise(offsets)):
        raise refuse("give every diagram at least one centre")

    depth, leaf = 0, 0
    seen = [False] * (len(offsets) - 1)
    # Rows are pushed in reverse, to visit leaves in the order of their numbers: depth-first, first child first.
    stack = [(row, 1) for row in reversed(range(offsets[0], offsets[1]))]
    seen[0] = True
    while stack:
        row, level = stack.pop()
        depth = max(depth, level)
        link = links[row]
        if link < 0:
            if link != -1 - leaf:
                raise refuse(f"number the leaves depth-first, got {-1 - link} where {leaf} was due")
            leaf += 1
            continue
        if link >= len(seen) or seen[link]:
            raise refuse(f"refer to each diagram once, got diagram {link} of {len(seen)} again or out of range")
        seen[link] = True
        stack += [(inner, level + 1) for inner in reversed(range(offsets[link], offsets[link + 1]))]
    if not all(seen):
        raise refuse("reach every diagram from the root")
    return depth, leaf
