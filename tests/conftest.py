"""Device and backend fixtures, and the option ``--require``.

A test that takes ``device`` and ``backend`` runs once for every pair; ``@pytest.mark.op("nearest_centre")`` keeps the
pairs that implement that op. Taking ``device`` alone runs it on each device, ``backend`` alone on each backend of the
CPU::

    @pytest.mark.op("nearest_centre")
    def test_ties(device, backend):  # reference-cpu, native-cpu, warp-cpu, reference-cuda, native-cuda, warp-cuda
        cells = voronerf.nearest_centre(points.to(device), centres.to(device), backend=backend)

    def test_empty(device):  # cpu, cuda
        ...

``@pytest.mark.native``, ``@pytest.mark.cuda`` and ``@pytest.mark.warp`` mark tests that need the compiled module, a GPU
or Warp. A test whose requirement is missing is skipped, with the reason; ``--require native,cuda,warp`` turns these
skips into failures.

``--device-in-package DEVICE`` gives the package, but not the tests, a default device.

``--emulate-cuda SEED`` runs the native backend's CUDA kernels on the CPU, instead of its CPU kernels (cuda_emulation/).
"""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors

import voronerf
from voronerf.ops._core import backends

PARTS = ("native", "cuda", "warp")
PACKAGE = str(Path(voronerf.__file__).parent)
NO_CUDA = backends.missing("reference", torch.device("cuda")) is not None

pytest_plugins = ("pytester",)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--require", default="", help=f"parts that must be present, from {','.join(PARTS)}")
    parser.addoption("--device-in-package", metavar="DEVICE", help="the default device of calls in the package")
    parser.addoption(
        "--emulate-cuda", type=int, metavar="SEED", help="run the native backend's CUDA kernels on the CPU"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "op(name): run on the backends that implement this op")
    unknown = _required(config) - set(PARTS)
    if unknown:
        raise pytest.UsageError(f"--require takes {','.join(PARTS)}, got {','.join(sorted(unknown))}")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    wants_device = "device" in metafunc.fixturenames
    wants_backend = "backend" in metafunc.fixturenames
    parametrized = {name for mark in metafunc.definition.iter_markers("parametrize") for name in _names(mark)}
    if parametrized & {"device", "backend"}:
        return
    devices = ("cpu", "cuda") if wants_device else ("cpu",)
    if not wants_backend:
        if wants_device:
            metafunc.parametrize("device", devices, indirect=True)
        return
    mark = metafunc.definition.get_closest_marker("op")
    names = backends.BACKENDS if mark is None else backends.implemented(mark.args[0])
    if wants_device:
        pairs = [(backend, device) for device in devices for backend in names]
        if mark is not None:  # some implementations support one device only
            pairs = [pair for pair in pairs if mark.args[0] in backends.ops(*pair)]
        if NO_CUDA:  # one CUDA row stays, to report the skip
            pairs = pairs[: 1 + sum(device != "cuda" for _, device in pairs)]
        metafunc.parametrize(("backend", "device"), pairs, indirect=["device"], ids=["-".join(pair) for pair in pairs])
    else:
        metafunc.parametrize("backend", names)


