"""Networks for the tests of the emulated CUDA kernels, and the comparison of their results with float64."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

import voronerf
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

KIB = 1024
# Allowed relative errors (Frobenius norm) by the precision of products.
ALLOWED = {"float32": 3e-6, "tf32": 3e-3, "float16": 3e-3, "bfloat16": 2.5e-2}

# A network with smooth activations, which rounding does not switch, all kinds of sources, and outputs of middle layers.
BRANCHED = MLP(
    (
        Layer((POSITIONS,), 24, "sine"),
        Layer((0,), 33, "softplus"),
        Layer((1, POSITIONS), 32, "sigmoid"),
        Layer((2,), 1, "softplus"),
        Layer((2, DIRECTIONS), 17, "softplus"),
        Layer((0,), 5, "relu"),  # unused
        Layer((4,), 3, "sigmoid"),
    ),
    (6, 3),
    position_octaves=2,
    direction_octaves=1,
)
WIDE = MLP((Layer((POSITIONS,), 130, "sine"), Layer((0, POSITIONS), 70, "sigmoid"), Layer((1,), 4)), (2,))
GAUSSIANS = MLP((Layer((POSITIONS,), 16, "sigmoid"), Layer((0,), 2)), (1,), 3, position_encoding="integrated")
# A network whose first and last layers read harmonics of the directions; degree 3 leaves some padding columns.
HARMONICS = MLP(
    (Layer((POSITIONS, DIRECTIONS), 24, "softplus"), Layer((0, DIRECTIONS), 5)),
    (1,),
    position_octaves=2,
    direction_encoding="spherical",
    direction_degree=3,
)

# A network of nineteen densely connected layers: more layers and sources than the fused kernel takes.
DENSE = MLP(
    (*(Layer((POSITIONS, *range(index)), 5 + index % 3, "softplus") for index in range(18)), Layer((17, 3), 2)),
    (18, 4, 4),
)
BROAD = MLP((Layer((POSITIONS,), 270, "sigmoid"), Layer((0, POSITIONS), 300, "sine"), Layer((1,), 3)), (2,), 2)

# A network whose ReLU outputs are read by a much later layer, by two layers, beside other values in one layer, and
# while another value is live. A layer has two chunks of outputs, and one chunk is narrow. Encodings are read twice. The
# network returns its last layer (twice), a ReLU layer and a sigmoid layer.
SKIPS = MLP(
    (
        Layer((POSITIONS,), 100, "relu"),
        Layer((0,), 20, "sine"),
        Layer((1, 0), 66, "relu"),
        Layer((2, DIRECTIONS, 1, POSITIONS), 40, "softplus"),
        Layer((3, 3), 7, "sigmoid"),
        Layer((4, 0, DIRECTIONS), 9),
    ),
    (5, 2, 4, 5),
    position_octaves=5,
    direction_octaves=2,
)

# A chain of layers of 128 features, whose weights exceed a block's shared memory and are loaded in pieces.
THICK = MLP(
    (Layer((POSITIONS,), 128, "relu"), *(Layer((index,), 128, "relu") for index in range(7)), Layer((7, POSITIONS), 4)),
    (8,),
    position_octaves=10,
)

# A network of 32 features, for the kernel with the fewest registers.
NARROW = MLP((Layer((POSITIONS,), 32, "relu"), Layer((0,), 32, "relu"), Layer((1,), 4, "sigmoid")), (2,), 10)


def case(layers: MLP, counts: list[int], d: int, dtype: torch.dtype = torch.float32) -> dict:
    """Draws float64 arguments with values that `dtype` represents exactly."""
    n, k = sum(counts), len(counts)
    directions = torch.rand(4, 3) if layers.uses_directions else None
    shapes = layers.weight_shapes(d, 3 if directions is not None else 0)
    parts = {
        "positions": torch.rand(n, d),
        "weights": [torch.randn(k, o, i) / i**0.5 for o, i in shapes],
        "biases": [torch.randn(k, o) / 4 if index % 3 != 1 else None for index, (o, _) in enumerate(shapes)],
        "directions": directions,
    }

    def rounded(value):
        if isinstance(value, list):
            return [rounded(entry) for entry in value]
        return None if value is None else value.to(dtype).double()

    given = {name: rounded(value) for name, value in parts.items()}
    given["offsets"] = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    given["direction_index"] = None if directions is None else torch.randint(0, 4, (n,), dtype=torch.int32)
    return given


@functools.cache
def wave(*shape: int) -> Tensor:
    """Returns a cached gradient, since PyTorch's first sine in a process is off by 1e-4 on the second thread."""
    return torch.linspace(-1, 1, math.prod(shape)).reshape(shape).sin()


def run(
    arguments: dict,
    layers: MLP,
    dtype: torch.dtype,
    backend: str,
    gradient: Tensor | None = None,
    differentiates: bool = True,
) -> list[Tensor]:
    """Returns the output and, if ``differentiates``, all gradients for ``gradient`` (default: a sine wave)."""
    leaves: list[Tensor] = []

    def leaf(value):
        if isinstance(value, list):
            return [leaf(entry) for entry in value]
        if value is None:
            return None
        leaves.append(value.to(dtype).requires_grad_())
        return leaves[-1]

    named = {name: leaf(arguments[name]) for name in ("positions", "weights", "biases", "directions")}
    options = {"layers": layers, "directions": named["directions"], "direction_index": arguments["direction_index"]}
    parameters = named["weights"], named["biases"]
    out = voronerf.grouped_mlp(named["positions"], arguments["offsets"], *parameters, **options, backend=backend)
    if not differentiates:
        return [out]
    if gradient is None:
        gradient = wave(*out.shape)
    return [out, *torch.autograd.grad(out, leaves, gradient.to(dtype), allow_unused=True, materialize_grads=True)]


def check(layers: MLP, counts: list[int], d: int, precision: str) -> None:
    dtype = torch.float32 if precision in ("float32", "tf32") else getattr(torch, precision)
    arguments = case(layers, counts, d, dtype)
    before = torch.backends.cuda.matmul.fp32_precision
    try:
        torch.backends.cuda.matmul.fp32_precision = "tf32" if precision == "tf32" else "ieee"
        found = run(arguments, layers, dtype, "native")
    finally:
        torch.backends.cuda.matmul.fp32_precision = before
    for part, exact in zip(found, run(arguments, layers, torch.float64, "reference")):
        difference, scale = (part.double() - exact).norm().item(), exact.norm().item()
        assert part.isfinite().all()
        assert difference <= ALLOWED[precision] * max(scale, 1e-6), (list(part.shape), difference / max(scale, 1e-6))


def check_forward(layers: MLP, counts: list[int], d: int, precision: str, differentiates: bool = True) -> None:
    """Compares the output alone, since gradients of ReLU differ where rounding switches a unit."""
    dtype = getattr(torch, precision)
    arguments = case(layers, counts, d, dtype)
    out = run(arguments, layers, dtype, "native", differentiates=differentiates)[0].double()
    (exact,) = run(arguments, layers, torch.float64, "reference", differentiates=False)
    assert (out - exact).norm() <= ALLOWED[precision] / 2 * exact.norm(), (out - exact).norm() / exact.norm()
