"""Calls that the compiled module checks and runs without Python (csrc/bindings/signature.cpp)."""

from __future__ import annotations

import contextlib
import gc
import sys
import threading
import warnings
from pathlib import Path
from unittest import mock

import pytest
import torch
from helpers import Interrupt
from torch import Tensor
from torch.utils import _python_dispatch
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_leaves

from voronerf import ops
from voronerf.ops import UpdateRule, adam, cell_sort, composite, grouped_program, nearest_centre
from voronerf.ops._core import backends
from voronerf.ops._core.active import active
from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.program import Builder
from voronerf.ops._core.recording import Recording

sys.path.append(str(Path(__file__).parents[1] / "ops"))  # for cases
import cases

pytestmark = pytest.mark.native
native = pytest.importorskip("voronerf.ops._core.native", exc_type=backends.BackendUnavailable)
CASES = {name: case for name, case in cases.CASES.items() if "native" in backends.implemented(name)}


def refused_dtypes(name):
    """Returns the dtypes that the native implementation refuses."""
    reason = backends.why_not(CASES[name].call or name, "native", torch.device("cpu"), torch.bfloat16)
    return () if reason is None else (torch.bfloat16,)


def results(name, arguments):
    """Returns an op's results, its arguments (the op may write into them), and the gradients of the arguments."""
    result = getattr(ops, CASES[name].call or name)(**arguments, backend="native")
    leaves = [leaf for leaf in tree_leaves((result, arguments)) if isinstance(leaf, Tensor)]
    if smooth := [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor) and leaf.requires_grad]:
        torch.autograd.backward([leaf.sum() for leaf in smooth])
    gradients = [leaf.grad for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.grad is not None]
    return [leaf.detach().clone() for leaf in (*leaves, *gradients)]


@contextlib.contextmanager
def without_the_exchange():
    """Simulates a torch version before 2.10, which has no tensor exchange API."""
    native.compiled.register_torch(native.DTYPES, (Tensor, torch.nn.Parameter), None)
    try:
        yield
    finally:
        native.register_torch(native.compiled)


