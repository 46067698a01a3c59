"""The compiled module as PyTorch ops; the only importer of ``voronerf._C``.

n points, k cells, m centres of a tree, g diagrams. Each entry is a functional ``torch.library`` custom op that makes
its inputs contiguous, allocates outputs and workspace, and passes addresses, sizes, and a thread count or a stream.
Shapes, dtypes and devices have been validated by ``voronerf.ops``. Importing this module raises ``BackendUnavailable``
where the extension is missing or was built for other sources than these.

OpenMP: the extension is linked without libgomp, and its undefined symbols are bound to the OpenMP runtime that torch
has loaded. Linking it would not do: torch's wheels bring a libgomp of their own, named ``libgomp.so.1`` (CPU wheels;
the loader would share it) or with a hash, such as ``libgomp-a34b3233.so.1`` (the loader would add the system's, a
second pool of threads that competes with torch's, or fail where the system has none).
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.backends import BackendUnavailable

ISAS = ("portable", "avx2", "avx512")
# Number of csrc/bindings/bindings.cpp that this file and its companions are written for.
INTERFACE = 13

# In the order of CellSortWay in csrc/geometry/cell_sort.h.
SORTS = ("automatic", "counting", "radix")
# In the order of csrc/common/measure_peak.h.
_PEAKS = ("float32", "bfloat16", "copy")

_REMEDY = "install a wheel, or build it with `pip install -e .` (needs a C++17 compiler)"


def _bind_openmp() -> None:
    """Make the symbols of torch's OpenMP runtime visible to libraries loaded from now on."""
    if not sys.platform.startswith("linux"):
        return
    with open("/proc/self/maps") as maps:
        mapped = [line.split(maxsplit=5)[5].strip() for line in maps if line.count("/") > 0]
    names = ("libgomp", "libiomp5", "libomp")
    loaded = [path for path in dict.fromkeys(mapped) if os.path.basename(path).startswith(names)]
    # torch comes first: another package's runtime may be there too.
    loaded.sort(key=lambda path: "torch" not in path.split(os.sep))
    ctypes.CDLL(loaded[0] if loaded else "libgomp.so.1", mode=ctypes.RTLD_GLOBAL)


try:
    _bind_openmp()
    from voronerf import _C
except (ImportError, OSError) as error:
    raise BackendUnavailable(f"the compiled extension voronerf._C cannot be loaded ({error}); {_REMEDY}") from error
# A module of before there was the number has none.
if getattr(_C, "interface", None) != INTERFACE:
    raise BackendUnavailable(
        "the compiled module is of another version of voronerf; build it again with `pip install -e .`"
    )


# Bytes from which a result is asked to lie on huge pages; below, the allocator has warm memory as a rule.
_LARGE = 1 << 22


def fresh(result: Tensor) -> Tensor:
    """A result as it was allocated, on huge pages where it is large and the system gives them."""
    if result.nbytes >= _LARGE and result.device.type == "cpu":
        _C.advise_huge_pages(result.data_ptr(), result.nbytes)
    return result


def _choose_isa() -> int:
    """Best instruction set of this processor, or the one of VORONERF_ISA."""
    supported = [isa for isa in range(len(ISAS)) if _C.isa_supported(isa)]
    wanted = os.environ.get("VORONERF_ISA")
    if not wanted:
        return supported[-1]
    if wanted not in ISAS or ISAS.index(wanted) not in supported:
        here = ", ".join(ISAS[isa] for isa in supported)
        # No BackendUnavailable, which backend="auto" would pass over in silence.
        raise ValueError(f"VORONERF_ISA must be one this processor supports ({here}), got {wanted!r}")
    return ISAS.index(wanted)


_ISA = _choose_isa()


def missing(device: torch.device) -> str | None:
    """Reason, with the remedy, why this build cannot run on a device; None if it can. CUDA: a device is present."""
    if device.type != "cuda":
        return None
    if not _C.cuda:
        return f"{_C.cuda_outcome}; install the CUDA toolkit and rebuild with VORONERF_CUDA=1 `pip install -e .`"
    major, minor = torch.cuda.get_device_capability(device)
    if _runs_on(_C.cuda_architectures.split(";"), 10 * major + minor):
        return None
    return (
        f"built with CUDA for {_C.cuda_architectures}, the device is {major}{minor}; "
        f"rebuild with VORONERF_CUDA_ARCHITECTURES={major}{minor} `pip install -e .`"
    )


