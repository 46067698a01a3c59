"""Checkpoint files: exact, atomic, refused with the file's name when they are broken."""

import errno
import os
import pickle

import pytest
import torch
from helpers import refuses, same
from safetensors.torch import save_file

from voronerf.files import read_json_lines, write_text
from voronerf.training.checkpoint import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
    save_checkpoint,
)


def example():
    tensors = {"a.x": torch.randn(3, 4), "a.y": torch.arange(5, dtype=torch.uint8), "b.z": torch.tensor(1.5)}
    return Checkpoint(tensors, {"step": 7, "name": "é", "none": None})


def test_round_trip(tmp_path):
    saved = example()
    save_checkpoint(tmp_path / "new" / "last.safetensors", saved)
    loaded = load_checkpoint(tmp_path / "new" / "last.safetensors")
    assert loaded.values == saved.values and same(loaded.tensors, saved.tensors)
    assert all(tensor.dtype == saved.tensors[name].dtype for name, tensor in loaded.tensors.items())
    assert loaded.group("a").keys() == {"x", "y"}


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch, failing):
    path = tmp_path / "last.safetensors"
    save_checkpoint(path, example())
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, failing, full)
    refuses("No space left", save_checkpoint, path, example(), error=OSError)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["last.safetensors"]


def test_broken_files_are_named(tmp_path):
    path = tmp_path / "last.safetensors"
    refuses("last.safetensors: there is no checkpoint", load_checkpoint, path, error=CheckpointError)
    save_checkpoint(path, example())
    data = path.read_bytes()
    for broken in (b"", b"not a checkpoint", data[:40], data[:-3], pickle.dumps({"a": 1})):
        path.write_bytes(broken)
        refuses("last.safetensors: not a readable checkpoint", load_checkpoint, path, error=CheckpointError)
    save_file({"x": torch.zeros(1)}, path, {"format": "pt"})
    other = "not a voronerf-checkpoint-1 file, its format is 'pt'"
    refuses(other, load_checkpoint, path, error=CheckpointError)


def test_optimizer_state_round_trips():
    first = torch.nn.Parameter(torch.randn(4))
    optimizer = torch.optim.Adam([first], lr=0.1, fused=True)

    def step(parameter, optimizer):
        optimizer.zero_grad()
        parameter.square().sum().backward()
        optimizer.step()

    step(first, optimizer)
    second = torch.nn.Parameter(first.detach().clone())
    other = torch.optim.Adam([second], lr=0.1, fused=True)
    load_optimizer_tensors(other, optimizer_tensors(optimizer))
    step(first, optimizer)
    step(second, other)
    assert torch.equal(first, second)


def test_text_is_replaced_whole_and_broken_lines_of_json_are_named(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert read_json_lines(path) == []
    write_text(path, '{"step": 1}\n{"step": 2}\n')
    assert read_json_lines(path) == [{"step": 1}, {"step": 2}]
    write_text(path, '{"step": 1}\n')
    assert read_json_lines(path) == [{"step": 1}]
    write_text(path, '{"step": 1}\n{"ste')
    refuses("metrics.jsonl: line 2 is not JSON", read_json_lines, path)
