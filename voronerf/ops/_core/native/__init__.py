"""The loader of the compiled module: it binds torch's OpenMP, chooses an instruction set, and describes the build.

Importing this package raises ``BackendUnavailable`` if the extension is missing or was built from other sources.

OpenMP: the extension is linked without libgomp, and its undefined symbols are bound to the OpenMP runtime that torch
has loaded. Linking libgomp would not work, because torch's wheels include a libgomp. The dynamic linker shares torch's
libgomp only if it is named ``libgomp.so.1`` (CPU wheels). If the name has a hash, such as ``libgomp-a34b3233.so.1``,
the linker would load the system's libgomp too, whose thread pool competes with torch's, or fail if the system has none.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from voronerf.ops._core import backends, checks
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.custom_op import LISTENERS, Op


def _bind_openmp() -> None:
    """Makes the symbols of torch's OpenMP runtime visible to libraries loaded later."""
    if not sys.platform.startswith("linux"):
        return
    with open("/proc/self/maps") as maps:
        mapped = [line.split(maxsplit=5)[5].strip() for line in maps if line.count("/") > 0]
    names = ("libgomp", "libiomp5", "libomp")
    loaded = [path for path in dict.fromkeys(mapped) if os.path.basename(path).startswith(names)]
    # torch's runtime comes first, since another package may have loaded one too.
    loaded.sort(key=lambda path: "torch" not in path.split(os.sep))
    ctypes.CDLL(loaded[0] if loaded else "libgomp.so.1", mode=ctypes.RTLD_GLOBAL)


def _interface() -> int | None:
    """Returns the checksum of all signatures that the sources bind; the built module must have the same checksum."""
    file = Path(__file__).resolve().parent.parent / "interface.txt"
    return int(file.read_text()) if file.exists() else None


def _why_missing(error: ImportError | OSError) -> str:
    """Returns one line: the package's folder, why its compiled module cannot be loaded, and the remedy."""
    here = Path(__file__).resolve().parents[4]
    others = [place for place in sys.path if Path(place).resolve() != here]  # where a wheel may be installed
    spec = PathFinder.find_spec("_C", [os.path.join(place, "voronerf", "ops", "_core") for place in others])
    remedy = "install a wheel, or build the module with `pip install -e .` (needs a C++17 compiler)"
    if spec is not None and spec.origin is not None:
        installed = Path(spec.origin).parents[3]
        remedy = (
            f"run Python in another folder to use the installation in {installed}, or build the module with "
            "`pip install -e .`"
        )
    return f"voronerf in {here} cannot load its compiled module ({error}); {remedy}"


try:
    _bind_openmp()
    import voronerf.ops._core._C as compiled
except (ImportError, OSError) as error:
    raise BackendUnavailable(_why_missing(error)) from None
if getattr(compiled, "interface", "none") != _interface():
    raise BackendUnavailable(
        "the compiled module was built from another version of voronerf; rebuild it with `pip install -e .`"
    )

DTYPES = {
    "float16": torch.float16,
    "bfloat16": torch.bfloat16,
    "float32": torch.float32,
    "float64": torch.float64,
    "int32": torch.int32,
    "int64": torch.int64,
    "uint8": torch.uint8,
    "bool": torch.bool,
}
"""The dtypes, by name in the compiled module."""


def register_torch(module: Any) -> None:
    """Passes a compiled module the torch objects that it needs."""
    exchange = getattr(Tensor, "__dlpack_c_exchange_api__", None)  # exists from torch 2.10 on
    module.register_torch(DTYPES, (Tensor, torch.nn.Parameter), exchange)


register_torch(compiled)

signature, TensorRules = compiled.signature, compiled.TensorRules
"""The functions that check arguments and make calls (csrc/bindings/signature.h); kept when tests replace `compiled`."""

ISAS = compiled.Isa
SUPPORTED_ISAS = tuple(isa for isa in ISAS if compiled.isa_supported(isa))
LEAST_GAIN = 1.25
"""The smallest speed-up for which networks use bfloat16 products, since rounding and packing operands takes time."""
_bfloat16_gain = compiled.bfloat16_gain()