def describe() -> dict[str, Any]:
    """How the module was built and what it uses."""
    return {
        "instruction set": ISAS[_ISA],
        "compiler": _C.compiler,
        "openmp": _C.openmp,
        "cuda": _C.cuda_outcome,
        "cuda architectures": _C.cuda_architectures.split(";") if _C.cuda else [],
    }


def measure_peak(kind: str, *, isa: str | None = None, threads: int | None = None) -> float:
    """What the machine can do at best, as the yardstick of benchmarks; takes 0.1 to 0.2 s.

    Args:
        kind: "float32" (multiply-adds) or "bfloat16" (dot products), in floating-point operations a second, operands
            in registers; or "copy", in bytes a second, read and written, of memory that fits no cache.
        isa: one of ``ISAS``; by default the one in use.
        threads: by default torch's number.

    Raises:
        ValueError: an unknown kind or instruction set, one that this processor or build does not have, or no threads.
    """
    if kind not in _PEAKS:
        raise ValueError(f"measure_peak: kind must be one of {', '.join(_PEAKS)}, got {kind!r}")
    if isa is not None and isa not in ISAS:
        raise ValueError(f"measure_peak: isa must be one of {', '.join(ISAS)}, got {isa!r}")
    if threads is not None and threads < 1:
        raise ValueError(f"measure_peak: threads must be at least 1, got {threads}")
    number = _ISA if isa is None else ISAS.index(isa)
    peak: float = _C.measure_peak(_PEAKS.index(kind), number, threads or torch.get_num_threads())
    return peak


def nearest_centre(points: Tensor, centres: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Index of the centre with the smallest ``|x - c|^2 - w`` for every point; see ``voronerf.ops.nearest_centre``."""
    points, centres, weights = _coordinates(points, centres, weights)
    cells: Tensor = _nearest_centre(points, centres, weights)
    return cells


def locate_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, *, depth: int, weights: Tensor | None = None
) -> Tensor:
    """Leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``."""
    points, centres, weights = _coordinates(points, centres, weights)
    leaves: Tensor = _locate_cell(points, centres, child_offsets, child, depth, weights)
    return leaves


def cell_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Stable order and cell offsets; see ``voronerf.ops.cell_sort``."""
    order, offsets = _cell_sort(cells, k)
    return order, offsets


@torch.library.custom_op("voronerf::nearest_centre", mutates_args=())
def _nearest_centre(points: Tensor, centres: Tensor, weights: Tensor | None) -> Tensor:
    points, centres, weights = points.contiguous(), centres.contiguous(), _contiguous(weights)
    cells = _allocate_rows(points)
    sizes = points.shape[0], centres.shape[0]
    arguments = *_addresses(points, centres, weights, cells), *sizes
    if on_cuda(points):
        _entry("nearest_centre_cuda", points.dtype)(*arguments, *stream(points))
    else:
        _entry("nearest_centre", points.dtype)(*arguments, _ISA, torch.get_num_threads())
    return cells


@torch.library.custom_op("voronerf::locate_cell", mutates_args=())
def _locate_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, depth: int, weights: Tensor | None
) -> Tensor:
    points, centres, weights = points.contiguous(), centres.contiguous(), _contiguous(weights)
    child_offsets, child = child_offsets.contiguous(), child.contiguous()
    leaves = _allocate_rows(points)
    n, m, g = points.shape[0], centres.shape[0], child_offsets.shape[0] - 1
    addresses = _addresses(points, centres, weights, child_offsets, child, leaves)
    if on_cuda(points):
        _entry("locate_cell_cuda", points.dtype)(*addresses, n, m, g, depth, *stream(points))
        return leaves
    fault = _C.locate_cell_fault(child_offsets.data_ptr(), child.data_ptr(), g, m)
    if fault is not None:
        raise ValueError(f"locate_cell: {fault}")
    threads = torch.get_num_threads()
    workspace = child.new_empty(_C.locate_cell_workspace(m, threads))
    locate = _entry("locate_cell", points.dtype)
    if not locate(*addresses, workspace.data_ptr(), n, m, depth, _ISA, threads):
        raise ValueError(f"locate_cell: depth must be the number of levels of the tree, got {depth}, which is too few")
    return leaves


