"""Tests of image stores on disk: equal to images in memory, resumed builds, and stores of other images."""

import errno
import fcntl
import json
import os
import shutil
import threading

import numpy as np
import pytest
import torch
from helpers import refuses, same, trained
from PIL import Image
from scene_files import write_blender, write_images

from voronerf.app.cli import main
from voronerf.app.scenes import SceneError, builtin_scene, city_scene, images, load_scene, store
from voronerf.app.scenes.images import read_images, read_masks
from voronerf.app.train import TrainConfig, last_checkpoint
from voronerf.app.train.build import make_batches
from voronerf.nerf import RayBatches


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VORONERF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "images"


@pytest.fixture
def folder(tmp_path):
    write_blender(tmp_path / "scene", builtin_scene(24, train_views=6, test_views=2), 0.6911112)
    return tmp_path / "scene"


def train(scene, out):
    config = TrainConfig(out=out, steps=4, cells=(4,), split_at=(2,), width=8, rays=64, evaluations=1)
    return trained(config, scene)["psnr"], last_checkpoint(out).tensors


def test_training_from_disk_is_that_from_memory(folder, tmp_path, cache):
    memory, disk = load_scene(folder), load_scene(folder, images="disk")
    assert disk.train.on_disk and not memory.train.on_disk and len(list(cache.iterdir())) == 1
    for part in ("train", "test"):
        assert torch.equal(getattr(disk, part).images, getattr(memory, part).images)
    assert torch.equal(disk.box, memory.box)
    draws = [make_batches(TrainConfig(), s).draw(200, torch.Generator().manual_seed(1)) for s in (memory, disk)]
    assert torch.equal(draws[0].rays.directions, draws[1].rays.directions)
    assert torch.equal(draws[0].target, draws[1].target)
    (first, ours), (second, theirs) = train(memory, tmp_path / "a"), train(disk, tmp_path / "b")
    assert first == second and same(ours, theirs)
    city = [city_scene(4, train_views=2, test_views=1, images=place) for place in ("memory", "cached", "disk")]
    assert [s.train.on_disk for s in city] == [False, False, True]
    assert all(torch.equal(s.train.images, city[0].train.images) for s in city)
    line = "images must be auto or memory for a built-in scene"
    refuses(line, load_scene, "builtin", images="disk", error=SceneError)
    refuses("images must be auto, memory or disk, got 'x'", load_scene, folder, images="x", error=SceneError)


def test_sizes_and_masks(tmp_path):
    write_images(tmp_path, [(12, 10), (8, 11), (12, 6)])
    paths = sorted((tmp_path / "images").iterdir())
    mask = tmp_path / "mask.png"
    Image.fromarray(np.eye(11, 8, dtype=np.uint8) * 255).save(mask)
    stores = [read_images(paths, 1, keep=keep) for keep in ("memory", "disk")]
    assert torch.equal(stores[0].images, stores[1].images) and torch.equal(stores[0].sizes, stores[1].sizes)
    masks = [read_masks([None, mask, None], paths, read, 1) for read in stores]
    assert torch.equal(*masks) and int(masks[0][1].sum()) == 8
    for read in stores:
        upright = read._replace(images=read.images[:, :10], turns=[0, 3, 2])
        turned = read_masks([None, mask, None], paths, upright, 1)
        assert turned.shape == (3, 10, 12) and torch.equal(turned[1, :8, :11], torch.rot90(masks[0][1, :11, :8], 3))
        assert torch.equal(turned[::2], masks[0][::2, :10])


def test_what_does_not_fit_into_memory_is_on_disk(folder, monkeypatch):
    monkeypatch.setattr(images, "available_memory", lambda: 1000)
    assert load_scene(folder).train.on_disk
    refuses("or --images disk", load_scene, folder, images="memory", error=SceneError)


def test_a_build_goes_on_and_other_images_are_built_again(folder, cache, monkeypatch, caplog):
    decoded, ends = [], {7: True}

    def decode(path, factor, read=images.read_image):
        decoded.append(path.name)
        if ends.pop(len(decoded), None):
            raise KeyboardInterrupt
        return read(path, factor)

    monkeypatch.setattr(images, "read_image", decode)
    monkeypatch.setattr(images, "THREADS", 1)
    monkeypatch.setattr(store, "RECORD_EVERY", 0)
    with pytest.raises(KeyboardInterrupt):
        load_scene(folder, images="disk")
    before = len(decoded)
    again = load_scene(folder, images="disk")
    assert len(decoded) == before + 4, "the four that were recorded are not decoded again"
    assert torch.equal(again.train.images, load_scene(folder).train.images)
    decoded.clear()
    load_scene(folder, images="disk")
    assert not decoded
    Image.open(folder / "train/r_1.png").save(folder / "train/r_0.png")
    other = load_scene(folder, images="disk")
    assert torch.equal(other.train.images[0], other.train.images[1])
    assert not torch.equal(again.train.images[0], other.train.images[0]), "who has the old store keeps it"
    (place,) = cache.iterdir()
    os.truncate(place / "pixels", 100)
    del again, other
    assert torch.equal(*load_scene(folder, images="disk").train.images[:2])
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 2 and "the images of the scene have changed; the store is rebuilt" in lines[0]
    assert "image 0 is damaged; it and all later images are decoded again" in lines[1]