def _choose_isa() -> str:
    """Returns the best instruction set of this processor, or the value of VORONERF_ISA.

    avx512_bf16 counts only if its bfloat16 products are `LEAST_GAIN` times as fast as float32 products. The measured
    gain is far from this limit on all known processors, so all processes on a machine make the same choice.
    """
    best = [isa for isa in SUPPORTED_ISAS if isa != "avx512_bf16" or _bfloat16_gain >= LEAST_GAIN]
    wanted = os.environ.get("VORONERF_ISA") or best[-1]
    if wanted not in SUPPORTED_ISAS:
        here = ", ".join(SUPPORTED_ISAS)
        # Not BackendUnavailable, which backend="auto" would skip silently.
        raise ValueError(f"VORONERF_ISA must be one this processor supports ({here}), got {wanted!r}")
    return wanted


_isa = _choose_isa()


@contextmanager
def using_isa(isa: str) -> Iterator[None]:
    """Runs ops with an instruction set, one of ``SUPPORTED_ISAS``, within the context."""
    global _isa
    if isa not in SUPPORTED_ISAS:
        raise ValueError(f"using_isa: isa must be one of {', '.join(SUPPORTED_ISAS)}, got {isa!r}")
    previous, _isa = _isa, isa
    try:
        yield
    finally:
        _isa = previous


def on_cuda(tensor: Tensor) -> bool:
    """Returns whether the module's CUDA functions handle a tensor."""
    return tensor.is_cuda


def stream(tensor: Tensor) -> tuple[int, int]:
    """Returns the device and the current stream of a CUDA tensor."""
    index = tensor.device.index
    return index, torch.cuda.current_stream(index).cuda_stream


def isa() -> str:
    """Returns the instruction set in use."""
    return _isa


def cpu() -> compiled.Cpu:
    """Returns the CPU argument of compiled functions: instruction set and threads."""
    return _cpu(_isa, backends.threads())


def machine(tensor: Tensor) -> compiled.Cpu | compiled.Cuda:
    """Returns the machine argument of a compiled function on a tensor: the CPU, or the GPU and its stream."""
    return compiled.Cuda(*stream(tensor)) if on_cuda(tensor) else cpu()


def aligned(tensor: Tensor) -> Tensor:
    """Returns the tensor, or a copy aligned to 16 bytes for the vector loads of CUDA kernels."""
    return tensor.clone() if on_cuda(tensor) and tensor.data_ptr() % 16 else tensor


def refuse_where_deterministic(op: str, tensor: Tensor) -> None:
    """Refuses a table's gradient on CUDA under ``torch.use_deterministic_algorithms``: atomic sums have no fixed order.

    Args:
        op: The name of the op, for the message.
        tensor: A tensor of the op; CPU tensors are never refused.

    Raises:
        RuntimeError: Deterministic algorithms are required. With ``warn_only`` this is only a warning.
    """
    if not (on_cuda(tensor) and torch.are_deterministic_algorithms_enabled()):
        return
    message = (
        f"{op}: the gradient of a hash grid's table has no deterministic CUDA kernel, got "
        "torch.use_deterministic_algorithms(True); use backend='reference' or warn_only=True"
    )
    if not torch.is_deterministic_algorithms_warn_only_enabled():
        raise RuntimeError(message)
    warnings.warn(message, stacklevel=2)


compiled.register_queries(
    {
        "grad_enabled": torch.is_grad_enabled,
        "tangents": vars(forward_ad),
        "listeners": LISTENERS,
        "torch": vars(torch),
        "threads": torch.get_num_threads,
        "kept": backends._override,
        "native": globals(),
        "choose": backends._choose_once,
        "checks": checks,
        "dtypes": DTYPES,
    }
)
Op.way = compiled.way_of


@functools.lru_cache(maxsize=64)
def _cpu(isa: str, threads: int) -> compiled.Cpu:
    return compiled.Cpu(isa, threads)


