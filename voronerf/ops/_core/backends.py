"""The choice of an op's implementation.

Each op of ``voronerf/ops`` declares its implementations in one table. One predicate, `why_not`, decides whether a
backend can run an op, and gives the reason if it cannot.

An op has up to three implementations, all with the signature of its reference function:

    reference   plain PyTorch, any device and dtype: the executable specification
    native      csrc/, C++ and CUDA
    warp        kernels/, NVIDIA Warp, one source for CPU and CUDA; a ``PLAIN`` entry runs the reference instead

``backend="auto"`` takes the first entry in the device's order that is available, supports the call and is not
``PLAIN``. The choice never depends on timing. The reference is the last entry on CUDA too, so every op runs on every
device, although not every op has a CUDA kernel. A backend that the caller names has no fallback: if it cannot run, the
call raises :class:`BackendUnavailable` with the reason and the remedy.
"""

from __future__ import annotations

import functools
import importlib
import platform
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch

from voronerf.ops._core.compiler import constant_result

BACKENDS = ("reference", "native", "warp")
_MODULES = {"reference": "voronerf.ops.{}.reference", "native": "voronerf.ops.{}.native", "warp": "voronerf.kernels.{}"}
_PACKAGES = {"native": "voronerf.ops._core.native", "warp": "voronerf.kernels"}
ORDER = {"cpu": ("native", "reference"), "cuda": ("native", "warp", "reference")}


class BackendUnavailable(RuntimeError):
    """The error of a named backend that cannot run here; the message has the reason and the remedy."""


@dataclass(frozen=True)
class Implementation:
    """One implementation of an op: its devices, its dtypes and its module."""

    devices: tuple[str, ...] = ()  # device types; empty for any
    dtypes: tuple[torch.dtype, ...] = ()  # supported dtypes of the op's first tensor; empty for any
    file: str | None = None  # the op whose module has the function; None for the op itself
    function: str | None = None  # the function's name; None if it is the op's name
    plain: bool = False  # whether the backend uses the reference, because the op needs no kernel


@dataclass(frozen=True)
class Availability:
    """One line of the table of ops and backends, as `voronerf info` prints it.

    Attributes:
        op: name of the op.
        backend: name of the backend.
        devices: device types on which the backend can run the op here and now.
        dtypes: names of the supported dtypes; ``("any",)`` for all dtypes; ``("plain torch",)`` if the backend runs the
            reference instead of a kernel; empty if the backend does not implement the op.
        reason: one line on why the backend cannot run the op on all devices; empty if it can.
    """

    op: str
    backend: str
    devices: tuple[str, ...]
    dtypes: tuple[str, ...]
    reason: str

    @property
    def available(self) -> bool:
        """Returns whether the backend can run the op on some device of this machine."""
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
    """Adds the row of an op to the table and returns the op's name. A missing implementation is None.

    By default an implementation is a function with the op's name, in a module with the op's name:
    ``voronerf.ops.<op>.reference``, ``voronerf.ops.<op>.native`` or ``voronerf.kernels.<op>``, imported on first use.
    ``runs`` names another op, whose row and implementations this op shares.
    """
    if runs is not None:
        reference, native, warp = (_TABLE[runs, backend] for backend in BACKENDS)
    for backend, implementation in zip(BACKENDS, (reference, native, warp), strict=True):
        if implementation is not None:
            _TABLE[op, backend] = implementation
    return op


def ops(backend: str = "reference", device: str = "cpu") -> tuple[str, ...]:
    """Returns the names of the ops that a backend implements for a device. Ops register on the import of voronerf."""
    return tuple(op for (op, name), entry in _TABLE.items() if name == backend and device in (entry.devices or ORDER))


def implemented(op: str) -> tuple[str, ...]:
    """Returns the backends with a separate implementation of an op, whether or not they can run here."""
    return tuple(name for name in BACKENDS if (op, name) in _TABLE and not _TABLE[op, name].plain)


def resolve(op: str, *, backend: str, device: torch.device, dtype: torch.dtype) -> Callable[..., Any]:
    """Returns the implementation of `op` for a device and dtype, with the signature of the reference function.

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
    return _FUNCTIONS[op, _choose(op, backend, device, dtype)]


def resolve_composed(op: str, *, backend: str, device: torch.device, dtype: torch.dtype) -> Callable[..., Any]:
    """Resolves an op whose reference calls other ops and takes a ``backend`` for them.

    The reference receives "auto" if "auto" falls back to the reference, so that the choice is made for each inner op.
    It receives the named backend if that backend's implementation is ``PLAIN``, so that the inner ops run there.
    """
    return function(op, _choose(op, backend, device, dtype), backend, composed=True)


def function(op: str, name: str, backend: str, composed: bool) -> Callable[..., Any]:
    """Returns the implementation of an op by its name, after `chosen` has returned this name.

    Args:
        op: the name of the op.
        name: the name of the implementation.
        backend: the backend that the caller requested.
        composed: whether the op's reference takes a ``backend`` for the ops it calls; see `resolve_composed`.
    """
    run = _FUNCTIONS[op, name]
    passed = composed and (_TABLE[op, name].plain or (name == "reference" and backend == "auto"))
    return functools.partial(run, backend=backend) if passed else run


def folder(op: str) -> str:
    """Returns the name of an op's folder in ``voronerf.ops``."""
    return _TABLE[op, "reference"].file or op


def chosen(op: str, device: torch.device, dtype: torch.dtype, *, backend: str = "auto") -> str:
    """Returns the name of the implementation that :func:`resolve` returns, with the same arguments and errors."""
    return _choose(op, backend, device, dtype)