def test_what_is_damaged_is_made_again(folder, cache, caplog):
    right = load_scene(folder, images="disk").train.images.clone()
    (place,) = cache.iterdir()
    data = bytearray((place / "pixels").read_bytes())
    for at in (range(len(data)), range(len(data) // 2, len(data) // 2 + 1)):
        for byte in at:
            data[byte] ^= 255
        (place / "pixels").write_bytes(data)
        assert torch.equal(load_scene(folder, images="disk").train.images, right)
        data = bytearray((place / "pixels").read_bytes())
    said = [record.getMessage().split(": ")[1][:18] for record in caplog.records]
    assert said == ["image 0 is damaged", "image 4 is damaged"]
    record = json.loads((place / "store.json").read_text())
    for other in ({"checksums": [float("inf")]}, {"checksums": -5}, {"checksums": [-5] * 100}, {"version": 10**400}):
        (place / "store.json").write_text(json.dumps({**record, **other}))
        assert torch.equal(load_scene(folder, images="disk").train.images, right)


def test_an_image_replaced_at_equal_size_and_time_is_noticed(folder, cache):
    first, second = folder / "train" / "r_0.png", folder / "train" / "r_1.png"
    size = max(path.stat().st_size for path in (first, second))
    for path in (first, second):
        path.write_bytes(path.read_bytes().ljust(size, b"\0"))
    load_scene(folder, images="disk")
    stat = first.stat()
    first.write_bytes(second.read_bytes())
    assert first.stat().st_size == size
    os.utime(first, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert torch.equal(*load_scene(folder, images="disk").train.images[:2])


def test_a_file_that_is_cut_short_ends_a_training_with_a_line_and_a_checkpoint(
    folder, cache, tmp_path, monkeypatch, capsys
):
    draw = RayBatches.draw

    def cut(self, *args, **options):
        if len(drawn := cut.__dict__.setdefault("drawn", [])) == 3:
            os.truncate(next(cache.iterdir()) / "pixels", 100)
        drawn.append(1)
        return draw(self, *args, **options)

    monkeypatch.setattr(RayBatches, "draw", cut)
    options = "--images disk --steps 20 --width 8 --cells 2 --rays 64 --lpips off --evaluations 1 --no-occupancy"
    assert main(["train", "--data", str(folder), "--out", str(tmp_path / "run"), *options.split()]) == 1
    assert capsys.readouterr().err.splitlines()[-1].endswith("was cut short while it was read")
    assert last_checkpoint(tmp_path / "run").values["step"] == 3


@pytest.mark.skipif(os.name != "posix", reason="has no owners")
def test_links_in_a_shared_cache_are_not_followed(folder, cache, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "pixels").write_text("precious")
    load_scene(folder, images="disk")
    (place,) = cache.iterdir()
    assert {path.stat().st_mode & 0o777 for path in (cache, place)} == {0o700}
    (place / "pixels").unlink()
    (place / "pixels").symlink_to(mine / "pixels")
    with pytest.raises(SceneError, match="cannot hold"):
        load_scene(folder, images="disk")
    shutil.rmtree(place)
    place.symlink_to(mine)
    with pytest.raises(SceneError, match="must be a folder of your own"):
        load_scene(folder, images="disk")
    assert (mine / "pixels").read_text() == "precious" and len(list(mine.iterdir())) == 1


def test_a_wait_for_another_process_is_said(folder, cache, caplog):
    load_scene(folder, images="disk")
    (place,) = cache.iterdir()
    number = os.open(place, os.O_RDONLY)
    fcntl.flock(number, fcntl.LOCK_EX)
    threading.Timer(0.5, os.close, (number,)).start()
    load_scene(folder, images="disk")
    (record,) = caplog.records
    assert record.getMessage() == f"{place}: waiting for another process that decodes these images"


def test_a_full_disk_is_one_line(folder, monkeypatch):
    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    refuses("cannot hold the 0.00 GiB of images: No space left", load_scene, folder, images="disk", error=SceneError)
    monkeypatch.undo()
    assert len(load_scene(folder).train) == 6


def test_the_built_in_scene_is_kept(cache, monkeypatch):
    plain = builtin_scene(8)
    monkeypatch.setattr("voronerf.app.scenes.CACHED", 8)
    first = load_scene("builtin:8")
    assert len(list(cache.iterdir())) == 2 and not first.train.on_disk
    monkeypatch.setattr("voronerf.app.scenes.builtin.pictures._images", None)  # fails if images are made again
    for scene in (load_scene("builtin:8"), first):
        assert scene.train.images.equal(plain.train.images) and scene.test.images.equal(plain.test.images)


def test_without_a_cache_the_built_in_scene_is_computed(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("VORONERF_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr("voronerf.app.scenes.CACHED", 8)
    assert load_scene("builtin:8").train.images.shape == (100, 8, 8, 4)


def test_a_file_of_a_scene_stands_for_its_folder(folder):
    (file,) = folder.glob("transforms_train.json")
    assert load_scene(file).train.images.equal(load_scene(folder).train.images)
    refuses("is not a folder", load_scene, next(folder.rglob("*.png")), error=SceneError)
