"""Tests of checkpoint files: they are exact and atomic, and an error names a broken file."""

import errno
import os
import pickle

import pytest
import torch
from helpers import refuses, same
from safetensors.torch import save_file

from voronerf.app.files import JSON_LIMIT, read_json_lines, write_text
from voronerf.app.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoint_path,
    checkpoint_paths,
    keep_checkpoint,
    last_checkpoint,
    load_checkpoint,
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
    refuses(f"No space left on device: '{path}'", save_checkpoint, path, example(), error=OSError)
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
    other = "not a voronerf-checkpoint-2 file, its format is 'pt'"
    refuses(other, load_checkpoint, path, error=CheckpointError)
    save_file({"x": torch.zeros(1)}, path, {"format": "voronerf-checkpoint-12"})
    newer = "must be a voronerf-checkpoint-2 file, got voronerf-checkpoint-12 of a newer voronerf"
    refuses(newer, load_checkpoint, path, error=CheckpointError)


def test_other_tensors_are_not_read(tmp_path):
    x, y = torch.randn(4, 5), torch.arange(4)
    save_checkpoint(tmp_path / "whole", Checkpoint({"x": x, "y": y}, {}))
    data = bytearray((tmp_path / "whole").read_bytes())
    data[-x.nbytes // 2] ^= 1  # within x
    (tmp_path / "damaged").write_bytes(data)
    refuses("damaged: a damaged checkpoint, x has", load_checkpoint, tmp_path / "damaged", error=CheckpointError)
    assert load_checkpoint(tmp_path / "damaged", keep=lambda entry: entry != "x").tensors.keys() == {"y"}


def test_a_single_changed_bit_is_found(tmp_path):
    path = tmp_path / "last.safetensors"
    save_checkpoint(path, example())
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 7):
        path.write_bytes(whole[: bit // 8] + bytes([whole[bit // 8] ^ 1 << bit % 8]) + whole[bit // 8 + 1 :])
        refuses("last.safetensors: ", load_checkpoint, path, error=CheckpointError)
    refuses("a damaged checkpoint, a.y has another checksum", load_checkpoint, path, error=CheckpointError)


def test_as_many_checkpoints_are_kept_as_asked_for(tmp_path):
    saved = [Checkpoint({"x": torch.tensor(number)}, {}) for number in range(6)]
    names = {1: ["last"], 3: ["last", "last-1", "last-2"], 2: ["last", "last-1"]}
    for number, (keep, count) in enumerate(((1, 1), (3, 2), (3, 3), (3, 3), (2, 2))):
        keep_checkpoint(tmp_path, saved[number], keep)
        paths = checkpoint_paths(tmp_path)
        assert [path.stem for path in paths] == names[count]
        assert [int(load_checkpoint(path).tensors["x"]) for path in paths] == [number - i for i in range(count)]
    keep_checkpoint(tmp_path, saved[5], 3)
    # A crash while checkpoints are renamed leaves a gap.
    checkpoint_path(tmp_path).unlink()
    assert int(last_checkpoint(tmp_path).tensors["x"]) == 4
    keep_checkpoint(tmp_path, saved[5], 3)
    assert len(checkpoint_paths(tmp_path)) == 3


def test_an_older_checkpoint_takes_the_place_of_a_damaged_one(tmp_path):
    for number in range(3):
        keep_checkpoint(tmp_path, Checkpoint({"x": torch.tensor(number)}, {}), 3)
    for damaged, taken in (("last", 1), ("last-1", 0)):
        path = tmp_path / "checkpoints" / f"{damaged}.safetensors"
        path.write_bytes(path.read_bytes()[:-1] + b"\x7f")
        place = rf"last.safetensors: a damaged checkpoint, x has another checksum; using last-{2 - taken}.* instead"
        with pytest.warns(UserWarning, match=place):
            assert int(last_checkpoint(tmp_path).tensors["x"]) == taken
    (tmp_path / "checkpoints" / "last-2.safetensors").write_bytes(b"")
    refuses("last.safetensors: a damaged", last_checkpoint, tmp_path, error=CheckpointError)


def test_text_is_replaced_whole_and_broken_lines_of_json_are_named(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert read_json_lines(path) == []
    write_text(path, '{"step": 1}\n{"step": 2}\n')
    assert read_json_lines(path) == [{"step": 1}, {"step": 2}]
    write_text(path, '{"step": 1}\n')
    assert read_json_lines(path) == [{"step": 1}]
    write_text(path, '{"step": 1}\n{"ste')
    refuses("metrics.jsonl: line 2 is not JSON", read_json_lines, path)
    write_text(path, '{"step": 1}\n[1]\n')
    refuses("metrics.jsonl: line 2 must be an object, got [1]", read_json_lines, path)
    os.truncate(path, JSON_LIMIT + 1)  # the file has a hole, which takes no space on the disk
    refuses("metrics.jsonl: must be at most 32 MiB of JSON, got 32.0", read_json_lines, path)
