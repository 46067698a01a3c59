"""The compiled `grouped_linear` against float64: storage types, row layouts and instruction sets."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

import pytest
import torch
from helpers import python
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from voronerf.ops import frequency_encode
from voronerf.ops.grouped_linear import reference as specification

compiled = pytest.importorskip("voronerf.ops._core.native")
native = pytest.importorskip("voronerf.ops.grouped_linear.native")

ACTIVATIONS = ("none", "relu", "softplus", "sigmoid", "sine")
# Inputs and outputs: even and odd widths, multiples of 16 and 32, and more columns than a panel of packed weights (16
# or 64). Outputs are below, equal to or above 16, since they are padded to a multiple of 16.
WIDTHS = ((63, 64), (64, 63), (64, 64), (48, 16), (16, 48), (1, 1), (3, 90), (90, 4), (256, 32), (32, 129))
WIDTHS += ((4, 3), (5, 17), (63, 33), (64, 21), (1, 65), (90, 5))
# The cells have 0, 1, 96, 0, 199 and 2 rows; a tile has 96. Rows without a cell lie before and after them.
OFFSETS = (2, 2, 3, 99, 99, 298, 300)
ROWS = 303


def inputs(i: int, o: int, dtype: torch.dtype, *, seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    k = len(OFFSETS) - 1
    tensors = (draw(ROWS, i), draw(k, o, i) / i**0.5, draw(k, o), draw(ROWS, o))
    return [tensor.to(dtype) for tensor in tensors]


def evaluate(run, x: Tensor, weight: Tensor, bias: Tensor | None, g: Tensor, activation: str) -> list[Tensor]:  # type: ignore[no-untyped-def]
    """Returns the output, then the gradients of x, weight and bias."""
    leaves = [tensor.detach().requires_grad_() for tensor in (x, weight, bias) if tensor is not None]
    offsets = torch.tensor(OFFSETS, dtype=torch.int32)
    y = run(leaves[0], offsets, leaves[1], None if bias is None else leaves[2], activation=activation)
    return [y.detach(), *torch.autograd.grad(y, leaves, g)]


def compare(x: Tensor, weight: Tensor, bias: Tensor | None, g: Tensor, activation: str) -> None:
    """Compares with float64 for each instruction set; allows the rounding of results and of products' operands."""
    if activation == "relu":  # no gradient at the kink, where two correct implementations may differ
        raised = None if bias is None else bias.double()
        y = evaluate(specification.grouped_linear, x.double(), weight.double(), raised, g.double(), "none")[0]
        g = torch.where(y.abs() < 0.05, 0, g)
    wide = [None if tensor is None else tensor.double() for tensor in (x, weight, bias, g)]
    exact = evaluate(specification.grouped_linear, *wide, activation)
    step = torch.finfo(x.dtype).eps
    for isa in compiled.SUPPORTED_ISAS:
        with compiled.using_isa(isa):
            actual = evaluate(native.grouped_linear, x, weight, bias, g, activation)
        for got, want in zip(actual, exact):
            assert got.dtype == x.dtype
            scale = float(want.abs().max())
            torch.testing.assert_close(got.double(), want, rtol=step, atol=(4e-6 if step < 1e-5 else step) * scale)
        assert not actual[0][: OFFSETS[0]].any() and not actual[0][OFFSETS[-1] :].any()
        assert not actual[1][: OFFSETS[0]].any() and not actual[1][OFFSETS[-1] :].any()
        assert not actual[2][0].any() and not actual[2][3].any()  # cells without rows


@pytest.mark.parametrize("number", range(len(WIDTHS)), ids=[f"{i}-{o}" for i, o in WIDTHS])
def test_widths_and_activations(number: int) -> None:
    """Each activation has several widths, with and without a bias."""
    for dtype in (torch.float32, torch.bfloat16):
        x, weight, bias, g = inputs(*WIDTHS[number], dtype)
        compare(x, weight, bias if number % 2 else None, g, ACTIVATIONS[number % 5])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