def why_not(op: str, backend: str, device: torch.device, dtype: torch.dtype | None = None) -> str | None:
    """Returns why a backend cannot run an op, with the remedy if there is one; None if it can.

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
    """Returns why a backend cannot run any op on a device here, with the remedy; None if it can."""
    if device.type == "cuda" and not torch.cuda.is_available():
        return "torch sees no CUDA device; use device='cpu', or a CUDA build of torch on a machine with a GPU"
    if backend == "reference":
        return None
    try:
        module = _import(_PACKAGES[backend])
    except BackendUnavailable as error:
        if backend == "native":
            _warn_once(f"{error}. Until then the much slower plain PyTorch is used.")
        return str(error)
    reason: str | None = module.missing(device)
    return reason


def automatic(device: torch.device) -> str:
    """Returns the choice of "auto" on a device, and what rules out other backends: "warp (native: no GPU code)"."""
    reasons: list[str] = []
    for name in ORDER[device.type]:
        reason = missing(name, device)
        if reason is None:
            return f"{name} ({'; '.join(reasons)})" if reasons else name
        reasons.append(f"{name}: {reason}")
    return f"nothing ({reason})"


def _import(module: str) -> ModuleType:
    """Imports a backend's module.

    Without an installation, ``voronerf.kernels`` is missing, because its folder kernels/ lies beside the package.

    Raises:
        BackendUnavailable: The backend cannot be used here.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != "voronerf.kernels":
            raise
        raise BackendUnavailable("the Warp kernels are not installed; run `pip install -e .`") from None


def compiled() -> Any:
    """Returns the package of the compiled module, or None if it cannot be used."""
    try:
        return _compiled()
    except ValueError:  # a bad VORONERF_ISA: a call with backend="native" reports it
        return None


@functools.cache
def _compiled() -> Any:
    try:
        return _import(_PACKAGES["native"])
    except BackendUnavailable:
        return None


@functools.cache
def _warn_once(line: str) -> None:
    """Warns that a backend cannot be used, once per process and message."""
    warnings.warn(line, RuntimeWarning, stacklevel=2)


class _ThreadOverride(threading.local):
    threads: int | None = None


_override = _ThreadOverride()


def cpu_precision() -> str:
    """Returns torch's float32 matmul precision on the CPU: "ieee" (highest), "tf32" (high) or "bf16" (medium)."""
    if _precision is not None:
        return str(_precision("mkldnn", "matmul"))
    backend: Any = torch.backends.mkldnn  # the stubs of mkldnn lack matmul
    return str(backend.matmul.fp32_precision)


# The function behind the public property takes a fifteenth of the time of the property.
_precision: Callable[[str, str], str] | None = getattr(torch._C, "_get_fp32_precision_getter", None)


def threads() -> int:
    """Returns the number of threads of native ops: torch's, or the number that `torch_on_one_thread` has saved."""
    return _override.threads or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Runs torch's operators on the calling thread alone; native ops keep their number of threads.

    The results of native ops do not depend on the number of threads. Torch's results do: torch splits a long sum among
    the threads, and computes the last elements of each part with other instructions than the rest.
    """
    previous, torch_threads = _override.threads, torch.get_num_threads()
    if torch_threads == 1:
        yield
        return
    _override.threads = threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_threads)
        _override.threads = previous


def table() -> list[Availability]:
    """Returns the `Availability` of every pair of op and backend."""
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
            rows.append(Availability(op, backend, devices, dtypes, "; ".join(distinct)))
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


# torch.compile calls this while tracing and treats the result as a constant. The look-up in _FUNCTIONS can be traced.
@constant_result
def _choose(op: str, backend: str, device: torch.device, dtype: torch.dtype) -> str:
    if not isinstance(backend, str):  # an unhashable backend, such as a list, cannot be a cache key
        raise ValueError(f"{op}: backend must be one of {_choices(('auto', *BACKENDS))}, got {backend!r:.60}")
    return _choose_once(op, backend, *_kind(device), dtype)


@functools.cache  # reading the type makes a new text, which takes longer than all the rest of a choice
def _kind(device: torch.device) -> tuple[str, int | None]:
    return device.type, device.index


@functools.cache
def _choose_once(op: str, backend: str, device_type: str, index: int | None, dtype: torch.dtype) -> str:
    if (op, "reference") not in _TABLE:
        raise ValueError(f"resolve: op must be one of {_choices(ops())}, got {op!r}")
    if backend != "auto" and backend not in BACKENDS:
        raise ValueError(f"{op}: backend must be one of {_choices(('auto', *BACKENDS))}, got {backend!r:.60}")
    device = torch.device(device_type) if index is None else torch.device(device_type, index)
    if backend == "auto":
        order = ORDER.get(device_type, ("reference",))
        separate = implemented(op)
        backend = next(name for name in order if name in separate and why_not(op, name, device, dtype) is None)
    else:
        reason = why_not(op, backend, device, dtype)
        if reason is not None:
            raise BackendUnavailable(f"{op}: backend {backend!r} is not available: {reason}")
    module = _MODULES["reference" if _TABLE[op, backend].plain else backend]
    implementation = _TABLE[op, "reference" if _TABLE[op, backend].plain else backend]
    name = implementation.function or op
    _FUNCTIONS[op, backend] = getattr(importlib.import_module(module.format(implementation.file or name)), name)
    return backend


def _choices(names: tuple[str, ...] | list[str]) -> str:
    return " | ".join(repr(name) for name in names)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _names(dtypes: tuple[torch.dtype, ...]) -> tuple[str, ...]:
    return tuple(_name(dtype) for dtype in dtypes)
