"""Tests that the library changes no foreign class, hook, variable, signal handler or limit of its host process."""

from __future__ import annotations

import cProfile
import gc
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from voronerf import VoronoiRouter

PROCESS = """
import gc, os, signal, sys, threading, torch
def state():
    handlers = [signal.getsignal(n) for n in signal.valid_signals()]
    threads = torch.get_num_threads(), torch.get_num_interop_threads(), sys.excepthook
    return dict(os.environ), gc.isenabled(), gc.get_threshold(), gc.get_freeze_count(), handlers, threads
torch.optim.Adam([torch.nn.Parameter(torch.ones(1))])  # torch's first one sets variables of its compiler
before = state()
import voronerf.nerf, voronerf.router, voronerf.app.cli, voronerf.app.train, voronerf.editing
from voronerf import VoronoiRouter
assert state() == before
field = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.ReLU(), torch.nn.Linear(64, 4))
for way in ("fused", "grouped", "loop"):
    router = VoronoiRouter(field, torch.rand(8, 3), coords="first3", fuse=True, way=way)
    optimizer = torch.optim.Adam(router.parameters())
    router.freeze([0], optimizer=optimizer)
    for _ in range(2):
        router(torch.rand(4096, 3)).square().mean().backward()
        optimizer.step()
    router.subdivide(2, optimizer=optimizer, points=torch.rand(500, 3), weights=torch.ones(500))
assert state() == before
"""


class Truncated(torch.autograd.Function):
    """An exponential with a custom gradient, as in torch-ngp."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * x.clamp(-15, 15).exp()


class Field(nn.Module):
    """A field that calls ``host`` in each ``forward``, also while it is traced."""

    scale, host = 2.0, staticmethod(lambda: None)

    def __init__(self) -> None:
        super().__init__()
        self.net, self.last = nn.Sequential(nn.Linear(3, 16), nn.ReLU()), nn.Linear(16, 1)

    def forward(self, x: Tensor) -> Tensor:
        type(self).host()
        return Truncated.apply(self.last(self.net(x)) * self.scale)


def host() -> list[Any]:
    """Returns all state of PyTorch and of the process that the library could change."""
    function = torch.autograd.function
    classes = [nn.Module, nn.Linear, function.Function, function._SingleLevelFunction, torch.optim.Optimizer, Tensor]
    optimizer, module = sys.modules[torch.optim.Optimizer.__module__], nn.modules.module
    hooks = [optimizer._global_optimizer_pre_hooks, optimizer._global_optimizer_post_hooks]
    hooks += [module._global_forward_hooks, module._global_forward_pre_hooks, module._global_backward_hooks]
    process = [dict(os.environ), gc.isenabled(), gc.get_threshold(), signal.getsignal(signal.SIGINT)]
    return [*(dict(vars(kind)) for kind in classes), vars(function).copy(), *map(dict, hooks), *process]


@pytest.mark.native
def test_a_process_that_trains_is_as_it_was() -> None:
    run = subprocess.run([sys.executable, "-c", PROCESS], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.native
def test_limits_of_malloc_are_the_programs() -> None:
    """Only the command line sets malloc's limits, which no program can read back."""
    from voronerf.ops._core.native import compiled

    assert b"mallopt" not in Path(compiled.__file__).read_bytes()
    package = Path(compiled.__file__).parents[2]
    names = {path.relative_to(package).as_posix() for path in package.rglob("*.py") if "mallopt" in path.read_text()}
    assert names == {"app/cli/__init__.py"}


def test_classes_and_hooks_are_the_same_during_a_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (torch.optim.Adam, torch.optim.SGD):  # the first step of an optimiser changes its class
        kind(nn.Linear(1, 1).parameters()).step()
    before, during, profiles = host(), list[list[Any]](), list[Any]()
    entered, go_on, other = threading.Event(), threading.Event(), dict[str, Any]()

    def beside() -> None:
        """Trains another module in a second thread while this thread traces."""
        entered.wait(20)
        own, x = Field.__new__(Field), torch.linspace(-1, 1, 30).reshape(10, 3)
        nn.Module.__init__(own)
        own.net, own.last = nn.Linear(3, 4), nn.Linear(4, 1)
        optimizer = torch.optim.SGD(own.parameters(), 0.1)
        result = Truncated.apply(own.last(own.net(x)))
        result.sum().backward()
        optimizer.step()
        other.update(host=host(), profile=sys.getprofile(), type=type(own.last), result=result.detach())
        go_on.set()

    def look() -> None:
        if threading.current_thread() is not thread:
            during.append(host())
            profiles.append(sys.getprofile())
            entered.set()
            go_on.wait(20)

    thread = threading.Thread(target=beside)
    monkeypatch.setattr(Field, "host", staticmethod(look))
    profile, x = sys.getprofile(), torch.rand(60, 3)
    router = VoronoiRouter(Field(), torch.rand(4, 3), coords="first3", fuse=True)
    thread.start()
    router(x)
    thread.join(20)
    optimizer = torch.optim.Adam(router.parameters())
    for _ in range(2):
        router(x).sum().backward()
        optimizer.step()
    assert router.explain().startswith("forward: fused") and len(during) > 2
    assert all(state == before for state in during) and other["host"] == before == host()
    assert any(own is not profile for own in profiles) and sys.getprofile() is profile  # set, then restored
    assert other["profile"] is None and other["type"] is nn.Linear
    router.module.scale = 3.0  # the traced value was 2
    expected = torch.stack([router.cell(int(c))(row[None])[0] for c, row in zip(router.assign(x), x, strict=True)])
    torch.testing.assert_close(router(x), expected)


def test_a_profiler_goes_on_after_a_trace() -> None:
    routers = [VoronoiRouter(Field(), torch.rand(4, 3), coords="first3", fuse=True) for _ in range(2)]
    events, x, before = list[str](), torch.rand(60, 3), sys.getprofile()

    def own(frame: Any, event: str, value: Any) -> None:
        events.append(event)

    sys.setprofile(own)
    try:
        routers[0](x)
        assert sys.getprofile() is own
    finally:
        sys.setprofile(before)
    with cProfile.Profile() as profiler:
        result = routers[1](x)
        result.sum().backward()
    names = {getattr(entry.code, "co_name", "") for entry in profiler.getstats()}
    assert {"forward", "backward"} <= names
    expected = torch.stack([routers[1].cell(int(c))(row[None])[0] for c, row in zip(routers[1].assign(x), x)])
    torch.testing.assert_close(result, expected)
