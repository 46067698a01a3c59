"""The compiled ops equal the reference exactly: ties, shifted scenes, every instruction set, any thread count."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import on_any_number_of_threads, python, refuses, same
from torch import Tensor

from voronerf import cell_sort, locate_cell, nearest_centre, ops
from voronerf.ops._core import backends
from voronerf.ops.cell_sort.reference import cell_sort as reference_sort
from voronerf.ops.locate_cell.reference import locate_cell as reference_locate
from voronerf.ops.nearest_centre.reference import distances
from voronerf.ops.nearest_centre.reference import nearest_centre as reference_nearest

sys.path.append(str(Path(__file__).parents[1] / "ops"))  # for cases
from cases import Draw
from cases.locate_cell import tree

pytestmark = pytest.mark.native

if backends.missing("native", torch.device("cpu")) is None:
    from voronerf.ops._core import native as _native

CELLS = (1, 15, 16, 17, 256, 257, 4096)
# Row counts next to the numbers of lanes and tile rows of every instruction set; BLOCK is the number of rows in a task.
ROWS = (0, 1, 3, 7, 8, 9, 15, 17, 31, 33, 63, 64, 65, 129)
BLOCK = 2048
DTYPES = (torch.float32, torch.float64)


def chosen(points: Tensor, centres: Tensor) -> Tensor:
    """Returns the nearest cells; checks that their distance is minimal in float64 and that they equal the reference."""
    cells = nearest_centre(points, centres, backend="native")
    assert cells.dtype == torch.int32
    table = distances(points, centres)
    own = table.gather(1, cells.long()[:, None])[:, 0]
    least = table.amin(dim=1)
    bound = 8 * torch.finfo(torch.float64).eps * least
    assert (own <= least + bound).all()
    assert torch.equal(cells, reference_nearest(points, centres))
    return cells


@pytest.mark.parametrize("k", CELLS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest_of_random_points(isa: str, dtype: torch.dtype, k: int) -> None:
    rows = (1, 65) if k == 4096 else ROWS
    for shift in (0.0, 1000.0):
        centres = (4 * torch.rand(k, 3, dtype=dtype) - 2) + shift
        for n in rows:
            points = (4 * torch.rand(n, 3, dtype=dtype) - 2) + shift
            chosen(points, centres) if n else nearest_centre(points, centres, backend="native")


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest_breaks_ties_to_the_lowest_index(isa: str, dtype: torch.dtype) -> None:
    for k in (2, 16, 17, 257):
        centres = torch.randint(-2, 3, (k, 3)).to(dtype)
        points = torch.randint(-4, 5, (BLOCK + 1, 3)).to(dtype) / 2
        table = distances(points, centres)
        ties = table == table.amin(dim=1, keepdim=True)
        assert (ties.sum(dim=1) > 1).any()
        assert torch.equal(chosen(points, centres).long(), ties.int().argmax(dim=1))


def test_nearest_decides_in_float64_what_float32_cannot(isa: str) -> None:
    """The nearer of two centres is found in every lane and order even if their float32 distances are equal."""
    points = torch.zeros(200, 3)
    near = torch.nextafter(torch.tensor(1.0), torch.tensor(0.0)).item()
    for sign in (1.0, -1.0):
        centres = torch.tensor([[1.0, 1e-5, 0.0], [sign, 0.0, 0.0], [0.0, near, 4e-4]])
        assert chosen(points, centres).eq(1).all()
        assert chosen(points, centres.flip(0)).eq(1).all()


@pytest.mark.parametrize("scale", [1.0, 1e-20, 1e-22])
def test_nearest_on_bisectors(isa: str, scale: float) -> None:
    """Points lie as close to a border as float32 can put them; at the small scales the squares underflow in float32."""
    for _ in range(20):
        centres = 2 * torch.rand(2, 3, dtype=torch.float64) - 1
        along = centres[1] - centres[0]
        points = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
        points -= ((points - centres.mean(dim=0)) @ along / along.square().sum())[:, None] * along
        cells = chosen((points * scale).float(), (centres * scale).float())
        assert 0 < cells.sum() < 500


def test_nearest_far_from_the_origin_and_at_the_ends_of_the_range(isa: str) -> None:
    for scale in (1e-42, 1e-38, 1e-30, 1e-19, 1e18, 1e19, 1e20, 3e38):
        points, centres = (2 * torch.rand(70, 3) - 1) * scale, (2 * torch.rand(33, 3) - 1) * scale
        chosen(points, centres)
    chosen(torch.zeros(17, 3), torch.tensor([[2e19, 0, 0], [1.5e19, 0, 0]]))


def test_nearest_sends_non_finite_points_to_cell_0(isa: str) -> None:
    for bad in (torch.nan, torch.inf, -torch.inf):
        for dtype in DTYPES:
            points = torch.rand(67, 3, dtype=dtype)
            points[::5, 1] = bad
            centres = torch.rand(20, 3, dtype=dtype)
            assert nearest_centre(points, centres, backend="native")[::5].eq(0).all()
            assert torch.equal(nearest_centre(points, centres, backend="native"), reference_nearest(points, centres))


# A call with at most k / 64 rows is a radix sort. In other calls, threads have two chunks if there are at most 4096
# cells and many rows. Calls with the most rows prefetch.
@pytest.mark.parametrize("k", [1, 3, 255, 256, 257, 4096, 4097, 100_000])
@pytest.mark.parametrize("n", [0, 1, 33, 1562, 1563, 2048, 2049, 8192, 50_001, 131_329])
def test_sort(n: int, k: int) -> None:
    # Half of the cells stay empty, and one cell holds half of the rows.
    cells = torch.randint(0, max(1, k // 2), (n,), dtype=torch.int32)
    cells[torch.rand(n) < 0.5] = k - 1
    result = on_any_number_of_threads(lambda: cell_sort(cells, k, backend="native"))
    assert same(result, reference_sort(cells, k)) and all(part.dtype == torch.int32 for part in result)


@pytest.mark.parametrize("k", [1, 2**20, 2**20 + 1, 2**22 + 5, 2**24])
def test_sort_of_few_rows_in_many_cells(k: int) -> None:
    cells = torch.tensor([k - 1, 0, k // 2, k // 2, 0, k - 1, k // 3], dtype=torch.int32)
    order, offsets = cell_sort(cells, k, backend="native")
    assert order.tolist() == (list(range(7)) if k == 1 else [1, 4, 6, 2, 3, 0, 5])
    keys = cells[order.long()]
    assert offsets[0] == 0 and offsets[-1] == 7 and int(offsets.diff().count_nonzero()) == len(set(cells.tolist()))
    assert torch.equal(offsets[keys.long()], torch.searchsorted(keys, keys, out_int32=True))


@pytest.mark.parametrize("bad", [-1, "k", 2**31 - 1, -(2**31)])
@pytest.mark.parametrize(("n", "k"), [(10_000, 7), (10_000, 5000), (20, 5000)])
def test_sort_refuses_cells_out_of_range(n: int, k: int, bad: int | str) -> None:
    value = k if bad == "k" else int(bad)
    message = rf"cell_sort: cells must lie in 0 to {k - 1}, got values from .*{value}"
    for row in (0, 2 * n // 5, n // 2, n - 1):
        cells = torch.randint(0, k, (n,), dtype=torch.int32)
        cells[row] = value

        def call(cells: Tensor = cells) -> tuple[()]:
            with pytest.raises(ValueError, match=message):
                cell_sort(cells, k, backend="native")
            return ()

        on_any_number_of_threads(call)


def tree_of(depth: int, width: int, **pinned: bool) -> dict[str, Tensor | int]:
    """Returns a tree with ``width`` centres in each diagram; ``refined=False`` refines one centre of each level."""
    tables, _ = tree(Draw(depth, free=True, depth=depth, width=width, **pinned))
    return tables


@pytest.mark.parametrize(("depth", "width"), [(1, 1), (1, 5), (2, 16), (3, 4)])
@pytest.mark.parametrize("refined", [False, True])
def test_locate(isa: str, depth: int, width: int, refined: bool) -> None:
    tables = tree_of(depth, width, refined=refined)
    for n in (0, 1, 33, BLOCK - 1, BLOCK + 1):
        for dtype in DTYPES:
            points = torch.randn(n, 3, dtype=dtype)
            if n > 30:
                points[30] = torch.nan
            leaves = locate_cell(points, **tables, backend="native")
            assert torch.equal(leaves, reference_locate(points, **tables))


def test_locate_breaks_ties_as_nearest_centre_does(isa: str) -> None:
    tables = tree_of(2, 8, refined=True)
    tables["centres"] = torch.randint(-2, 3, tables["centres"].shape).float()
    points = torch.randint(-4, 5, (3000, 3)).float() / 2
    assert torch.equal(locate_cell(points, **tables, backend="native"), reference_locate(points, **tables))


@pytest.mark.cuda
def test_locate_on_cuda_stays_inside_unsound_tables() -> None:
    points = torch.rand(100, 3)
    sound_tables = tree_of(2, 2, refined=True)
    sound = locate_cell(points, **sound_tables, backend="native")
    second = reference_nearest(points, sound_tables["centres"][:2]) == 1
    for change in ({"child": [1, 7, -1, -2, -3, -4]}, {"child_offsets": [0, 2, 4, 9]}, {"child_offsets": [0, 2, 4, 4]}):
        tables = {**sound_tables, **{name: torch.tensor(value).int() for name, value in change.items()}}
        on_device = {name: value.cuda() if isinstance(value, Tensor) else value for name, value in tables.items()}
        leaves = locate_cell(points.cuda(), **on_device, backend="native").cpu()
        assert (leaves[second] < 0).all() and torch.equal(leaves[~second], sound[~second])


def test_instruction_sets_by_name_and_one_openmp_runtime() -> None:
    """An unknown instruction set is an error whatever the backend; the next import takes a known one."""
    code = """
