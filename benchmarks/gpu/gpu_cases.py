"""Cases of ``gpu_parts.py``: every operation against float64, and training steps in CUDA graphs."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

CHECKED = (
    *("adam", "composite packed", "march_rays", "draw_pixels", "grouped_mlp hashed", "routed_mlp nested"),
    *(
        "spherical_harmonics",
        "hash_encode features=8",
        "locate_cell",
        "nearest_centre k=700",
        "nearest_centre k=700, indexed=True",
        "observe_occupancy",
    ),
    *("pixel_rays", "render_loss", "resample", "cell_sort 5000 3 by counting", "cell_sort 20000 4096 by automatic"),
    *("grouped_mlp wide tf32", "grouped_mlp skips bfloat16 forward", "unaligned views"),
    "grouped_mlp of a hash grid for each cell bfloat16",
)
"""Small cases that memcheck runs; they use nearly all kernels."""
RACING = (
    *("cell_sort 5000 3 by counting", "cell_sort 4200 1022 by counting", "composite packed", "march_rays", "resample"),
    *("render_loss", "grouped_mlp branched bfloat16", "grouped_mlp wide tf32", "grouped_mlp broad float32"),
    *("routed_mlp", "nearest_centre k=700", "nearest_centre k=700, indexed=True", "spherical_harmonics", "adam"),
)
"""Small cases that racecheck and synccheck run; they use every kernel with shared memory."""

STEPS: dict[str, tuple[int, str, bool, int]] = {
    "width 64": (64, "float32", False, 8),
    "width 64, bfloat16": (64, "bfloat16", False, 8),
    "width 64, directions by an index": (64, "float32", True, 8),
    "width 700, beyond shared memory": (700, "float32", False, 2),
    "width 300, bfloat16, directions by an index": (300, "bfloat16", True, 8),
    "many cells, sorted by radix": (16, "float32", False, 1030),
}
"""Steps to capture: width, type of the weights, whether there are directions, and number of cells."""


def near(one: Any, other: Any, allowed: float = 1e-5, absolute: float = 1e-6) -> None:
    """Raises AssertionError unless two tensors are close; NaN is never close.

    The norm of the difference may be ``allowed`` times the norm of ``other``, plus ``absolute``.
    """
    difference, size = float((one.double() - other.double()).norm()), float(other.double().norm())
    if not difference <= allowed * size + absolute:
        raise AssertionError(f"{list(one.shape)}: off by {difference:.1e} of {size:.1e}, allowed {allowed:.0e}")


def small_cases(device: str) -> list[tuple[str, Callable[[], None]]]:
    """Returns the names of the cases and their check functions, which raise on errors."""
    import torch
    from cases import CASES, Draw
    from emulated_networks import (
        ALLOWED,
        BRANCHED,
        BROAD,
        DENSE,
        GAUSSIANS,
        HARMONICS,
        NARROW,
        SKIPS,
        THICK,
        WIDE,
        check,
        check_forward,
    )
    from torch.utils._pytree import tree_leaves, tree_map_only

    import voronerf
    from voronerf.nerf.fields import NeRF
    from voronerf.ops._core import backends
    from voronerf.ops._core.layers import MLP, POSITIONS, Layer
    from voronerf.ops.cell_sort.native import sort as sort_cells
    from voronerf.ops.cell_sort.reference import cell_sort as specified

    where = torch.device(device)

    def of_case(op: str, pins: dict[str, Any]) -> None:
        """Compares a call of the op's declared case with the reference, in float64 if the op has gradients."""
        case, outcomes = CASES[op], []
        made = case.make(Draw(1, **pins), 200)
        for backend in ("native", "reference"):
            wide = case.differentiable and backend == "reference"
            double = lambda x, wide=wide: x.double() if wide and x.is_floating_point() else x  # noqa: E731
            given = tree_map_only(torch.Tensor, lambda x, cast=double: cast(x.to(where, copy=True)), made)
            leaves = [x for x in tree_leaves(given) if isinstance(x, torch.Tensor) and x.is_floating_point()]
            for leaf in leaves if case.differentiable else ():
                leaf.requires_grad_()
            out = getattr(voronerf.ops, case.call or op)(**given, backend=backend)
            found = [x for x in tree_leaves(given if case.in_place else out) if isinstance(x, torch.Tensor)]
            smooth = [x for x in found if x.requires_grad]
            if smooth:
                total = sum((x * torch.linspace(0.5, 1.5, x.numel(), device=where).view_as(x)).sum() for x in smooth)
                found += torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
            outcomes.append(found)
        for one, other in zip(*outcomes, strict=True):
            if case.differentiable:
                near(one, other)
            else:
                torch.testing.assert_close(one, other, rtol=1e-5, atol=2e-6, equal_nan=True)

    def sort(n: int, k: int, way: str) -> None:
        # Some indices are not cells; they are sorted to the ends.
        cells = torch.randint(-1, k + 1, (n,), dtype=torch.int32, device=where)
        expected = specified(cells.cpu().clamp(-1, k) + 1, k + 2)
        order, offsets = torch.full_like(cells, -7), cells.new_full((k + 1,), -7)
        sort_cells(cells, order, offsets, "cell_sort", way)
        assert torch.equal(order.cpu(), expected[0]) and torch.equal(offsets.cpu(), expected[1][1:-1])

    def close(run: Callable[..., Any], leaves: list[Any]) -> None:
        """Compares results and gradients with the reference in float64."""
        outcomes = []
        for backend, dtype in (("native", torch.float32), ("reference", torch.float64)):
            given = [leaf.to(where, dtype).requires_grad_() for leaf in leaves]
            out = run(given, backend)
            parts = [part for part in (out if isinstance(out, tuple) else (out,)) if part.is_floating_point()]
            total = sum(
                (part * torch.linspace(0.5, 1.5, part.numel(), device=where).view_as(part)).sum() for part in parts
            )
            outcomes.append([*parts, *torch.autograd.grad(total, given, allow_unused=True, materialize_grads=True)])
        for part, exact in zip(*outcomes):
            near(part, exact)

    def shifted(tensor: Any) -> Any:
        """Returns a copy that starts one element into its memory, so that vector loads are misaligned."""
        return torch.cat([tensor.new_zeros(1), tensor.flatten()])[1:].view(tensor.shape)

    def route(view: Callable[[Any], Any] = lambda tensor: tensor) -> None:
        layers = WIDE
        shapes = layers.weight_shapes(3)
        centres = torch.rand(5, 3)

        def run(x: list[Any], backend: str) -> Any:
            options: dict[str, Any] = {"centres": view(centres.to(where)), "layers": layers, "backend": backend}
            x = [view(part) for part in x]
            return voronerf.routed_mlp(x[0], x[1:], [None] * len(shapes), **options)[0]

        close(run, [torch.rand(300, 3), *(torch.randn(5, o, i) / i**0.5 for o, i in shapes)])

    def hashed(precision: str, own: bool) -> None:
        """Checks a network with a hash grid for each cell (``own``) or for all cells."""
        grid = voronerf.HashGrid(levels=8, features=2, log2_entries=11, finest=60)
        rest = MLP((Layer((POSITIONS,), 32, "relu"), Layer((0,), 4)), (1,))
        layers = replace(rest, position_encoding="hash", grid=grid)
        kind, offsets = getattr(torch, precision), torch.tensor([0, 90, 90, 200], dtype=torch.int32, device=where)
        cells = torch.tensor([0] * 90 + [2] * 110, dtype=torch.int32, device=where)
        x, table = torch.rand(200, 3, device=where), torch.randn(*[3] * own, *grid.table_shape, device=where)
        weights = [(torch.randn(3, o, i, device=where) / i**0.5).to(kind) for o, i in layers.weight_shapes(3)]
        given = [leaf.requires_grad_() for leaf in (x, table, *weights)]
        inside = voronerf.grouped_mlp(
            x, offsets, weights, [None] * 2, layers=layers, features=table, backend="native"
        ).float()
        features = voronerf.hash_encode(x, table, grid, cells=cells if own else None, backend="reference")
        before = voronerf.grouped_mlp(features, offsets, weights, [None] * 2, layers=rest, backend="reference").float()
        size = 1e-5 if precision == "float32" else 3e-2
        torch.testing.assert_close(inside, before, rtol=size, atol=size * float(before.detach().abs().max()))
        pairs = zip(*(torch.autograd.grad(out.square().sum(), given) for out in (inside, before)), strict=True)
        for one, other in pairs:
            near(one, other, size, 0.0)

    def views() -> None:
        """Checks misaligned inputs of frequency_encode, composite and cell_sort."""
        close(lambda x, b: voronerf.frequency_encode(shifted(x[0]), 10, backend=b), [torch.rand(90, 3)])
        close(
            lambda x, b: tuple(voronerf.composite(*map(shifted, x), backend=b)),
            [torch.rand(6, 30), torch.rand(6, 30, 3), torch.rand(6, 30).cumsum(1), torch.rand(6, 30)],
        )
        cells = shifted(torch.randint(0, 5, (300,), dtype=torch.int32, device=where))
        found, expected = (voronerf.cell_sort(cells, 5, backend=b) for b in ("native", "reference"))
        assert all(torch.equal(a, b) for a, b in zip(found, expected))

    def beyond_float16() -> None:
        """Checks that layer inputs are clamped to float16's range, while gradients overflow for a GradScaler to see."""
        layers = MLP((Layer((POSITIONS,), 16, "relu"), Layer((0,), 16, "relu"), Layer((1,), 3)), (2, 0))
        sizes = layers.weight_shapes(3)
        leaves = [torch.ones(40, 3), *(torch.randn(2, o, i) / (1 if i == 3 else 64) for o, i in sizes)]
        leaves[0][::8] = 1e6
        leaves[1][:, ::2] = leaves[1][:, ::2].abs()  # some sums are large for any signs of the other weights
        leaves = [leaf.to(where).requires_grad_() for leaf in leaves]
        offsets = torch.tensor([0, 23, 40], dtype=torch.int32, device=where)
        halves = [leaf.half() for leaf in leaves[1:]]
        out = voronerf.grouped_mlp(leaves[0], offsets, halves, [None] * 3, layers=layers, backend="native")
        assert not out.isnan().any() and out[:, 3:].isinf().any() and out[:, :3].isfinite().all()
        gradients = torch.autograd.grad(out, leaves, torch.ones_like(out), retain_graph=True)
        assert not any(gradient.isnan().any() for gradient in gradients)
        overflowing = torch.autograd.grad(out, leaves, torch.full_like(out, 6e4))
        assert not all(gradient.isfinite().all() for gradient in overflowing)

    def network(layers: Any, counts: list[int], d: int, precision: str) -> None:
        with where:
            check(layers, counts, d, precision)

    def forward(layers: Any, precision: str) -> None:
        with where:
            check_forward(layers, [37, 0, 60], 3, precision)

    networks = {"branched": (BRANCHED, 3), "wide": (WIDE, 7), "gaussians": (GAUSSIANS, 6), "broad": (BROAD, 3)}
    networks |= {"harmonics": (HARMONICS, 3)}
    cases: list[tuple[str, Callable[[], None]]] = [
        *(
            (f"{op} {kind}".strip(), functools.partial(of_case, op, pins))
            for op in backends.ops("native", "cuda")
            if CASES[op].comparable
            for kind, pins in (
                *CASES[op].kinds.items(),
                *((", ".join(f"{name}={value}" for name, value in p.items()), p) for p in CASES[op].on_devices),
            )
        ),
        *(
            (f"cell_sort {n} {k} by {way}", functools.partial(sort, n, k, way))
            for n, k, way in (
                (5000, 3, "counting"),
                (4200, 1022, "counting"),
                (5000, 3, "radix"),
                (20_000, 4096, "automatic"),
                (300, 65_535, "automatic"),
                (0, 4096, "automatic"),
            )
        ),
        *(
            (f"grouped_mlp {name} {precision}", functools.partial(network, layers, [70, 0, 1, 40], d, precision))
            for name, (layers, d) in networks.items()
            for precision in ALLOWED
        ),
        *(
            (f"grouped_mlp {name} {precision} forward", functools.partial(forward, layers, precision))
            for name, layers, precision in (
                ("skips", SKIPS, "bfloat16"),
                ("skips", SKIPS, "float16"),
                ("nerf64", NeRF(width=64).layers, "bfloat16"),
                ("thick", THICK, "bfloat16"),
                ("narrow", NARROW, "bfloat16"),
            )
        ),
        ("grouped_mlp dense float32", functools.partial(network, DENSE, [37, 3], 3, "float32")),
        ("grouped_mlp beyond float16", beyond_float16),
        *(
            (
                f"grouped_mlp of a hash grid{' for each cell' * own} {precision}",
                functools.partial(hashed, precision, own),
            )
            for own in (False, True)
            for precision in ("float32", "bfloat16")
        ),
        ("routed_mlp wide", route),
        ("routed_mlp of unaligned views", functools.partial(route, shifted)),
        ("unaligned views", views),
    ]
    return cases