@pytest.fixture
def device(request: pytest.FixtureRequest) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(params=["portable", "neon", "avx2", "avx512", "avx512_bf16", "amx"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Runs the native CPU kernels with each instruction set of this processor, and returns the set's name."""
    native = pytest.importorskip("voronerf.ops._core.native")
    if request.param not in native.SUPPORTED_ISAS:
        pytest.skip(f"this processor has no {request.param}")
    with native.using_isa(request.param):
        yield request.param


@pytest.fixture
def poisoned(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[torch.Tensor]]:
    """Makes ``Tensor.new_empty`` and ``torch.empty`` return poison; the fixture's value is the growing list of guards.

    New tensors hold NaN, 121 or False, and lie between two guards with the same values. The test fails if a guard
    changes.
    """
    guards: list[torch.Tensor] = []

    def empty(*shape: Any, dtype: torch.dtype = torch.float32, device: Any = "cpu") -> torch.Tensor:
        size = torch.Size(shape if not shape or isinstance(shape[0], int) else shape[0])
        poison = float("nan") if dtype.is_floating_point else False if dtype == torch.bool else 121
        memory = torch.full((size.numel() + 64,), poison, dtype=dtype, device=device)
        guards.extend((memory[:32], memory[size.numel() + 32 :]))
        return memory[32 : size.numel() + 32].view(size)

    def new_empty(like: torch.Tensor, *shape: Any, dtype: torch.dtype | None = None) -> torch.Tensor:
        return empty(*shape, dtype=dtype or like.dtype, device=like.device)

    monkeypatch.setattr(torch.Tensor, "new_empty", new_empty)
    monkeypatch.setattr(torch, "empty", empty)
    yield guards
    for guard in guards:
        whole = guard.isnan() if guard.is_floating_point() else guard == (0 if guard.dtype == torch.bool else 121)
        assert whole.all(), "a kernel wrote outside of a tensor"


class DeviceInPackage(TorchFunctionMode):
    """A default device, as of ``torch.set_default_device``, for the calls of functions in voronerf/ alone.

    A call of a test's module that a mode of the package passes on, or that the package repeats, is no call of the
    package.
    """

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = torch.device(device)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in _device_constructors() and kwargs.get("device") is None and self._in_package(func):
            kwargs = {**kwargs, "device": self.device}
        return func(*args, **kwargs)

    def _in_package(self, func: Any) -> bool:
        frame: FrameType | None = sys._getframe(2)
        first = frame
        while frame is not None and frame.f_code.co_filename.startswith(PACKAGE):
            if getattr(frame.f_locals.get("node"), "target", None) == func:
                return False
            passed_on = frame.f_code.co_name == "__torch_function__" and frame.f_locals.get("func") == func
            frame = frame.f_back
            first = frame if passed_on else first
        return first is not None and first.f_code.co_filename.startswith(PACKAGE)


@pytest.fixture(autouse=True)
def _surroundings(request: pytest.FixtureRequest) -> Iterator[None]:
    """Gives each test the same seed, and applies ``--device-in-package`` and ``--emulate-cuda``."""
    torch.default_generator.manual_seed(0)  # torch.manual_seed is slower: it formats the stack per device type
    if not NO_CUDA:
        torch.cuda.manual_seed_all(0)
    device, seed = map(request.config.getoption, ("--device-in-package", "--emulate-cuda"))
    with contextlib.ExitStack() as stack:
        if device is not None:
            stack.enter_context(DeviceInPackage(device))
        if seed is not None:
            sys.path.append(str(Path(__file__).parent / "cuda_emulation"))
            from emulated import emulated

            stack.enter_context(emulated(seed=seed))
        yield


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keeps only one of a test's parametrised variants that need an absent GPU; the kept variant reports the skip."""
    seen: set[str] = set()
    rows: tuple[list[pytest.Item], list[pytest.Item]] = [], []
    for item in items:
        absent = any(part == "cuda" for part, _ in _absent(item))
        name = item.nodeid.partition("[")[0]
        rows[absent and name in seen].append(item)
        if absent:
            seen.add(name)
    items[:] = rows[0]
    config.hook.pytest_deselected(items=rows[1])


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Excludes torch and the collected tests from garbage collection, which would scan them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="module", autouse=True)
def _freeze() -> Iterator[None]:
    """Excludes what a file of tests has imported, such as torch's compiler, too."""
    yield
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    for part, reason in _absent(item):
        if part in _required(item.config):
            pytest.fail(f"--require {part}: {reason}", pytrace=False)
        pytest.skip(f"{part}: {reason}")


def _absent(item: pytest.Item) -> Iterator[tuple[str, str]]:
    """Yields (part, reason) for each part that a test needs and this machine lacks."""
    params = getattr(getattr(item, "callspec", None), "params", {})
    device = torch.device(params.get("device", "cpu"))
    named = {part for part in PARTS if item.get_closest_marker(part) is not None}
    if device.type == "cuda" or "cuda" in named:
        device = torch.device("cuda")
        reason = backends.missing("reference", device)
        if reason is not None:
            yield "cuda", reason
            return
    for backend in sorted(({params.get("backend", "auto")} | named) & {"native", "warp"}):
        reason = backends.missing(backend, device)
        if reason is not None:
            yield backend, reason


def _required(config: pytest.Config) -> set[str]:
    return {part for part in config.getoption("--require").split(",") if part}


def _names(mark: pytest.Mark) -> list[str]:
    names = mark.args[0] if mark.args else mark.kwargs["argnames"]
    return [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