def test_strided_and_unaligned(dtype: torch.dtype) -> None:
    x, weight, bias, g = inputs(64, 32, dtype)
    expected = evaluate(native.grouped_linear, x, weight, bias, g, "sigmoid")
    shifted = torch.empty(x.numel() + 1, dtype=dtype)[1:].view_as(x).copy_(x)  # bfloat16: not aligned to 4 bytes
    spread = torch.empty(*g.shape, 2, dtype=dtype)[..., 0].copy_(g)
    flipped = weight.transpose(1, 2).contiguous().transpose(1, 2)
    for form in (shifted, x.t().contiguous().t(), x.repeat(1, 2)[:, :64]):
        actual = evaluate(native.grouped_linear, form, flipped, bias, spread, "sigmoid")
        for got, want in zip(actual, expected):
            assert torch.equal(got, want)


def test_calls_past_the_dispatcher_give_what_it_gives() -> None:
    """Under a profiler, a mode or a transform the custom op runs; otherwise the compiled function runs directly."""
    arguments = *inputs(63, 64, torch.float32), "sine"
    direct = evaluate(native.grouped_linear, *arguments)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        seen = evaluate(native.grouped_linear, *arguments)
    assert all(map(torch.equal, direct, seen))
    names = {event.key for event in profile.key_averages()}
    assert "voronerf::network" in names
    x, weight, bias, _ = arguments[:4]
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        fake = native.grouped_linear(mode.from_tensor(x), torch.tensor(OFFSETS, dtype=torch.int32), weight, bias)
    assert type(fake) is not Tensor and fake.shape == (ROWS, 64)


def test_large_results_reuse_the_memory_of_those_that_are_gone() -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("elsewhere the allocator decides")
    x = torch.rand(1 << 17, 3)
    encode = lambda scale: frequency_encode(x * scale, 12, backend="native")  # noqa: E731  # 37 MB
    first, second = encode(1.0), encode(2.0)
    kept, part = first.clone(), second[5:9]
    assert not torch.equal(first, second) and torch.equal(encode(1.0), kept) and torch.equal(first, kept)
    del first
    third = encode(1.0)
    del second  # `part` is a view of `second`
    wanted = part.clone()
    others = [encode(0.5 + i) for i in range(3)]
    assert torch.equal(part, wanted) and torch.equal(third, kept)
    assert len({other.untyped_storage().data_ptr() for other in (*others, third, part)}) == 5


def test_large_results_take_few_new_pages() -> None:
    """Counts the page faults of a fresh process, whose allocator has no freed memory to reuse."""
    if not sys.platform.startswith("linux"):
        pytest.skip("elsewhere the allocator decides")
    program = """
import resource, torch
from voronerf.ops import frequency_encode
from voronerf.ops._core.memory import on_huge_pages
def faults(run):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    run()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
def whole():
    out = torch.empty(1 << 24)
    on_huge_pages(out)
    out.zero_()
found, equal = [faults(whole)], []
for n in (1 << 18, (1 << 18) - 100) * 4:
    x = torch.rand(n, 3)
    equal.append(faults(lambda: frequency_encode(x, 10, backend="native")))
from voronerf.app.cli import keep_freed_memory
keep_freed_memory()
steps = [faults(lambda: [torch.ones(1 << 22) for _ in range(16)]) for _ in range(6)]
print(*found, sorted(equal[2:])[3], sorted(steps[1:])[2])
"""
    huge, equal, step = map(int, python("-c", program).split())
    path = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    assert huge < 2000 or not path.exists() or "[never]" in path.read_text()  # instead of 16,384 small pages
    assert equal < 16  # equal calls write to the same pages, instead of 16,128 small pages, or 31 huge ones
    # The median of five steps, since the system may reclaim pages; a step uses 65,536. glibc alone can be asked.
    assert step < 2000 or platform.libc_ver()[0] != "glibc"
