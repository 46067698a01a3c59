"""Tests, without a GPU, that a default step on Warp reads no tensor on the host: all tensors are on the meta device.

Reading a meta tensor raises, since it has no values. A check for CPU tensors is false, as it is on a GPU.
"""

from __future__ import annotations

import contextlib
import copy

import pytest
import torch
from tiny_runs import small, steps_of
from torch import Tensor

from voronerf.app.train import build
from voronerf.nerf import batches, samplers
from voronerf.ops._core import backends

pytestmark = pytest.mark.warp


def on_meta(tensor: Tensor, memo: dict[int, object]) -> Tensor:
    """Copies a tensor to the meta device, once per tensor; ``memo`` is the memo of `deepcopy`."""
    if id(tensor) not in memo:
        copied = torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device="meta")
        of_parameter = isinstance(tensor, torch.nn.Parameter)
        memo[id(tensor)] = torch.nn.Parameter(copied, tensor.requires_grad) if of_parameter else copied
    return memo[id(tensor)]


def test_a_default_step_reads_nothing_on_the_host(scene, monkeypatch):
    wp = pytest.importorskip("warp")
    before = steps_of(build(small(backend="warp", field="hashgrid", occupancy=True, split_at=(2,)), scene), 4)
    for kind in (Tensor, torch.nn.Parameter):
        monkeypatch.setattr(kind, "__deepcopy__", on_meta)
    monkeypatch.setitem(copy._deepcopy_dispatch, torch.device, lambda device, memo: torch.device("meta"))
    monkeypatch.setitem(copy._deepcopy_dispatch, torch.Generator, lambda generator, memo: generator)
    memo = {id(kept): kept for kept in (before.scene, before.config)}
    state = copy.deepcopy(before, memo)
    for name in vars(before.optimizer).keys() - vars(state.optimizer).keys():  # not copied by deepcopy
        setattr(state.optimizer, name, copy.deepcopy(getattr(before.optimizer, name), memo))

    # Replaces calls that do not support the meta device; ``random_`` would need a generator on it.
    empty = torch.empty(1, dtype=torch.int32, device="meta")
    for module in (batches, samplers):
        monkeypatch.setattr(module, "draw_seed", lambda device, generator: empty)
    why_not = backends.why_not
    monkeypatch.setattr(
        backends, "why_not", lambda op, name, device, dtype: why_not(op, name, torch.device("cpu"), dtype)
    )
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *device: False)
    monkeypatch.setattr(torch, "autocast", lambda *device, **options: contextlib.nullcontext())
    view = wp.from_torch
    monkeypatch.setattr(wp, "from_torch", lambda tensor: view(torch.empty(tensor.shape, dtype=tensor.dtype)))
    monkeypatch.setattr(wp, "device_from_torch", lambda device: "cpu")
    monkeypatch.setattr(wp, "launch", lambda *kernel, **options: None)

    batch = state.batches.draw(state.rays, state.draws)
    state.optimizer.zero_grad(set_to_none=True)
    output = state.ray_loss(batch, state.draws, backward=True)
    state.renderer.sampler.step_post_backward(output)
    state.optimizer.update(state.guard, output.loss)
    state.optimizer.after_step(state.step)
    state.strategy.step_post_backward(output)
    assert output.loss.device.type == "meta"
    with pytest.raises(RuntimeError):
        float(output.loss)