import os, torch, voronerf
from voronerf.ops._core import backends
try:
    backends.resolve("nearest_centre", backend="auto", device=torch.device("cpu"), dtype=torch.float32)
except ValueError as error:
    assert str(error).startswith("VORONERF_ISA must be one this processor supports (portable"), error
    assert str(error).endswith("got 'sse9'"), error
else:
    raise SystemExit("nothing was raised")
os.environ["VORONERF_ISA"] = "portable"
from voronerf.ops._core import native as _native
assert _native.describe()["instruction set"] == "portable"
voronerf.nearest_centre(torch.rand(10000, 3), torch.rand(9, 3), backend="native")
names = ("libgomp", "libiomp", "libomp")
loaded = {line.split()[-1] for line in open("/proc/self/maps") if line.split()[-1].split("/")[-1].startswith(names)}
assert len(loaded) == 1 or (not loaded and not _native.describe()["openmp"]), loaded
"""
    python("-c", code, env={**os.environ, "OMP_NUM_THREADS": "2", "VORONERF_ISA": "sse9"})


@pytest.mark.parametrize(
    ("architectures", "runs", "fails"),
    [
        (["75", "80", "90"], [75, 80, 86, 89, 90, 100, 120], [70, 72]),
        (["90a"], [90], [80, 89, 100, 103]),
        (["80", "90a"], [80, 86, 90], [75, 100]),
    ],
)
def test_devices_of_a_cuda_build(architectures: list[str], runs: list[int], fails: list[int]) -> None:
    assert all(_native._runs_on(architectures, capability) for capability in runs)
    assert not any(_native._runs_on(architectures, capability) for capability in fails)


def test_peak_of_each_kind(isa: str) -> None:
    assert _native.measure_peak("float32", isa=isa, threads=1) > 1e8
    assert _native.measure_peak("copy", isa=isa, threads=2) > 1e8
    if isa in ("avx512_bf16", "amx"):
        assert _native.measure_peak("bfloat16", isa=isa, threads=1) > 1e8
    else:
        with pytest.raises(ValueError, match=r"^measure_peak: the instruction set has no bfloat16 products"):
            _native.measure_peak("bfloat16", isa=isa)


def test_bfloat16_is_multiplied_in_what_is_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VORONERF_ISA", raising=False)
    monkeypatch.setattr(_native, "SUPPORTED_ISAS", ("portable", "avx512", "avx512_bf16"))
    for gain, chosen, text in [
        (0.49, "avx512", "in float32: bfloat16 has 0.49 times the throughput of float32"),
        (2.0, "avx512_bf16", "in bfloat16: bfloat16 has 2 times the throughput of float32"),
    ]:
        monkeypatch.setattr(_native, "_bfloat16_gain", gain)
        assert _native._choose_isa() == chosen
        with _native.using_isa(chosen):
            assert _native.describe()["bfloat16 products"] == text
    monkeypatch.setattr(_native, "SUPPORTED_ISAS", ("portable", "avx512", "avx512_bf16", "amx"))
    monkeypatch.setattr(_native, "_bfloat16_gain", 0.49)
    assert _native._choose_isa() == "amx"
    monkeypatch.setattr(_native, "_isa", "amx")
    assert _native.describe()["bfloat16 products"] == "in bfloat16, in tile registers"
    monkeypatch.setattr(_native, "_isa", "avx512")
    monkeypatch.setenv("VORONERF_ISA", "avx512")  # forced
    assert _native._choose_isa() == "avx512"
    monkeypatch.setattr(_native, "_bfloat16_gain", 0.0)
    assert _native.describe()["bfloat16 products"] == "in float32: the processor or the build has no bfloat16 products"


def test_the_gain_of_bfloat16_is_the_same_each_time() -> None:
    gains = [_native.compiled.bfloat16_gain() for _ in range(5)]
    assert len({gain >= _native.LEAST_GAIN for gain in gains}) == 1, gains
    assert (gains[0] > 0) == ("avx512_bf16" in _native.SUPPORTED_ISAS)


def test_unknown_kinds_and_instruction_sets_are_refused() -> None:
    refuses("measure_peak: kind must be one of float32, bfloat16, copy, got 'fp32'", _native.measure_peak, "fp32")
    known = "isa must be one of portable, neon, avx2, avx512, avx512_bf16, amx, got 'sse'"
    refuses(f"measure_peak: {known}", _native.measure_peak, "copy", isa="sse")
    refuses("using_isa: isa must be one of portable", _native.using_isa("sse9").__enter__)


def test_a_driver_older_than_the_toolkit_is_refused(monkeypatch):
    """With an older driver "auto" would choose CUDA, and then all calls of the runtime would fail."""
    built = SimpleNamespace(cuda=True, cuda_major=13, cuda_architectures="90")
    monkeypatch.setattr(_native, "compiled", built)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda device: (9, 0))
    for driver, reason in (
        (14, None),
        (13, None),
        (12, "built with CUDA 13, the driver has CUDA 12; update the driver"),
    ):
        monkeypatch.setattr(_native, "_driver_major", lambda driver=driver: driver)
        said = _native.missing(torch.device("cuda"))
        assert said is None if reason is None else said.startswith(reason)


def test_numbers_below_the_normal_range_are_zero_in_kernels_alone() -> None:
    """Each denormal costs some hundred cycles, so kernels flush it to 0; torch keeps denormals on the same threads."""
    rows = torch.full((100_000, 1), 1e-20)
    offsets, weight = torch.tensor([0, 100_000], dtype=torch.int32), torch.full((1, 1, 1), 1e-20)

    def call() -> list[Tensor]:
        return [ops.grouped_linear(rows, offsets, weight, backend="native"), rows * 1e-20]

    flushed, kept = on_any_number_of_threads(call)
    assert not flushed.any() and bool(kept.all())
