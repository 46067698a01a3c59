"""Emulates CUDA graphs: ``with emulated(), graphs() as seen: ...``.

A capture computes nothing: it stores launches of this project's kernels and of torch's operations, and only replays run
them. Where the capture allocated memory, each replay poisons this memory, since a GPU may reuse the memory of a freed
tensor. A read by the host, which ends a capture on a GPU, raises an error here. In torch's sync debug mode, a read only
warns. Streams are always ordered.
"""

from __future__ import annotations

import sys
import traceback
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import torch
from launches import FREE, reads
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from voronerf.ops._core import native as _native

ASKED = "_workspace", "multiplies_halves"
"""Name suffixes of compiled functions that only answer a question of the host, such as a size, and launch no kernel."""


class Warned(TorchDispatchMode):
    """A dispatch mode that warns of reads by the host, like ``torch.cuda.set_sync_debug_mode("warn")``."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        if reads(function, args):
            asks = next(f for f, _ in traceback.walk_stack(sys._getframe(1)) if "torch" not in f.f_code.co_filename)
            where = asks.f_code.co_filename, asks.f_lineno  # skips torch's Python code, which is C++ on a GPU
            warnings.warn_explicit("called a synchronizing CUDA operation", UserWarning, *where)
        return function(*args, **(kwargs or {}))


class Graph(TorchDispatchMode):
    """A stand-in for ``torch.cuda.CUDAGraph``, which is a dispatch mode during its capture."""

    def __init__(self, seen: Seen) -> None:
        super().__init__()
        self._seen, self._work, self._generators = seen, list[Callable[[], Any]](), set[int]()
        self._handle = seen.handle()

    def register_generator_state(self, generator: torch.Generator) -> None:
        self._seen.calls.append("register")
        self._generators.add(generator._cdata)

    def pool(self) -> Graph:
        return self

    def add(self, function: Callable[..., Any], *args: Any) -> None:
        self._work.append(lambda: function(*args))

    def replay(self) -> None:
        self._seen.calls.append("replay")
        with torch.no_grad():  # the backward was captured as well
            for each in self._work:
                each()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        kwargs = kwargs or {}
        assert not reads(function, args), f"{function} in a capture"
        name = function.overloadpacket.__name__
        if function.is_view or name in FREE:
            result = function(*args, **kwargs)
            if "empty" in name:
                result.zero_()  # torch may read the memory as an index to find shapes
                self.add(result.fill_, float("nan") if result.is_floating_point() else 77)
            return result
        generator = kwargs.get("generator")
        assert generator is None or generator._cdata in self._generators, "not registered"
        state = None if generator is None else generator.get_state()
        written = {
            id(value): value
            for value, about in zip((*args, *kwargs.values()), function._schema.arguments, strict=False)
            if about.alias_info is not None and about.alias_info.is_write
        }
        before = [(value, value.clone()) for value in written.values()]
        result = function(*args, **kwargs)
        for value, was in before:
            value.copy_(was)
        if state is not None:
            generator.set_state(state)
        new = [value for value in tree_leaves(result) if isinstance(value, Tensor) and id(value) not in written]
        for value in new:
            value.zero_()

        def again() -> None:
            found = function(*args, **kwargs)
            for value, other in zip(new, tree_leaves(found) if new else (), strict=True):
                value.copy_(other)

        self.add(again)
        return result


class Kernels:
    """A wrapper of the compiled module; during a capture, its functions store launches instead of running them."""

    def __init__(self, compiled: Any, seen: Seen) -> None:
        self._compiled, self._seen = compiled, seen

    def __getattr__(self, name: str) -> Any:
        entry, graph = getattr(self._compiled, name), self._seen.capturing
        if graph is None or isinstance(entry, type) or not callable(entry) or name.endswith(ASKED):
            return entry

        def call(*arguments: Any) -> Any:
            assert not any(isinstance(each, _native.compiled.Cpu) for each in arguments), f"{name} of the processor"
            if any(isinstance(each, _native.compiled.Cuda) for each in arguments):
                return graph.add(entry, *arguments)
            return entry(*arguments)

        return call


class Seen:
    """The recorded use of torch's graphs.

    Attributes:
        calls: The calls in order: "register", "capture", "replay"; "destroyed in a capture" for a graph that is
            destroyed during another one's capture, which invalidates it.
        pools: The memory pool argument of each capture.
        capturing: The graph in capture, or None.
    """

    def __init__(self) -> None:
        self.calls, self.pools = list[str](), list[Any]()
        self.capturing: Graph | None = None
        self._handles = list[weakref.ref[Any]]()

    def handle(self) -> np.ndarray:
        """Returns a stand-in for the driver's graph: the collector does not track it, so only its last reference
        destroys it."""

        def destroyed(_: Any) -> None:
            if self.capturing is not None:
                self.calls.append("destroyed in a capture")

        handle = np.empty(0)
        self._handles.append(weakref.ref(handle, destroyed))
        return handle

    @contextmanager
    def capture(self, graph: Graph, pool: Any, stream: Any, capture_error_mode: str) -> Iterator[None]:
        self.calls.append("capture")
        self.pools.append(pool)
        self.capturing = graph
        with graph:
            yield
        self.capturing = None


@contextmanager
def graphs() -> Iterator[Seen]:
    """Replaces torch's graphs and streams by the emulation inside the block."""
    seen, modes = Seen(), ExitStack()

    def set_mode(mode: str) -> None:
        modes.close()
        if mode == "warn":
            modes.enter_context(Warned())

    doubles = {
        "Stream": lambda device: SimpleNamespace(wait_stream=lambda other: None),
        "current_stream": lambda device: SimpleNamespace(wait_stream=lambda other: None),
        "stream": nullcontext,
        "CUDAGraph": lambda: Graph(seen),
        "graph": seen.capture,
        "get_sync_debug_mode": lambda: 0,
        "set_sync_debug_mode": set_mode,
    }
    with (
        mock.patch.multiple(torch.cuda, **doubles),
        mock.patch("voronerf.nerf.TrainingStep._on_gpu", lambda step: True),
        mock.patch("voronerf.ops._core.custom_op.LISTENERS", []),
        mock.patch.object(_native, "compiled", Kernels(_native.compiled, seen)),
    ):
        yield seen
