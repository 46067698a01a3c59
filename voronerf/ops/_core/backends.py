"""Which implementation of an op runs: one table, in which each op declares its own row (``voronerf/ops``), and one
predicate that both selects and explains.

An op has up to three implementations with one signature, that of its reference function:

    reference   plain PyTorch, any device and dtype: the executable specification
    native      csrc/, C++ and CUDA
    warp        kernels/, NVIDIA Warp, one source for CPU and CUDA; plain PyTorch where the row says so (``PLAIN``)

``backend="auto"`` takes the first entry of the device's order that is available, supports the call and is not plain.
The choice never depends on timing. The reference is the last entry on CUDA too, so that every op runs on every device,
although not every op has a CUDA kernel. A backend that is given by name never falls back to another: if it cannot run,
it raises :class:`BackendUnavailable` with the reason and the remedy.
"""

from __future__ import annotations

import functools
import importlib
import platform
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import torch

from voronerf.ops._core.compiler import constant_result

BACKENDS = ("reference", "native", "warp")
_MODULES = {"reference": "voronerf.ops.{}.reference", "native": "voronerf.ops.{}.native", "warp": "voronerf.kernels.{}"}
_PACKAGES = {"native": "voronerf.ops._core.native", "warp": "voronerf.kernels"}
ORDER = {"cpu": ("native", "reference"), "cuda": ("native", "warp", "reference")}


class BackendUnavailable(RuntimeError):
    """A backend that was given by name cannot run here; the message says why, and what to do."""


@dataclass(frozen=True)
class Implementation:
    """What one implementation of an op takes, and where it lives."""

    devices: tuple[str, ...] = ()  # device types it runs on; empty means any
    dtypes: tuple[torch.dtype, ...] = ()  # dtypes of the op's first tensor it takes; empty means any
    file: str | None = None  # the module that has the function, by its op; None for that of the function's name
    function: str | None = None  # the name of the function; None for that of the op
    plain: bool = False  # whether it is the reference, which serves where the backend needs no kernel of its own


@dataclass(frozen=True)
class Row:
    """One line of the table of ops and backends, as `voronerf info` prints it.

    Attributes:
        op: name of the op.
        backend: name of the backend.
        devices: device types on which this pair can run here and now.
        dtypes: names of the dtypes it takes, ``("any",)`` for all, ``("plain torch",)`` where that serves, empty where
            there is no implementation.
        reason: why it cannot run, or cannot run on some device, in one line; empty if it can.
    """

    op: str
    backend: str
    devices: tuple[str, ...]
    dtypes: tuple[str, ...]
    reason: str

    @property
    def available(self) -> bool:
        """Whether the pair runs on some device of this machine."""
        return bool(self.devices)


FLOATS = (torch.float32, torch.float16, torch.bfloat16)
COORDINATES = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
EVERYWHERE = ("cpu", "cuda")
PLAIN = Implementation(EVERYWHERE, plain=True)

_TABLE: dict[tuple[str, str], Implementation] = {}
_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {}


def declare(
    op: str,
    *,
    native: Implementation | None = None,
    warp: Implementation | None = None,
    reference: Implementation = Implementation(),
    runs: str | None = None,
) -> str:
    """Puts the row of an op into the table, and returns its name. None: the op has no such implementation.

    An implementation is the function of the op's name in a module of the op's name, unless ``file`` says another:
    ``voronerf.ops.<op>.reference``, ``voronerf.ops.<op>.native`` or ``voronerf.kernels.<op>``, imported on first use.
    ``runs``: another op, whose row and implementations this one takes over.
    """
    if runs is not None:
        reference, native, warp = (replace(_TABLE[runs, backend], function=runs) for backend in BACKENDS)
    for backend, implementation in zip(BACKENDS, (reference, native, warp), strict=True):
        if implementation is not None:
            _TABLE[op, backend] = implementation
    return op


def ops(backend: str = "reference", device: str = "cpu") -> tuple[str, ...]:
    """Names of the ops that a backend implements for a device, which declare themselves where voronerf is imported."""
    return tuple(op for (op, name), found in _TABLE.items() if name == backend and device in (found.devices or ORDER))


def implemented(op: str) -> tuple[str, ...]:
    """Backends that have an implementation of their own of an op, whether or not it can run here."""
    return tuple(name for name in BACKENDS if (op, name) in _TABLE and not _TABLE[op, name].plain)