def captured_steps(device: str, n: int = 4096, replays: int = 3) -> list[tuple[str, Callable[[], None]]]:
    """Returns (name, check) pairs: replayed steps give the results of the eager step, which match the reference."""
    return [(name, functools.partial(_replay, settings, device, n, replays)) for name, settings in STEPS.items()]


def _replay(settings: tuple[int, str, bool, int], device: str, n: int, replays: int) -> None:
    import torch
    from gpu_journal import settling

    from voronerf.ops._core.capture import Capture

    step = _step(*settings, device, n)
    expected = [part.clone() for part in step()]
    # Rounding switches ReLU units, which changes gradients by up to 3e-4 in float32, on a CPU too.
    allowed = 1e-3 if settings[1] == "float32" else 8e-2
    for part, exact in zip(expected, step("reference", torch.float64), strict=True):
        near(part, exact, allowed, 1e-7)
    captured = Capture(torch.device(device), torch.Generator(device))
    captured.warm_up(step)
    assert captured.obstacle is None, captured.obstacle
    found, settle = captured.capture(step), settling(device)
    for _ in range(replays):
        for part in found:
            part.zero_()
        captured.replay(1)
        settle()
        assert all(torch.equal(a, b) for a, b in zip(expected, found, strict=True)), "a replay is not the step itself"