@torch.library.custom_op("voronerf::cell_sort", mutates_args=())
def _cell_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    cells = cells.contiguous()
    order, offsets = _allocate_sort(cells, k)
    sort_cells(cells, order, offsets, "cell_sort")
    return order, offsets


def sort_cells(cells: Tensor, order: Tensor, offsets: Tensor, caller: str, way: str = "automatic") -> None:
    """Fills the order and the offsets of contiguous cells.

    Args:
        cells: int32 [n].
        order: int32 [n].
        offsets: int32 [k + 1].
        caller: the operation that errors name.
        way: of sorting on CUDA, one of ``SORTS``, for measurements; automatic is by the number of cells.
    """
    n, k = cells.shape[0], offsets.shape[0] - 1
    addresses = _addresses(cells, order, offsets)
    if on_cuda(cells):
        number, (device, current) = SORTS.index(way), stream(cells)
        workspace = cells.new_empty(_C.cell_sort_workspace_cuda(n, k, number, device), dtype=torch.uint8)
        _C.cell_sort_cuda(*addresses, workspace.data_ptr(), n, k, number, device, current)
        return
    workspace = cells.new_empty(_C.cell_sort_workspace(n, k))
    if not _C.cell_sort(*addresses, workspace.data_ptr(), n, k, torch.get_num_threads()):
        low, high = (int(bound) for bound in cells.aminmax())
        raise ValueError(f"{caller}: cells must lie in 0 to {k - 1}, got values from {low} to {high}")


@_nearest_centre.register_fake
def _(points: Tensor, centres: Tensor, weights: Tensor | None) -> Tensor:
    return _allocate_rows(points)


@_locate_cell.register_fake
def _(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, depth: int, weights: Tensor | None
) -> Tensor:
    return _allocate_rows(points)


@_cell_sort.register_fake
def _(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    return _allocate_sort(cells, k)


def _allocate_rows(points: Tensor) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int32)


def _allocate_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    return torch.empty_like(cells), cells.new_empty(k + 1)


def _coordinates(points: Tensor, centres: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """One dtype for all: float64 if any is, else float32, which holds the half types exactly."""
    given = (points, centres) if weights is None else (points, centres, weights)
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in given) else torch.float32
    points, centres = points.detach().to(dtype), centres.detach().to(dtype)
    return points, centres, None if weights is None else weights.detach().to(dtype)


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def _addresses(*tensors: Tensor | None) -> list[int]:
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


@functools.cache
def _entry(name: str, dtype: torch.dtype) -> Callable[..., Any]:
    entry: Callable[..., Any] = getattr(_C, f"{name}_{str(dtype).removeprefix('torch.')}")
    return entry


def on_cuda(tensor: Tensor) -> bool:
    """Whether the CUDA half of the module is to work on a tensor."""
    return tensor.is_cuda


def stream(tensor: Tensor) -> tuple[int, int]:
    """Device and current stream of a CUDA tensor."""
    index = tensor.device.index
    return index, torch.cuda.current_stream(index).cuda_stream


def _runs_on(architectures: list[str], capability: int) -> bool:
    """Whether code for these architectures, and PTX of the last, runs on a device (86 for compute capability 8.6).

    Machine code runs on later minor versions of its major one, PTX on everything from its version on; those of an
    architecture-specific target such as 90a on that version alone.
    """
    for position, architecture in enumerate(architectures):
        number = int(architecture.rstrip("af"))
        if number == capability:
            return True
        portable = architecture.isdigit() and capability > number
        if portable and (capability // 10 == number // 10 or position == len(architectures) - 1):
            return True
    return False