def resolve(op: str, *, backend: str, device: torch.device, dtype: torch.dtype) -> Callable[..., Any]:
    """Implementation of `op` for a device and dtype, with the signature of the reference function.

    Works inside ``torch.compile(fullgraph=True)``: the choice is made while tracing.

    Args:
        op: name of the op, one of ``ops()``.
        backend: ``"auto"`` or a name from ``BACKENDS``.
        device: device of the op's tensors.
        dtype: dtype of the op's first tensor argument.

    Raises:
        ValueError: unknown op or backend.
        BackendUnavailable: the named backend is not available, or does not support this device or dtype.
    """
    return _FUNCTIONS[op, _choose(op, backend, device.type, device.index, dtype)]


def resolve_composed(op: str, *, backend: str, device: torch.device, dtype: torch.dtype) -> Callable[..., Any]:
    """`resolve` of an op whose reference calls other ops, and takes their ``backend``.

    With "auto" it calls them where no other implementation runs, each on the backend that "auto" gives it; and where
    the implementation is plain, on the backend that was named.
    """
    return function(op, _choose(op, backend, device.type, device.index, dtype), backend, composed=True)


def function(op: str, name: str, backend: str, composed: bool) -> Callable[..., Any]:
    """The implementation that was chosen for ``backend`` by its name; ``composed``: see `resolve_composed`."""
    run = _FUNCTIONS[op, name]
    passed = composed and (_TABLE[op, name].plain or (name == "reference" and backend == "auto"))
    return functools.partial(run, backend=backend) if passed else run


def folder(op: str) -> str:
    """The folder of ``voronerf.ops`` that has an op."""
    return _TABLE[op, "reference"].file or op


def chosen(op: str, device: torch.device, dtype: torch.dtype, *, backend: str = "auto") -> str:
    """Name of the implementation that :func:`resolve` gives, with the same arguments and errors."""
    return _choose(op, backend, device.type, device.index, dtype)


def why_not(op: str, backend: str, device: torch.device, dtype: torch.dtype | None = None) -> str | None:
    """Why a backend cannot run an op, with the remedy if there is one; None if it can.

    Args:
        op: name of the op.
        backend: a name from ``BACKENDS``.
        device: device of the op's tensors.
        dtype: dtype of the op's first tensor argument; None to ignore it.
    """
    implementation = _TABLE.get((op, backend))
    if implementation is None:
        return f"there is no {backend} implementation of {op}; use backend={_choices(implemented(op))}"
    if implementation.devices and device.type not in implementation.devices:
        return f"the {backend} implementation of {op} runs on {_choices(implementation.devices)}, not on {device.type}"
    if dtype is not None and implementation.dtypes and dtype not in implementation.dtypes:
        return (
            f"the {backend} implementation of {op} takes {_choices(_names(implementation.dtypes))}, not {_name(dtype)}"
        )
    return missing(backend, device)


def missing(backend: str, device: torch.device) -> str | None:
    """Reason, with the remedy, why a backend as a whole cannot run on a device here; None if it can."""
    if device.type == "cuda" and not torch.cuda.is_available():
        return "torch sees no CUDA device; use device='cpu', or a CUDA build of torch on a machine with a GPU"
    if backend == "reference":
        return None
    try:
        module = _import(_PACKAGES[backend])
    except BackendUnavailable as error:
        if backend == "native":
            _warn_once(f"{error}. Until then plain PyTorch runs in its place, many times slower.")
        return str(error)
    reason: str | None = module.missing(device)
    return reason


def automatic(device: torch.device) -> str:
    """What "auto" takes on a device, and why not what it prefers: one line, such as "warp (native: no GPU code)"."""
    reasons: list[str] = []
    for name in ORDER[device.type]:
        reason = missing(name, device)
        if reason is None:
            return f"{name} ({'; '.join(reasons)})" if reasons else name
        reasons.append(f"{name}: {reason}")
    return f"nothing ({reason})"