def _step(width: int, dtype: str, directed: bool, k: int, device: str, n: int) -> Callable[..., list[Any]]:
    """Returns a step: nearest centre, sort, networks, and the gradients of their parameters."""
    import torch

    import voronerf
    from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

    kind = getattr(torch, dtype)
    last = Layer((1, DIRECTIONS) if directed else (1,), 4)
    layers = MLP((Layer((POSITIONS,), width, "relu"), Layer((0,), width, "relu"), last), (2,), 10, 4)
    shapes = layers.weight_shapes(3, 3 if directed else 0)
    weights = [(torch.randn(k, o, i) / i**0.5).to(device, kind).requires_grad_() for o, i in shapes]
    biases = [torch.zeros(k, o, dtype=kind, device=device, requires_grad=True) for o, _ in shapes]
    options: dict[str, Any] = {"layers": layers, "centres": torch.rand(k, 3).to(device)}
    points = torch.rand(n, 3).to(device)
    if directed:
        options["directions"] = torch.nn.functional.normalize(torch.randn(16, 3), dim=1).to(device)
        options["direction_index"] = torch.randint(0, 16, (n,), dtype=torch.int32).to(device)

    def step(backend: str = "native", dtype: Any = None) -> list[Any]:
        """Returns the gradients; all inputs are converted to ``dtype``, if it is given."""

        def cast(value: Any) -> Any:
            return value.to(dtype) if isinstance(value, torch.Tensor) and value.is_floating_point() else value

        given, leaves = {"positions": points, **options}, [*weights, *biases]
        if dtype is not None:
            given = {name: cast(value) for name, value in given.items()}
            leaves = [cast(leaf.detach()).requires_grad_() for leaf in leaves]
        given |= {"weights": leaves[: len(shapes)], "biases": leaves[len(shapes) :]}
        out, _ = voronerf.routed_mlp(**given, backend=backend)
        return list(torch.autograd.grad((out if dtype else out.float()).square().mean(), leaves))

    return step