def missing(device: torch.device) -> str | None:
    """Returns why this build cannot run on a device, with the remedy; None if it can. A CUDA device must be present."""
    if device.type != "cuda":
        return None
    if not compiled.cuda:
        return f"{compiled.cuda_outcome}; install the CUDA toolkit and rebuild with VORONERF_CUDA=1 `pip install -e .`"
    driver = _driver_major()
    if driver < compiled.cuda_major:
        return (
            f"built with CUDA {compiled.cuda_major}, the driver has CUDA {driver}; update the driver, "
            f"or rebuild with a toolkit of CUDA {driver}"
        )
    major, minor = torch.cuda.get_device_capability(device)
    if _runs_on(compiled.cuda_architectures.split(";"), 10 * major + minor):
        return None
    return (
        f"built with CUDA for {compiled.cuda_architectures}, the device is {major}{minor}; "
        f"rebuild with VORONERF_CUDA_ARCHITECTURES={major}{minor} `pip install -e .`"
    )


@functools.cache
def _driver_major() -> int:
    """Returns the driver's major CUDA version; its minor version may be older than the toolkit's."""
    version = ctypes.c_int()
    library = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    status = library.cuDriverGetVersion(ctypes.byref(version))
    if status != 0:
        raise RuntimeError(f"cuDriverGetVersion failed with error {status}")
    return version.value // 1000


def _runs_on(architectures: list[str], capability: int) -> bool:
    """Returns whether code for these architectures, or PTX of the last one, runs on a device (86: capability 8.6).

    Machine code runs on its version and on later minor versions of the same major version. PTX runs on its version and
    all later ones. Code for an architecture-specific target such as 90a runs on that version alone.
    """
    for position, architecture in enumerate(architectures):
        number = int(architecture.rstrip("af"))
        if number == capability:
            return True
        portable = architecture.isdigit() and capability > number
        if portable and (capability // 10 == number // 10 or position == len(architectures) - 1):
            return True
    return False


def describe() -> dict[str, Any]:
    """Describes how the module was built, and its instruction set."""
    return {
        "instruction set": _isa,
        "bfloat16 products": _bfloat16_products(),
        "compiler": compiled.compiler,
        "openmp": compiled.openmp,
        "cuda": compiled.cuda_outcome,
        "cuda architectures": compiled.cuda_architectures.split(";") if compiled.cuda else [],
    }


def _bfloat16_products() -> str:
    """Describes the arithmetic of bfloat16 products on the CPU, and the reason for it."""
    if _bfloat16_gain == 0:
        return "in float32: the processor or the build has no bfloat16 products"
    if _isa == "amx":
        return "in bfloat16, in tile registers"
    used = "in bfloat16" if _isa == "avx512_bf16" else "in float32"
    return f"{used}: bfloat16 has {_bfloat16_gain:.2g} times the throughput of float32"


def measure_peak(kind: str, *, isa: str | None = None, threads: int | None = None) -> float:
    """Measures the machine's peak throughput, the reference of benchmarks; takes 0.1 to 0.2 s.

    Args:
        kind: "float32" (multiply-adds) or "bfloat16" (dot products) for operands in registers, measured in
            floating-point operations a second; or "copy" for memory larger than the caches, measured in bytes read and
            written a second.
        isa: the instruction set, one of ``ISAS``; by default the one in use.
        threads: the number of threads; by default torch's number.

    Raises:
        ValueError: ``kind`` or ``isa`` is unknown or unsupported by this processor or build, or ``threads`` is below 1.
    """
    if kind not in compiled.Peak:
        raise ValueError(f"measure_peak: kind must be one of {', '.join(compiled.Peak)}, got {kind!r}")
    if isa is not None and isa not in ISAS:
        raise ValueError(f"measure_peak: isa must be one of {', '.join(ISAS)}, got {isa!r}")
    if threads is not None and threads < 1:
        raise ValueError(f"measure_peak: threads must be at least 1, got {threads}")
    return compiled.measure_peak(kind, compiled.Cpu(isa or _isa, threads or torch.get_num_threads()))