@pytest.mark.parametrize(
    ("name", "kind", "learns"),
    [
        (name, kind, learns)
        for name, case in CASES.items()
        for kind in case.kinds
        for learns in {False, case.differentiable}
    ],
)
def test_the_same_bits_as_by_the_methods_of_tensors(name, kind, learns):
    """Without torch's tensor exchange API, Python reads the tensors and runs every call, with bitwise equal results."""
    case = CASES[name]
    for n, dtype in ((0, torch.float32), (1, torch.float32), (33, torch.float32), (33, torch.bfloat16)):
        if dtype in refused_dtypes(name):
            continue
        pinned = {"dtype": dtype, **case.kinds[kind]}
        arguments, same_arguments = (case.make(cases.Draw(**pinned), n) for _ in range(2))
        for leaf in tree_leaves((arguments, same_arguments)):
            if learns and isinstance(leaf, Tensor) and leaf.is_floating_point():
                leaf.requires_grad_()
        actual = results(name, arguments)
        with without_the_exchange():
            expected = results(name, same_arguments)
        for one, other in zip(actual, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_plain_calls_are_made_without_python():
    points, centres = torch.rand(8, 3), torch.rand(4, 3)
    nearest_centre(points, centres)
    with mock.patch.object(Op, "__call__", side_effect=AssertionError):
        cells = nearest_centre(points, centres)
        cell_sort(cells, 4)
        assert torch.equal(cells, nearest_centre(points, centres, backend="reference"))


def test_what_learns_is_seen_by_torch():
    sigma = torch.rand(2, 5, requires_grad=True)
    rest = torch.rand(2, 5, 3), torch.rand(2, 5), torch.rand(2, 5)
    assert composite(sigma, *rest).colour.requires_grad
    with torch.no_grad():
        assert not composite(sigma, *rest).colour.requires_grad
    with pytest.raises(NotImplementedError, match="composite: has no forward-mode derivative"):
        torch.func.jvp(lambda x: composite(x, *rest).colour, (sigma.detach(),), (torch.ones(2, 5),))


def test_calls_keep_nothing():
    points, centres, grid = torch.rand(8, 3), torch.rand(4, 3), [torch.rand(3)]
    rule, other = UpdateRule(torch.zeros(()), 0.1), [torch.zeros(3)]
    held = points, centres, rule, *grid, *other, torch.int32, "native", None

    def calls():
        for _ in range(200):
            nearest_centre(points, centres, backend="native")
            adam([rule], other, grid, [torch.zeros(3)], [torch.zeros(3)])
            with contextlib.suppress(ValueError):
                nearest_centre(points, centres[:, :2])
            with contextlib.suppress(ValueError):
                cell_sort(torch.full((3,), 9, dtype=torch.int32), 4)

    calls()
    before = [sys.getrefcount(value) for value in held]
    calls()
    assert [sys.getrefcount(value) - was for value, was in zip(held, before)] == pytest.approx([0] * len(held), abs=50)


def test_arguments_of_other_kinds_are_checked_in_python():
    """Python checks integers of other classes, names that are not interned, and numbers beyond 64 bits."""
    cells = torch.zeros(3, dtype=torch.int32)
    assert cell_sort(**{"".join(["ce", "lls"]): cells, "k": 2})[1].tolist() == [0, 3, 3]
    for k, error in ((True, "must be an integer, got bool"), (2**70, "must be at most 134217728"), (0, "at least 1")):
        with pytest.raises((TypeError, ValueError), match=error):
            cell_sort(cells, k)


def test_freed_memory_is_refused():
    """Tensors without memory are refused, also scalars of Adam and transposed inputs of programs.

    The compiled module reads the addresses of these tensors directly.
    """
    gone = torch.tensor(0.0)
    gone.untyped_storage().resize_(0)
    ones = [torch.ones(3)], [torch.ones(3)], [torch.zeros(3)], [torch.zeros(3)]
    for rule in (UpdateRule(gone, 0.1), UpdateRule(torch.zeros(()), gone)):
        with pytest.raises(TypeError, match=r"AdamRule: (step|rate_at) is no"):
            adam([rule], *ones)
    b = Builder()
    program = b.program([b.linear(b.input(4), b.parameter(2, 4), 2)])
    x, weights, offsets = torch.rand(4, 4000).t(), [torch.rand(1, 2, 4)], torch.tensor([0, 4000], dtype=torch.int32)
    (expected,) = grouped_program([x.contiguous()], weights, offsets, program=program)
    torch.testing.assert_close(grouped_program([x], weights, offsets, program=program)[0], expected, rtol=0, atol=0)
    x.untyped_storage().resize_(0)
    with pytest.raises((RuntimeError, TypeError)):
        grouped_program([x], weights, offsets, program=program)


def test_other_dtypes_are_named():
    b = Builder()
    program = b.program([b.linear(b.input(4), b.parameter(2, 4), 2)])
    arguments = torch.ones(3, 4), [torch.rand(1, 2, 4)], torch.tensor([0, 3], dtype=torch.int32)
    for dtype in (torch.int16, torch.complex64):
        with pytest.raises(TypeError, match=r"inputs\[0\] must have dtype .*, got " + str(dtype)[6:]):
            grouped_program([arguments[0].to(dtype)], *arguments[1:], program=program)


def test_a_trace_of_torch_sees_the_op():
    centres = torch.rand(4, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(lambda points: nearest_centre(points, centres), (torch.rand(5, 3),), check_trace=False)
    points = torch.rand(7, 3)
    assert torch.equal(traced(points), nearest_centre(points, centres))


def test_a_recording_has_calls_of_which_modes_hear_nothing():
    points, others, centres = torch.rand(5, 3), torch.rand(5, 3), torch.rand(4, 3)
    with Recording() as recording:
        taken = recording.take(points)
        with _disable_current_modes():
            cells = nearest_centre(taken, centres)
    assert recording.replay(threads=1, inputs=[others])
    assert torch.equal(recording.now(cells), nearest_centre(others, centres))


def test_an_interrupted_recording_ends(monkeypatch):
    """Ctrl-C at any place of a recording leaves no mode of torch and no recording on, and stays KeyboardInterrupt."""
    for name in [name for name in vars(_python_dispatch) if name.startswith("_is_in_")]:
        monkeypatch.setattr(_python_dispatch, name, False)  # other tests may have left torch's flags
    points, centres, flags = torch.rand(5, 3), torch.rand(4, 3), dict(vars(_python_dispatch))

    def record():
        recording = Recording()
        recording.record(lambda: nearest_centre(recording.take(points), centres).add(1))
        return recording

    assert record().obstacle is None and vars(_python_dispatch) == flags
    gc.collect()  # a garbage collection during the count would add the places of its callbacks
    with Interrupt() as counting:
        record()
    for place in range(1, counting.places):
        with pytest.raises(KeyboardInterrupt), Interrupt(place):
            record()
        assert torch._C._len_torch_dispatch_stack() == 0 and active.recording is None and active.vary is None, place
        assert vars(_python_dispatch) == flags, place
        before = sys.getrefcount(points)
        nearest_centre(points, centres)
        assert sys.getrefcount(points) == before, place
    assert counting.places > 100 and record().replay(1, inputs=[points]) == 1


def test_recordings_in_two_threads_leave_no_flags(monkeypatch):
    """The recording that begins first ends first, so the other one has seen its flags."""
    flags = [name for name in vars(_python_dispatch) if name.startswith("_is_in_")]
    for name in flags:
        monkeypatch.setattr(_python_dispatch, name, False)
    begun, other = threading.Event(), threading.Event()
    first = threading.Thread(target=lambda: Recording().record(lambda: (begun.set(), other.wait(60))))
    first.start()
    begun.wait(60)
    Recording().record(lambda: (other.set(), first.join(60)))
    assert len(flags) > 0 and not any(getattr(_python_dispatch, name) for name in flags)


def test_an_active_recording_owns_itself():
    """Calls of a thread whose recording has no reference in Python neither crash nor are recorded twice."""

    def calls():
        native.compiled.Recording().begin()
        gc.collect()
        results.append(nearest_centre(points, centres))
        with pytest.raises(RuntimeError, match="another recording is active"):
            native.compiled.Recording().begin()
        results.append(nearest_centre(points, centres))

    points, centres, results = torch.rand(5, 3), torch.rand(4, 3), []
    thread = threading.Thread(target=calls)
    thread.start()
    thread.join()
    assert len(results) == 2 and all(torch.equal(cells, nearest_centre(points, centres)) for cells in results)


def test_what_autograd_cannot_keep_is_refused_by_both():
    with torch.inference_mode():
        sigma = torch.rand(2, 5)
    rest = torch.rand(2, 5, 3, requires_grad=True), torch.rand(2, 5), torch.rand(2, 5)
    for way in (contextlib.nullcontext, without_the_exchange):
        with way(), pytest.raises(TypeError, match="composite: sigma must not be an inference tensor while gradients"):
            composite(sigma, *rest)
        with way(), torch.no_grad():
            composite(sigma, *rest)