def _import(module: str) -> ModuleType:
    """A backend's module. Run from its source folder, the package has no ``voronerf.kernels``, which lie beside it.

    Raises:
        BackendUnavailable: It cannot be used here.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != "voronerf.kernels":
            raise
        raise BackendUnavailable("the Warp kernels are not installed; run `pip install -e .`") from None


def compiled() -> Any:
    """The package of the compiled module, which checks calls; None where it cannot be used."""
    try:
        return _compiled()
    except ValueError:  # of what the process asks it for: a call of that backend says so
        return None


@functools.cache
def _compiled() -> Any:
    try:
        return _import(_PACKAGES["native"])
    except BackendUnavailable:
        return None


@functools.cache
def _warn_once(line: str) -> None:
    """Warns of what keeps a backend from being used, the first time in a process that it is asked for."""
    warnings.warn(line, RuntimeWarning, stacklevel=2)


class _Kept(threading.local):
    threads: int | None = None


_kept = _Kept()


def cpu_precision() -> str:
    """``torch.set_float32_matmul_precision`` of the CPU: "ieee" (highest), "tf32" (high) or "bf16" (medium)."""
    if _precision is not None:
        return str(_precision("mkldnn", "matmul"))
    backend: Any = torch.backends.mkldnn  # whose stubs lack it
    return str(backend.matmul.fp32_precision)


# What the public property calls, in a fifteenth of its time.
_precision: Callable[[str, str], str] | None = getattr(torch._C, "_get_fp32_precision_getter", None)


def threads() -> int:
    """Threads that share the work of an op: torch's for the calling thread, or what `torch_on_one_thread` keeps."""
    return _kept.threads or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Runs torch's own operators on the calling thread, while native ops keep its number of threads.

    Results of native ops do not depend on that number. Those of torch do: a long sum is split among the threads, and
    the last elements of each one's part are computed by other instructions than the rest.
    """
    before, of_torch = _kept.threads, torch.get_num_threads()
    if of_torch == 1:
        yield
        return
    _kept.threads = threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(of_torch)
        _kept.threads = before


def table() -> list[Row]:
    """Every op and backend: where it runs here, which dtypes it takes, and what is missing."""
    rows = []
    for op in ops():
        for backend in BACKENDS:
            reasons = {device: why_not(op, backend, torch.device(device)) for device in ORDER}
            implementation = _TABLE.get((op, backend))
            dtypes = () if implementation is None else _names(implementation.dtypes) or ("any",)
            if implementation is not None and implementation.plain:
                dtypes = ("plain torch",)
            devices = tuple(device for device, reason in reasons.items() if reason is None)
            distinct = dict.fromkeys(reason for reason in reasons.values() if reason is not None)
            rows.append(Row(op, backend, devices, dtypes, "; ".join(distinct)))
    return rows


def describe() -> dict[str, Any]:
    """Describes this installation: versions, threads, and how the compiled module was built."""
    from voronerf import __version__

    return {
        "voronerf": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "cuda devices": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
        "auto": {f"on {name}": automatic(torch.device(name)) for name in ORDER},
        "native": _describe("voronerf.ops._core.native"),
        "warp": _describe("voronerf.kernels"),
    }


def _describe(module: str) -> dict[str, Any]:
    try:
        described: dict[str, Any] = _import(module).describe()
    except BackendUnavailable as error:
        return {"available": False, "reason": str(error)}
    return {"available": True, **described}


# torch.compile runs this while tracing and keeps the answer; the function is then found by a look-up it can trace.
@constant_result
def _choose(op: str, backend: str, device: str, index: int | None, dtype: torch.dtype) -> str:
    if not isinstance(backend, str):  # which a list would not let the cache look up
        raise ValueError(f"{op}: backend must be one of {_choices(('auto', *BACKENDS))}, got {backend!r:.60}")
    return _choose_once(op, backend, device, index, dtype)


@functools.cache
def _choose_once(op: str, backend: str, device_type: str, index: int | None, dtype: torch.dtype) -> str:
    if (op, "reference") not in _TABLE:
        raise ValueError(f"resolve: op must be one of {_choices(ops())}, got {op!r}")
    if backend != "auto" and backend not in BACKENDS:
        raise ValueError(f"{op}: backend must be one of {_choices(('auto', *BACKENDS))}, got {backend!r:.60}")
    device = torch.device(device_type) if index is None else torch.device(device_type, index)
    if backend == "auto":
        order = ORDER.get(device_type, ("reference",))
        own = implemented(op)
        backend = next(name for name in order if name in own and why_not(op, name, device, dtype) is None)
    else:
        reason = why_not(op, backend, device, dtype)
        if reason is not None:
            raise BackendUnavailable(f"{op}: backend {backend!r} is not available: {reason}")
    module = _MODULES["reference" if _TABLE[op, backend].plain else backend]
    found = _TABLE[op, "reference" if _TABLE[op, backend].plain else backend]
    name = found.function or op
    _FUNCTIONS[op, backend] = getattr(importlib.import_module(module.format(found.file or name)), name)
    return backend


def _choices(names: tuple[str, ...] | list[str]) -> str:
    return " | ".join(repr(name) for name in names)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _names(dtypes: tuple[torch.dtype, ...]) -> tuple[str, ...]:
    return tuple(_name(dtype) for dtype in dtypes)
