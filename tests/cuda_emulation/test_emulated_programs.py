"""Programs by the CUDA kernel on the CPU, with threads in several orders, against the reference."""

import importlib
import sys
from pathlib import Path

import pytest
import torch
from emulated import emulated

from voronerf.ops import grouped_program
from voronerf.ops._core.program import Builder, Columns
from voronerf.ops.grouped_program.case import every_step

sys.path.insert(0, str(Path(__file__).parent.parent / "ops"))
from test_grouped_program import NUMBERS, arguments, check, derivatives, random_program

plans = importlib.import_module("voronerf.ops.grouped_program.native")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("shared_bytes", [227 * 1024, 64 * 1024])
def test_values_and_derivatives(seed, shared_bytes):
    """Of second order too; tiles of 32 rows and of 16, cells that are no multiple of either, and an empty one."""
    order = torch.randperm(70, generator=torch.Generator().manual_seed(seed)).int() if seed == 1 else None
    with emulated(seed=seed, shared_bytes=shared_bytes):
        check(every_step() if seed < 2 else random_program(seed), [37, 0, 33], shared=seed == 1, order=order)


def test_every_function_and_turned_inputs():
    """All functions in one program, of an input that lies column by column."""
    b = Builder()
    x = b.input(5)
    names = [(name, f.orders) for name, f in plans.FUNCTIONS.items() if name != "stop"]
    made = [
        b.function(name, x, *NUMBERS.get(name, (0.7, 0.0)), order=order)
        for name, orders in names
        for order in range(min(orders, 3) + 1)
    ]
    program = b.program([b.move(5 * len(made), [(columns, 5 * i) for i, columns in enumerate(made)])])
    rows = 0.1 + torch.rand(5, 40, generator=torch.Generator().manual_seed(0)).t()
    offsets = torch.tensor([0, 17, 40], dtype=torch.int32)
    (exact,) = grouped_program([rows.double()], [], offsets, program=program, backend="reference")
    with emulated():
        (found,) = grouped_program([rows], [], offsets, program=program, backend="native")
    torch.testing.assert_close(found.double(), exact, rtol=2e-5, atol=2e-5)


def test_results_are_the_same_in_every_order_of_threads():
    """Bit for bit, sums over several tasks of a cell included."""
    program, found = random_program(3), []
    given = arguments(program, [150, 0, 9], torch.float32)
    for seed in (0, 1, 2):
        with emulated(seed=seed):
            found.append(derivatives(program, *given, "native"))
    for others in found[1:]:
        assert all(map(torch.equal, found[0], others))


def test_a_planted_fault_is_found():
    """A layer that writes over what other threads still read."""
    b = Builder()
    x = b.input(70)
    program = b.program([b.linear(x, b.parameter(70, 70), 70)])
    given = arguments(program, [40], torch.float32)
    (exact,) = grouped_program(*given, program=program, backend="reference")
    plan = plans._plan(program.text)
    code = plan.on(torch.device("cpu"))[0]
    at = 7 + 7 + (11 + 0) + 4  # header, one pack, the input; the slot of the layer
    before = int(code[at])
    assert before == 80
    for slot, right in ((before, True), (0, False)):
        code[at], code[at + 11 + 3 + 7] = slot, slot  # and of what the output reads
        with emulated():
            (found,) = grouped_program(*given, program=program)
        code[at] = before
        assert torch.allclose(found, exact, atol=1e-5) == right


def test_refuses_what_does_not_fit():
    """Values of many columns, and more tensors than kernel arguments hold."""
    b = Builder()
    x = b.input(2000)
    wide = b.program([b.binary("add", b.apply("exp", x), b.apply("tanh", x))])
    with emulated(shared_bytes=64 * 1024), pytest.raises(ValueError, match="must fit into the 65536 bytes of a block"):
        grouped_program([torch.zeros(3, 2000)], [], torch.tensor([0, 3], dtype=torch.int32), program=wide)
    b = Builder()
    columns: list[Columns] = [b.input(1) for _ in range(65)]
    many = b.program([b.move(65, [(c, i) for i, c in enumerate(columns)])])
    with emulated(), pytest.raises(ValueError, match="at most 64 inputs, parameters, outputs or sums on CUDA, got 65"):
        grouped_program([torch.zeros(3, 1)] * 65, [], torch.tensor([0, 3], dtype=torch.int32), program=many)