def captured_trainings(device: str, count: int = 20, **small: Any) -> list[tuple[str, Callable[[], str]]]:
    """Returns (name, check) pairs: trainings with replayed graphs give the results of eager trainings."""
    whole: dict[str, Any] = {"cells": (), "split_at": ()}
    kinds = {"training": whole, "training of a nerf": {**whole, "field": "nerf"}, "training before a split": {}}
    kinds["training in bfloat16"] = {"precision": "bf16"}
    return [(name, functools.partial(_train_both, {**own, **small}, device, count)) for name, own in kinds.items()]


def _train_both(options: dict[str, Any], device: str, count: int) -> str:
    """Compares a training that replays graphs with an eager training.

    Their results may differ by 1 %, since atomic sums of hash grid gradients have no fixed order.
    """
    import torch
    from gpu_journal import settling

    from voronerf.app.scenes import builtin_scene
    from voronerf.app.train import TrainConfig, build

    found, milliseconds, settle = list[torch.Tensor](), list[float](), settling(device)
    for as_it_is in (True, False):
        torch.manual_seed(0)
        state = build(TrainConfig(device=device, steps=1000, evaluations=1, **options), builtin_scene(32))
        step, losses, begin = state.training_step, list[torch.Tensor](), 0.0
        if as_it_is:
            step.__dict__["_standing_obstacle"] = lambda: "it is asked to"
        for number in range(3 + count):  # a warm-up step, a captured step, and a first replay
            if number == 3:
                settle()
                begin = time.perf_counter()
            state.optimizer.set_learning_rate(1e-4 * (1 + number))
            losses.append(step(state.rays).loss.clone())
        settle()
        milliseconds.append(1e3 * (time.perf_counter() - begin) / count)
        assert as_it_is or "CUDA graph" in step.explain(), step.explain()
        parts = [torch.stack(losses), *state.router.parameters()]
        found.append(torch.cat([part.detach().reshape(-1) for part in parts]))
    expected, replayed = found
    difference = float((replayed - expected).norm() / expected.norm())
    assert difference <= 1e-2, f"replays differ by {difference:.1e}"
    said = "the same bits" if torch.equal(expected, replayed) else f"within {difference:.1e}"
    return f"{milliseconds[0]:.3f} ms a step as it is, {milliseconds[1]:.3f} ms as a graph, {said}"
