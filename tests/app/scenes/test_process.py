"""Tests of `voronerf process` on rendered images of two textured walls, and on simulated mapper results."""

import contextlib
import io
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational
from scene_files import oriented, write_deep, write_frames, write_images, write_walls

from voronerf.app.cli import main
from voronerf.app.scenes import SceneError, gather, load_scene, process
from voronerf.app.scenes.colmap import ColmapCamera, ColmapImage, ColmapModel, read_model
from voronerf.app.scenes.images import read_header
from voronerf.app.scenes.lenses import colmap_lens
from voronerf.app.scenes.soundness import camera_faults, lost_cameras, spread_of_lenses
from voronerf.nerf.cameras import orbit_cameras

pycolmap = pytest.importorskip("pycolmap", reason="voronerf process needs pycolmap")
COUNT, WIDTH, HEIGHT, FOCAL = 8, 240, 180, 200.0


def cameras():
    return orbit_cameras(40, radius=4.0, elevation=35.0, width=WIDTH, height=HEIGHT, focal=FOCAL)[:COUNT]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A folder of images of a floor and a wall behind it."""
    folder = tmp_path_factory.mktemp("walls")
    write_walls(folder, cameras())
    return folder


def test_pictures_become_a_scene_that_goes_on_where_it_was_stopped(tmp_path, pictures, monkeypatch):
    monkeypatch.setattr(process, "FEW_IMAGES", 4)  # pairs are chosen by the largest features
    monkeypatch.setattr(process, "LEAST_SIDE", 64)
    seen, said = [], []

    def stop(stage, done, total):
        seen.append(stage)
        if stage == "matches":
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        process.process(pictures, out, max_features=300, progress=stop)
    assert not (out / "sparse").exists() and set(seen) == {"images", "features", "pairs", "matches"}
    line = "was started with --max-features 300, got 500"
    refuses(line, process.process, pictures, out, max_features=500, error=SceneError)
    with pycolmap.Database.open(out / "colmap/database.db") as opened:
        counts = [len(opened.read_keypoints(image.image_id)) for image in opened.read_all_images()]
        assert all(100 < count <= 300 for count in counts)  # SIFT finds more than 300
    seen.clear()
    process.process(pictures, out, max_features=300, say=said.append, progress=lambda *now: seen.append(now))
    stages = {stage for stage, *_ in seen}
    assert "pairs" not in stages  # the stopped run chose the pairs
    assert any(stage.startswith("global mapping: ") for stage in stages)  # from COLMAP's log
    assert said[-1].startswith(f"wrote {out}: cameras of {COUNT} of {COUNT} images")
    kept = {"images", "images_2", "sparse", "transforms.json", "colmap"}
    assert {path.name for path in out.iterdir()} == kept
    assert Image.open(out / "images_2/00_a.png").size == (WIDTH // 2, HEIGHT // 2)
    refuses("is a scene already", process.process, pictures, out, max_features=300, error=SceneError)

    images = read_model(out / "sparse/0").images
    assert abs(images[0].camera.lens.intrinsics[0] / FOCAL - 1) < 0.05
    positions = np.stack([image.pose[:3, 3] for image in images])
    truth = cameras().origins.double().numpy()
    steps = [np.linalg.norm(np.diff(places, axis=0), axis=1) for places in (positions, truth)]
    ratio = steps[0] / steps[1]
    assert ratio.std() / ratio.mean() < 0.05

    scene = load_scene(out)
    assert len(scene.train) + len(scene.test) == COUNT
    assert not any("check the cameras" in note for note in scene.notes)
    other = load_scene(out, format="transforms")
    torch.testing.assert_close(other.train.cameras.intrinsics, scene.train.cameras.intrinsics)
    listed = json.loads((out / "transforms.json").read_text())["frames"]
    for frame, image in zip(listed, images):
        np.testing.assert_allclose(frame["transform_matrix"], image.pose)

    shutil.rmtree(out / "sparse")
    process.process(pictures, out, max_features=300, mapper="incremental", progress=lambda *now: seen.append(now))
    assert max(done for stage, done, _ in seen if stage == "incremental mapping") >= COUNT - 2

    shutil.rmtree(out / "sparse")
    again = {"max_features": 300, "mapper": "incremental"}
    monkeypatch.setattr(process, "LARGEST_ERROR", 0.0)
    refuses("its points are off by 0.", process.process, pictures, out, **again, error=SceneError)
    monkeypatch.setattr(process, "ERROR_SHARE", 2 / WIDTH)
    process.process(pictures, out, **again)

    shutil.rmtree(out / "sparse")
    pairs = sorted((images[index].name, images[index + 1].name) for index in range(COUNT - 1))
    monkeypatch.setattr(process, "trusted_pairs", lambda *_: {*pairs, (images[0].name, images[2].name)})
    monkeypatch.setattr(process, "is_folded", lambda *_: True)
    process.process(pictures, out, max_features=300, mapper="global", say=said.append)
    assert said[-2].startswith("check the cameras: the model contradicts 0 of ")
    assert any(line.startswith(f"global mapping by {COUNT} pairs of ") for line in said)
    with pycolmap.Database.open(out / "colmap/trusted.db") as opened:
        assert opened.num_verified_image_pairs() == COUNT
    assert (out / "colmap/global_again/0/images.bin").is_file()


def write_database(path, scales, matches=()):
    """Writes a COLMAP database of images 0.png, 1.png, ...; returns its path.

    Every image has one feature for each of the `scales`; `matches` maps pairs of images to their numbers of matches.
    """
    with pycolmap.Database.open(path) as opened:
        camera = opened.write_camera(pycolmap.Camera(model="SIMPLE_RADIAL", width=9, height=9, params=[9, 4, 4, 0]))
        for number in range(max([0, *(image for pair in matches for image in pair)]) + 1):
            image = opened.write_image(pycolmap.Image(name=f"{number}.png", camera_id=camera))
            opened.write_keypoints(image, np.float32([[0, 0, scale, 0, 0, scale] for scale in scales]))
            values = np.uint8(scales)[:, None].repeat(128, 1)
            kind = pycolmap.FeatureExtractorType.SIFT
            opened.write_descriptors(image, pycolmap.FeatureDescriptors(data=values, type=kind))
        for (a, b), count in dict(matches).items():
            geometry = pycolmap.TwoViewGeometry(inlier_matches=np.zeros((count, 2), np.uint32), config=2)
            opened.write_two_view_geometry(a + 1, b + 1, geometry)
    return path


def models(tmp_path, monkeypatch, pictures, **results):
    """Replaces COLMAP's mappers; returns the list of mappers that were called.

    `results` maps a mapper to its result: camera positions [c, 3], (positions, number of contradicted pairs), None for
    no model, or an exception to raise.
    """
    called = []

    def map_images(stages, name, *_):
        called.append(name)
        if results[name] is None:
            return None
        if isinstance(results[name], Exception):
            raise results[name]
        origins, contradicted = results[name] if isinstance(results[name], tuple) else (results[name], 0)
        names = [f"{number:02}.png" for number in lost_cameras(origins).nonzero()[:, 0].tolist()]
        kept = [None] * (len(origins) - len(names))
        faults = camera_faults(origins)
        return process.Model(tmp_path / name, kept, dict.fromkeys(names, "far"), 0.5, faults, contradicted, 50)

    monkeypatch.setattr(process, "_match", lambda *_: None)
    monkeypatch.setattr(process, "_map", map_images)
    return called


@pytest.fixture
def features(monkeypatch):
    """A function that processes images up to their features, and opens the database."""
    monkeypatch.setattr(process, "_map", lambda *_: None)
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda *_, **__: None)

    def opened(source, out, **options):
        refuses("finds no model", process.process, source, out, error=SceneError, **options)
        return pycolmap.Database.open(out / "colmap/database.db")

    return opened


def circle(count=COUNT):
    angles = torch.arange(count) * (2 * torch.pi / count)
    return torch.stack((angles.cos(), angles.sin(), 0 * angles), 1).double()


def test_a_model_with_faults_is_not_a_scene(tmp_path, monkeypatch, pictures):
    collapsed = circle() * torch.tensor([1e-6] * (COUNT - 2) + [1.0] * 2)[:, None]
    called = models(tmp_path, monkeypatch, pictures, **{"global": collapsed, "incremental": None})
    said = []
    with pytest.raises(SceneError, match=r"no sound model of 8 images: the cameras have collapsed.* --matching"):
        process.process(pictures, tmp_path / "out", say=said.append)
    assert called == ["global", "incremental"] and said[-1] == "incremental mapping: no model"
    assert not (tmp_path / "out/sparse").exists()
    models(tmp_path, monkeypatch, pictures, **{"global": circle()[:3], "incremental": None})
    refuses("less than half of the images", process.process, pictures, tmp_path / "out", error=SceneError)
    models(tmp_path, monkeypatch, pictures, **{"global": None, "incremental": None})
    refuses("COLMAP finds no model", process.process, pictures, tmp_path / "out", error=SceneError)


def test_a_folded_model_is_made_again_by_pairs_that_can_be_trusted(tmp_path, monkeypatch, pictures):
    def find_best(**of_mappers):
        """Returns (called mappers, messages, best model) for 10 images."""
        called, said = models(tmp_path, monkeypatch, pictures, **of_mappers), []
        stages = process.Stages(pycolmap, tmp_path, pictures, print)
        candidates = process._find_models(stages, process._read_matches(stages), "auto", 10, said.append)
        return called, said, process._best(candidates, 10)

    folded = (circle(10), 4)
    called, said, best = find_best(**{"global": folded, "global_again": circle(10)})
    assert called == ["global", "global_again"] and best.folder.name == "global_again" and not best.folded
    assert said == [
        "global mapping: 10 of 10 images, points off by 0.50 pixels; contradicts 4 of 50 pairs of images that match "
        "well over much of both: something may look alike from several sides",
        "global mapping by 0 pairs of 0: 10 of 10 images, points off by 0.50 pixels",
    ]
    others = {"incremental": None, "incremental_again": None}
    called, _, best = find_best(**{"global": folded, "global_again": circle(4)}, **others)  # too few images
    assert called == ["global", "global_again", "incremental"] and best.folder.name == "global"
    called, _, best = find_best(**{"global": folded, "global_again": (circle(10), 3)}, **others)
    assert called == ["global", "global_again", "incremental", "incremental_again"] and best.contradicted == 3
    called, *_ = find_best(**{"global": (circle(10), 2)})  # two pairs may be false matches
    assert called == ["global"]
    lost = circle(10) * torch.tensor([1.0] * 9 + [90.0])[:, None]  # other cameras may be wrong too
    called, _, best = find_best(**{"global": lost, "incremental": circle(9)})
    assert called == ["global", "incremental"] and best.folder.name == "incremental"
    lost = circle(10) * torch.tensor([1.0] * 8 + [90.0, -200.0])[:, None]
    _, _, best = find_best(**{"global": lost, "incremental": circle(7)})  # 8 cameras beat 7
    assert best.folder.name == "global" and len(best.images) == 8
    broken = SceneError("cameras.bin: camera 1 must have a focal length")
    called, said, best = find_best(**{"global": broken, "incremental": circle(9)})
    assert called == ["global", "incremental"] and best.folder.name == "incremental"
    assert said[0] == f"global mapping: no model: {broken}"


def test_cameras_far_from_all_others_count_as_missing():
    origins = circle(40)
    assert not lost_cameras(origins).any() and camera_faults(origins) == []
    assert not lost_cameras(origins[:2]).any() and not lost_cameras(origins[:1]).any()
    origins[7] *= 9
    assert lost_cameras(origins).nonzero().flatten().tolist() == [7]
    assert camera_faults(origins) == []  # a single lost camera is not a fault
    origins[20:32] *= 30 + torch.arange(12)[:, None] ** 2
    assert lost_cameras(origins).nonzero().flatten().tolist() == [7, *range(20, 32)]
    together = circle(40) + 5000 * torch.arange(40)[:, None].ge(38)
    assert lost_cameras(together).nonzero().flatten().tolist() == [38, 39]  # two lost cameras side by side
    assert "depths from 0.02 to 3.52e+04" in camera_faults(circle(), torch.tensor([[0.02, 5.0], [1.0, 3.52e4]]))[0]
    lenses = [colmap_lens("OPENCV", (736, 700, 400, 266, 0.1, 0, p1, 0.01)) for p1 in (0.02, -0.09)]
    faults = [camera_faults(circle(), lenses=[(lens, 800)]) for lens in lenses]
    assert faults == [[], ["a lens is tilted, p1 -0.09 and p2 0.01"]]


def test_cameras_beside_a_burst_are_not_lost():
    burst = torch.tensor([1.0, 0, 0.2]) + 1e-3 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    origins = torch.cat((burst.double(), circle(37)))
    assert not lost_cameras(origins).any()
    assert lost_cameras(torch.cat((origins, 5 * circle(1)))).nonzero().flatten().tolist() == [77]
    path = torch.cat((0.01 * torch.arange(75), torch.tensor([0.9, 1.05])))[:, None] * torch.ones(3)
    assert not lost_cameras(path).any()


def test_a_lost_camera_is_named_left_out_and_another_mapper_is_tried(tmp_path, pictures):
    out, said = tmp_path / "out", []
    process.process(pictures, out, max_features=300)
    model = pycolmap.Reconstruction(out / "colmap/global/0")
    images = {image.name: image for image in model.images.values()}
    bare, far = images["03_a.png"], images["05_a.png"]
    for point in bare.get_observation_point2D_idxs()[2:]:
        model.delete_observation(bare.image_id, point)
    frame = model.frames[far.frame_id]
    turn = frame.rig_from_world.rotation
    frame.rig_from_world = pycolmap.Rigid3d(turn, -turn.matrix() @ (3e4, 0, 0))
    model.write_binary(out / "colmap/global/0")

    for mapper, kept in (("global", COUNT - 2), ("auto", COUNT)):
        shutil.rmtree(out / "sparse")
        said.clear()
        process.process(pictures, out, max_features=300, mapper=mapper, say=said.append)
        line = next(line for line in said if line.startswith(f"global mapping: {COUNT - 2} of {COUNT} images"))
        assert re.search(r"without the cameras of 03_a.png \(held by \d points\), 05_a.png \(far from", line)
        names = {image.name for image in read_model(out / "sparse/0").images}
        assert len(names) == kept and ("05_a.png" in names) == (mapper == "auto")
        assert len(json.loads((out / "transforms.json").read_text())["frames"]) == kept
        assert f"cameras of {kept} of {COUNT} images" in said[-1]


def test_a_camera_that_determines_its_lens_alone_needs_more_points(tmp_path):
    shared, alone = (
        ColmapCamera("SIMPLE_RADIAL", colmap_lens("SIMPLE_RADIAL", (focal, 120, 90, k)), 240, 180)
        for focal, k in ((200, 0.0), (150, -0.424))
    )
    points = np.arange(400)

    def lost(held, lenses):
        poses = np.tile(np.eye(4), (len(held), 1, 1))
        poses[:, :3, 3] = circle(len(held)).numpy()
        images = [
            ColmapImage(f"{i}.png", lens, pose, points[:count])
            for i, (count, lens, pose) in enumerate(zip(held, lenses, poses, strict=True))
        ]
        return process._lost(ColmapModel(tmp_path, images, points, np.zeros((400, 3))))

    others = [shared] * 10
    reason = "alone with its lens, and held by 31 points, others by 400"
    assert lost([400] * 10 + [31], [*others, alone]) == {"10.png": reason}
    assert not lost([400] * 10 + [31], [*others, shared]) and not lost([400] * 10 + [100], [*others, alone])


def test_lenses_of_one_device_have_similar_focal_lengths():
    lenses = [(colmap_lens("PINHOLE", (focal, focal, 192, 144)), 384) for focal in (180, 250, 376)]
    assert "each of 3 images has its own lens, with focal lengths from 0.47 to 0.98" in spread_of_lenses(lenses)
    assert not spread_of_lenses(lenses * 2) and not spread_of_lenses(lenses[:2]) and not spread_of_lenses([])
    assert not spread_of_lenses([(lens, side) for (lens, _), side in zip(lenses, (300, 410, 610))])


def test_a_scene_says_what_is_wrong_with_its_cameras(tmp_path):
    poses = orbit_cameras(8, radius=4, elevation=20, width=12, height=10, focal=20).poses
    poses[:6, :3, 3] = poses[0, :3, 3] + 1e-6 * poses[:6, :3, 3]
    write_images(tmp_path, [(12, 10)] * 8)
    write_frames(tmp_path, poses, w=12, h=10)
    notes = load_scene(tmp_path).notes
    assert any(note.startswith("check the cameras: the cameras have collapsed") for note in notes)


def test_a_lost_camera_does_not_give_a_scene_its_scale(tmp_path):
    poses = orbit_cameras(17, radius=4, elevation=20, width=12, height=10, focal=20).poses
    write_images(tmp_path, [(12, 10)] * 17)
    others = [*range(3), *range(4, 17)]
    write_frames(tmp_path, poses[others], lambda index: f"images/{others[index]:02}.jpg", w=12, h=10)
    sound = load_scene(tmp_path)
    poses[3, :3, 3] *= 8000
    write_frames(tmp_path, poses, w=12, h=10)
    scene, kept = load_scene(tmp_path), load_scene(tmp_path, keep_far=True)
    line = "1 of 17 cameras lie far from the others and are"
    assert f"{line} left out (--keep-far keeps them): 03.jpg" in scene.notes
    assert f"{line} kept (--keep-far): 03.jpg" in kept.notes and len(kept.train) + len(kept.test) == 17
    assert not any("check the cameras" in note for note in scene.notes)
    for ours, without in ((scene.train, sound.train), (scene.test, sound.test)):  # same as without the far camera
        assert ours.names == without.names and torch.equal(ours.cameras.poses, without.cameras.poses)
    assert kept.train.cameras.origins.norm(dim=-1).median() < 1e-3


def test_the_largest_features_are_kept(tmp_path):
    few = tmp_path / "few.db"
    process._keep_largest(pycolmap, write_database(tmp_path / "database.db", [2, 5, 1, 4]), few, 2)
    with pycolmap.Database.open(few) as opened:
        assert opened.read_keypoints(1)[:, 2].tolist() == opened.read_descriptors(1).data[:, 0].tolist() == [5, 4]


def test_images_are_matched_with_those_that_share_most(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "NEIGHBOURS", 1)
    shared = {(0, 3): 90, (0, 4): 20, (1, 4): 90, (2, 5): 9}  # 9 matches are too few for a pair
    pairs = process._choose_pairs(pycolmap, write_database(tmp_path / "few.db", [1], shared))
    following = [(a, a + step) for a in range(6) for step in (1, 2) if a + step < 6]
    assert pairs == sorted((f"{a}.png", f"{b}.png") for a, b in {(0, 3), (1, 4), *following})


def test_half_transparent_pixels_have_features(tmp_path):
    pixels = np.zeros((1, 3, 4), np.uint8)
    pixels[..., 3] = 127, 128, 255
    Image.fromarray(pixels).save(path := tmp_path / "a.png")
    process._write_masks([path], tmp_path / "masks", tmp_path / "features")
    assert np.array(Image.open(tmp_path / "features/a.png.png")).tolist() == [[False, True, True]]


def test_reduced_images_keep_the_orientation_tag_and_the_transparent_colour_of_a_palette(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "LEAST_SIDE", 4)
    write_images(tmp_path, [(12, 10)] * 2, exif=oriented(6))
    indexed = Image.new("P", (12, 10))
    indexed.putpalette([200, 0, 0, 0, 100, 0])
    indexed.paste(1, (6, 0, 12, 10))
    indexed.save(tmp_path / "images/a.png", transparency=1)
    process._write_reduced(sorted((tmp_path / "images").iterdir()), tmp_path / "images_2", 2)
    with Image.open(tmp_path / "images_2/00.jpg") as reduced:
        assert reduced.size == (6, 5) and reduced.getexif()[0x0112] == 6
    with Image.open(tmp_path / "images_2/a.png") as reduced:
        assert reduced.size == (6, 5) and reduced.getpixel((0, 0)) == (200, 0, 0, 255)
        assert reduced.getpixel((5, 0))[3] == 0


def test_what_cannot_become_a_scene_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    write_images(tmp_path, [(12, 10)] * 2)
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "list.mp4").write_text(f"ffconcat version 1.0\nfile {tmp_path}/images/00.jpg\n")
    (tmp_path / "cut.mp4").write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").write_text("keep")
    before = sorted(tmp_path.rglob("*"))
    for source, reason in (
        ("nowhere", "there is no such video or folder"),
        ("text.mp4", "text.mp4: must be a video in a supported container"),
        ("list.mp4", "list.mp4: must be a video in a supported container"),
        ("cut.mp4", "moov atom not found, as in a recording or a download that was cut off"),
        ("images", "must have at least 3 images, got 2"),
        ("", f"{tmp_path}/images: must have at least 3 images, got 2"),
        ("full", f"{tmp_path}/full: must have at least 3 images, got 0"),
    ):
        refuses(reason, process.process, tmp_path / source, tmp_path / "out", error=SceneError)
    reason = "full: must be a new or empty folder"
    refuses(reason, process.process, tmp_path / "images", tmp_path / "full", error=SceneError)
    refuses("matching must be one of auto", process.process, tmp_path, tmp_path / "out", matching="all")
    refuses("max_features must be at least 100, got 5", process.process, tmp_path, tmp_path / "out", max_features=5)
    refuses("size must be at least 64, got 9", process.process, tmp_path, tmp_path / "out", size=9)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a process of its own")
@pytest.mark.parametrize(("count", "reason"), [(2, "must have at least 3 images, got 2"), (3, "COLMAP finds no model")])
def test_a_process_that_is_killed_in_its_first_moments_goes_on(tmp_path, monkeypatch, count, reason):
    """`process` can run again after it was killed just before it changed a folder, at its start or in its clean-up."""
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    write_images(tmp_path, [(12, 10)] * count)
    for moment in range(1, 40):
        if not (child := os.fork()):
            changes = itertools.count(1)

            def kill(event, _, moment=moment, changes=changes):
                if event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir") and next(changes) == moment:
                    os.kill(os.getpid(), signal.SIGKILL)

            sys.addaudithook(kill)
            with contextlib.suppress(SceneError):
                process.process(tmp_path / "images", tmp_path / "out", say=lambda _: None)
            os._exit(0)
        killed = os.waitpid(child, 0)[1]
        refuses(reason, process.process, tmp_path / "images", tmp_path / "out", error=SceneError)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        if not killed:
            break
    assert 7 < moment < 39, moment


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a process of its own")
def test_a_process_that_is_killed_while_it_copies_features_goes_on(tmp_path, monkeypatch):
    whole, few = write_database(tmp_path / "database.db", [3, 1, 2, 4]), tmp_path / "few.db"
    if not (child := os.fork()):
        monkeypatch.setattr(pycolmap.Database, "write_descriptors", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        process._keep_largest(pycolmap, whole, few, 2)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL and (tmp_path / "few.part-wal").stat().st_size
    process._keep_largest(pycolmap, whole, few, 3)
    with pycolmap.Database.open(few) as opened:
        assert opened.num_keypoints_for_image(1) == opened.num_descriptors_for_image(1) == 3


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_command_that_is_stopped_says_how_to_go_on(monkeypatch, capsys, number, status):
    monkeypatch.setattr("voronerf.app.cli.process.make_scene", lambda *_, **__: os.kill(os.getpid(), number))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have disabled it
    try:
        assert main(["process", "in", "out"]) == status
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().out == "stopped; continue with the same command\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize("stage", ["images", "colmap/.incremental"])
def test_sigterm_ends_the_command_without_the_stack_of_colmap(tmp_path, pictures, stage):
    options = [str(pictures), str(tmp_path / "out"), "--mapper", "incremental", "--max-features", "300"]
    command = [sys.executable, "-m", "voronerf", "process", *options]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while not (tmp_path / "out" / stage).is_dir():
        assert run.poll() is None
        time.sleep(0.02)
    run.send_signal(signal.SIGTERM)
    output = run.communicate()[0]
    assert output.splitlines()[-1] == "stopped; continue with the same command" and "***" not in output
    assert run.returncode == 128 + signal.SIGTERM


def test_images_of_phones_become_jpeg(tmp_path, monkeypatch):
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    (tmp_path / "phone").mkdir()
    for number in range(3):
        image = Image.new("RGB", (32, 20), (40 * number, 90, 30))
        exif = image.getexif()
        exif[0x0110] = "a phone"
        heif.from_pillow(image).save(tmp_path / f"phone/{number}.HEIC", exif=exif.tobytes())
    refuses("no model", process.process, tmp_path / "phone", tmp_path / "out", error=SceneError)
    copies = [Image.open(path) for path in sorted((tmp_path / "out/images").iterdir())]
    assert [image.format for image in copies] == ["JPEG"] * 3 and copies[0].size == (32, 20)
    assert copies[0].getexif()[0x0110] == "a phone" and abs(copies[2].getpixel((5, 5))[0] - 80) < 6
    (tmp_path / "phone/3.heic").write_bytes(b"no image")
    refuses("3.heic: cannot be read", process.process, tmp_path / "phone", tmp_path / "new", error=SceneError)


def test_images_of_phones_are_named_where_they_cannot_be_read(tmp_path, monkeypatch):
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    write_images(tmp_path, [(12, 10)] * 3)
    for number in range(2):
        (tmp_path / f"images/{number}.heic").write_bytes(b"an image")
    said = []
    refuses("no model", process.process, tmp_path / "images", tmp_path / "out", say=said.append, error=SceneError)
    assert said[0].endswith("images: 2 HEIC images are left out; pip install pillow-heif reads them")
    assert len(list((tmp_path / "out/images").iterdir())) == 3


def picture(number, size=(32, 20), mode="RGB"):
    return Image.new("RGB", size, (20 * number % 256, 90, 30)).convert(mode)


def gathered(tmp_path, monkeypatch, files):
    """Processes files and returns (names of the copied images, messages).

    `files` maps a file name to its content: a picture number, an image, or bytes.
    """
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    folder, out, said = tmp_path / "in", tmp_path / "out", []
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
        else:
            (picture(content) if isinstance(content, int) else content).save(folder / name)
    refuses("no model", process.process, folder, out, say=said.append, error=SceneError)
    before = itertools.takewhile(lambda line: "keeps COLMAP's results" not in line, said)
    return sorted(path.name for path in (out / "images").iterdir()), list(before)


THREE, IN_A = ["0.jpg", "1.jpg", "2.jpg"], ["a_0.jpg", "a_1.jpg", "a_2.jpg"]
SYSTEM = "a/._0.jpg", "a/.DS_Store", "a/Thumbs.db", "a/desktop.ini", "__MACOSX/0.jpg", ".trash/0.jpg", "@eaDir/0/1.jpg"
POLYCAM = "k/images/{}.jpg", "k/corrected_images/{}.jpg", "k/confidence/{}.png", "k/depth/{}.png"


def numbered(*patterns, first=0, count=3):
    """Returns {file name: picture number} for `count` names of each pattern, all with different pictures."""
    names = [pattern.format(number) for pattern in patterns for number in range(count)]
    return {name: number for number, name in enumerate(names, first)}


@pytest.mark.parametrize(
    ("files", "names", "lines"),
    [
        (
            {**numbered("camA/{}.jpg", "cam B/{}.jpg"), **numbered("Mask/{}.png", "camA/depth/{}.png", first=9)},
            [f"cam{c}_{i}.jpg" for c in ("A", "_B") for i in range(3)],
            ["the images come from cam B (3), camA (3)"],
        ),
        (numbered("a/b/{}.png"), ["a_b_0.png", "a_b_1.png", "a_b_2.png"], []),
        (numbered("images/{}.jpg", "images_2/{}.jpg", "depth/{}.png"), THREE, []),
        (numbered("Images/{}.jpg", "more/{}.jpg"), THREE, ["3 images outside of Images are left out"]),
        (numbered("{}.JPG", "more/{}.jpg"), ["0.JPG", "1.JPG", "2.JPG"], ["3 images in subfolders are left out"]),
        (
            numbered("{}.jpg", "{}.png", "{}.webp", "b{}.webp", "b{}.tif"),
            ["0.jpg", "1.jpg", "2.jpg", "b0.png", "b1.png", "b2.png"],
            ["9 images are left out, since they also exist in another format: 0.png, 1.png, 2.png, 0.webp"],
        ),
        (numbered("{}.webp"), THREE, []),
        (numbered("{}.tif", "b{}.TIFF", "c{}.bmp"), [f"{c}{i}.png" for c in ("", "b", "c") for i in range(3)], []),
        (
            {**numbered("{}.jpg"), "0 (1).jpg": 0, "copy of 1.jpg": 1, "b/2.jpg": 2},
            THREE,
            ["1 images in subfolders", "2 byte-identical copies of images are left out: 0_(1).jpg, copy_of_1.jpg"],
        ),
        (
            {**numbered("{}.jpg"), "1.dng": b"raw", "2.dng": b"raw", "0.mov": b"live", "LICENSE": b"words"},
            THREE,
            ["other files than PNG, JPEG, WebP, TIFF, BMP and HEIC are left out: 2 .dng, 1 .mov, 1 LICENSE"],
        ),
        ({**numbered("a/{}.jpg"), **dict.fromkeys(SYSTEM, b"system")}, IN_A, []),
        ({**numbered("a/{}.jpg", "b/images/{}.jpg"), "b/colmap/settings.json": b"{}"}, IN_A, []),
        (numbered(*POLYCAM), [f"k_corrected_images_{i}.jpg" for i in range(3)], []),
        (numbered("images/{}.jpg", "corrected_images/{}.jpg"), THREE, []),
        (numbered("#{}.jpg", "a #{}.jfif"), [*(f"_{i}.jpg" for i in range(3)), *(f"a_#{i}.jpg" for i in range(3))], []),
    ],
)
def test_the_images_of_a_folder_are_taken_once_and_what_is_left_out_is_said(tmp_path, monkeypatch, files, names, lines):
    taken, said = gathered(tmp_path, monkeypatch, files)
    assert taken == names
    assert len(said) == len(lines) and all(part in line for part, line in zip(lines, said)), said


def test_a_folder_under_another_path_is_the_same(tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").write_bytes(b"1")
    monkeypatch.chdir(tmp_path / "photos")
    names = dict.fromkeys(("frames", "matching", "camera_model", "max_features", "size"), 1)
    paths = tmp_path / "photos", Path("../photos"), Path()
    assert len({process.Settings.of([path], **names) for path in paths}) == 1


def test_images_of_two_folders_must_not_get_one_name(tmp_path):
    for name in ("a/b_0.jpg", "a_b/0.jpg"):
        (tmp_path / "in" / name).parent.mkdir(parents=True)
        picture(1).save(tmp_path / "in" / name)
    line = f"a_b/0.jpg: {tmp_path}/in/a/b_0.jpg has the same name"
    refuses(line, process.process, tmp_path / "in", tmp_path / "out", error=SceneError)


def quarters():
    """Returns an image with red, black, blue and green quarters, which shows rotations."""
    image = Image.new("RGB", (32, 20))
    for place, colour in (((0, 0, 16, 10), "red"), ((0, 10, 16, 20), "blue"), ((16, 10, 32, 20), "lime")):
        image.paste(colour, place)
    return image


def turned():
    """Returns the Exif tags of a camera that is held upright."""
    exif = Image.Exif()
    exif[0x0110], exif[0x0112], exif[0x8769] = "a camera", 6, {0xA405: 26}
    return exif


@pytest.mark.parametrize(
    ("name", "options", "kept"),
    [
        ("a.webp", {"exif": turned()}, "a.jpg"),
        ("a.webp", {"exif": turned(), "lossless": True}, "a.png"),
        ("a.tif", {"compression": "tiff_lzw", "tiffinfo": {0x0110: "a camera", 0x0112: 6}}, "a.png"),
        ("a.tif", {"compression": "jpeg", "quality": 95, "tiffinfo": {0x0110: "a camera", 0x0112: 6}}, "a.png"),
        ("a.jpg", {"format": "WebP", "exif": turned()}, "a.jpg"),  # the content decides, not the name
    ],
)
def test_converted_images_are_upright_and_keep_their_lens(tmp_path, name, options, kept):
    (tmp_path / "out").mkdir()
    quarters().save(tmp_path / name, **options)
    copy, reduced = gather._copy_image(tmp_path / name, tmp_path / "out" / name)
    assert copy == tmp_path / "out" / kept and not reduced
    with Image.open(copy) as image:
        shown, exif = np.asarray(image).astype(int), image.getexif()
        assert image.format == ("JPEG" if kept.endswith("jpg") else "PNG")
        assert exif[0x0110] == "a camera" and 0x0112 not in exif
    upright = np.asarray(quarters().transpose(Image.Transpose.ROTATE_270)).astype(int)
    inside = np.s_[[8, 24], [[5], [15]]]  # a pixel in each quarter
    assert shown.shape == (32, 20, 3) and np.abs(shown[inside] - upright[inside]).max() < 12
    camera = pycolmap.infer_camera_from_image(copy)
    assert camera.has_prior_focal_length == ("exif" in options)


@pytest.mark.parametrize("name", ["a.tif", "a.webp", "a.jpg"])
def test_transparent_images_stay_transparent(tmp_path, name):
    image = picture(3, mode="RGBA")
    image.putalpha(77)
    image.save(tmp_path / name, format="PNG" if name == "a.jpg" else None)
    copy, _ = gather._copy_image(tmp_path / name, tmp_path / f"copy_{name}")
    with Image.open(copy) as kept:
        assert copy.suffix == ".png" and kept.mode == "RGBA" and kept.getpixel((4, 4))[3] == 77


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_of_16_bits_a_channel_8_are_kept(tmp_path, monkeypatch, suffix):
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    (folder := tmp_path / "in").mkdir()
    values = np.random.default_rng(0).integers(0, 2**16, (3, 9, 16, 3))
    for number in range(3):
        write_deep(folder / f"{number}{suffix}", values[number])
    said = []
    refuses("no model", process.process, folder, tmp_path / "out", say=said.append, error=SceneError)
    assert said[0] == f"{folder}: 3 images have 16 bits a channel, of which the upper 8 are kept: " + ", ".join(
        f"{number}{suffix}" for number in range(3)
    )
    copies = [np.asarray(Image.open(tmp_path / f"out/images/{number}.png")) for number in range(3)]
    assert (np.stack(copies) == values >> 8).all()


@pytest.mark.parametrize(("name", "dtype"), [("a.png", "u2"), ("a.tif", "u2"), ("a.tif", "i4"), ("a.tif", "f4")])
def test_grey_values_of_unknown_range_are_refused(tmp_path, name, dtype):
    Image.fromarray(np.ones((9, 9), dtype)).save(tmp_path / name)
    line = f"{tmp_path}/{name}: has grey values of more than 8 bits; write it with 8 bits a channel"
    refuses(line, gather._copy_image, tmp_path / name, tmp_path / "copy.png", error=SceneError)


def half(size=(32, 20)):
    """Returns a mask with a black right half."""
    mask = Image.new("L", size)
    mask.paste(255, (0, 0, size[0] // 2, size[1]))
    return mask


def clear(mask):
    """Returns a white image that is transparent where the mask is black."""
    picture = Image.new("RGBA", mask.size, "white")
    picture.putalpha(mask)
    return picture


@pytest.mark.parametrize(
    ("files", "names", "line"),
    [
        ({**numbered("{}.jpg"), "masks/0.jpg.png": half(), "masks/2.png": half()}, ["0.jpg", "2.jpg"], "2 of 3"),
        ({**numbered("images/{}.jpg"), "masks/1.png": half()}, ["1.jpg"], "1 of 3 images have a mask"),
        ({**numbered("a b/{}.webp"), "masks/a b/1.webp.png": half()}, ["a_b_1.jpg"], "1 of 3 images have a mask"),
        ({**numbered("camA/{}.jpg"), "camA/masks/1.png": half()}, ["camA_1.jpg"], "1 of 3 images have a mask"),
        ({**numbered("{}.jpg"), "masks/1.png": clear(half())}, ["1.jpg"], "1 of 3 images have a mask"),
        ({**numbered("{}.tif"), "masks/1.png": half().convert("P")}, ["1.png"], "1 of 3 images have a mask"),
        ({**numbered("{}.jpg"), "../masks/1.png": half().convert("RGBA")}, ["1.jpg"], "1 of 3 images have a mask"),
        ({**numbered("{}.jpg"), "0 2.jpg": 0, "masks/0.png": half(), "masks/0 2.png": half()}, ["0.jpg"], "1 of 3"),
        ({**numbered("images/{}.jpg"), "images/dynamic_mask_1.png": ImageOps.invert(half())}, ["1.jpg"], "1 of 3"),
        ({**numbered("{}.jpg"), "masks/mask_1.png": half()}, [], "masks: has no mask of any image; the mask of 0.jpg"),
        (numbered("{}.jpg"), [], ""),
    ],
)
def test_masks_go_along(tmp_path, monkeypatch, files, names, line):
    copies, said = gathered(tmp_path, monkeypatch, files)
    assert len(copies) == 3 and line in "".join(said[-1:])
    masks = tmp_path / "out/masks"
    assert masks.is_dir() == bool(names)
    assert sorted(path.name for path in masks.glob("*")) == [f"{name}.png" for name in names]
    for folder in (masks, tmp_path / "out/colmap/masks"):
        for name in names:
            assert (np.asarray(Image.open(folder / f"{name}.png").convert("L")) == np.asarray(half())).all()


@pytest.mark.parametrize("tag", [6, 8])
def test_masks_drawn_on_turned_photographs_lie_as_the_photographs_are_stored(tmp_path, monkeypatch, tag):
    photograph, upright = io.BytesIO(), half()
    picture(1).save(photograph, "JPEG", exif=oriented(tag))
    upright.getexif()[0x0112] = tag
    files = {**numbered("{}.jpg"), "1.jpg": photograph.getvalue(), "masks/1.png": ImageOps.exif_transpose(upright)}
    gathered(tmp_path, monkeypatch, files)
    assert Image.open(tmp_path / "in/masks/1.png").size == (20, 32)
    for name in ("masks", "colmap/masks"):
        assert (np.asarray(Image.open(tmp_path / f"out/{name}/1.jpg.png").convert("L")) == np.asarray(half())).all()


@pytest.mark.parametrize(
    ("mask", "reason"),
    [
        (half((20, 32)), "masks/1.png: is 20 x 32 pixels, 1.jpg is 32 x 20"),
        (half((16, 10)), "masks/1.png: is 16 x 10 pixels, 1.jpg is 32 x 20"),
        (b"no image", "masks/1.png: cannot be read: "),
    ],
)
def test_a_mask_that_does_not_fit_leaves_nothing(tmp_path, mask, reason):
    (tmp_path / "in/masks").mkdir(parents=True)
    for number in range(3):
        picture(number).save(tmp_path / f"in/{number}.jpg")
    half().save(tmp_path / "in/masks/0.png")
    if isinstance(mask, bytes):
        (tmp_path / "in/masks/1.png").write_bytes(mask)
    else:
        mask.save(tmp_path / "in/masks/1.png")
    refuses(reason, process.process, tmp_path / "in", tmp_path / "out", error=SceneError)
    assert not (tmp_path / "out").exists()


def test_masked_and_transparent_parts_have_no_features_and_do_not_train(tmp_path, pictures):
    (tmp_path / "in/masks/b").mkdir(parents=True)
    for number, path in enumerate(sorted(pictures.iterdir())):
        (tmp_path / f"in/{'ab'[number // 4]}").mkdir(exist_ok=True)
        shutil.copy(path, tmp_path / f"in/{'ab'[number // 4]}/{number}.png")
    mask = Image.new("1", (WIDTH, HEIGHT), 1)
    mask.paste(0, (0, 0, WIDTH // 4, HEIGHT))
    mask.save(tmp_path / "in/masks/b/5.png")
    with Image.open(tmp_path / "in/a/2.png") as image:  # its right half is transparent
        image.putalpha(Image.fromarray(np.arange(WIDTH)[None].repeat(HEIGHT, 0) < WIDTH // 2).convert("L"))
        image.save(tmp_path / "in/a/2.png")
    out = tmp_path / "out"
    process.process(tmp_path / "in", out, max_features=300)
    with pycolmap.Database.open(out / "colmap/database.db") as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        columns = [opened.read_keypoints(image.image_id)[:, 0] for image in images]
    assert [x.min() > WIDTH // 4 - 1 for x in columns] == [number == 5 for number in range(COUNT)]
    assert [x.max() < WIDTH // 2 + 1 for x in columns] == [number == 2 for number in range(COUNT)]
    assert min(map(len, columns)) > 50
    scene = load_scene(out, format="transforms")
    names = [f"{'ab'[number // 4]}_{number}" for number in range(COUNT)]
    assert sorted([*scene.train.names, *scene.test.names]) == names
    masks = {name: split.mask(i) for split in (scene.train, scene.test) for i, name in enumerate(split.names)}
    assert [bool(masks[name].all()) for name in names] == [number not in (2, 5) for number in range(COUNT)]
    assert not masks["b_5"][:, : WIDTH // 4].any() and masks["b_5"][:, WIDTH // 4 :].all()
    assert not masks["a_2"][:, WIDTH // 2 :].any() and masks["a_2"][:, : WIDTH // 2].all()


def test_pycolmap_is_needed_once_the_images_were_looked_at(tmp_path, monkeypatch):
    write_images(tmp_path, [(12, 10)] * 2)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pycolmap", None)
        refuses("images, got 2", process.process, tmp_path / "images", tmp_path / "out", error=SceneError)
        picture(1).save(tmp_path / "images/more.png")
        refuses("pip install 'voronerf[colmap]'", process.process, tmp_path, tmp_path / "out", error=ImportError)
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    refuses("finds no model", process.process, tmp_path, tmp_path / "out", error=SceneError)


def with_lens(image, path, focal):
    """Saves a JPEG with EXIF tags of a phone and, unless ``focal`` is None, of a focal length in 35 mm film."""
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "Phone"
    if focal:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
    path.parent.mkdir(parents=True, exist_ok=True)
    image.convert("RGB").save(path, exif=exif)


def test_each_lens_has_a_camera(tmp_path, pictures, features):
    """Phones write images of 1x and 2x in one size; without tags, each folder and size counts as a lens."""
    lenses = {"all/1x_{}.jpg": 26, "all/2x_{}.jpg": 52, "a/{}.jpg": None, "a/upright_{}.jpg": None, "b/{}.jpg": None}
    for number, (name, focal) in enumerate(itertools.chain(*[lenses.items()] * 2)):
        with Image.open(pictures / f"{number % COUNT:02} a.png") as image:
            turned = image.rotate(90 * ("upright" in name), expand=True)
            with_lens(turned, tmp_path / "in" / name.format(number), focal)
    said = []
    with features(tmp_path / "in", tmp_path / "out", max_features=100, say=said.append) as opened:
        sizes = {camera.camera_id: (camera.width, camera.height) for camera in opened.read_all_cameras()}
        taken = {image.name[:-5]: image.camera_id for image in opened.read_all_images()}
    line = next(line for line in said if "10 images with 5 cameras" in line)
    assert all(f"2 of {WIDTH} x {HEIGHT}, {lens}" in line for lens in ("Phone 26 mm", "Phone 52 mm", "in a", "in b"))
    assert f"2 of {HEIGHT} x {WIDTH}, in a" in line
    assert len(taken) == len(set(taken.values())) == len(sizes) == 5
    assert [name for name, camera in taken.items() if sizes[camera] == (HEIGHT, WIDTH)] == ["a_upright_"]


@pytest.mark.parametrize("focal", [0, IFDRational(1, 0), IFDRational(0, 0), -5, "x"])
def test_focal_lengths_that_tell_nothing(tmp_path, focal):
    """Manual lenses write 0; then the folder of an image tells its lens."""
    for name in ("a", "b"):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm if focal == 0 else 37386] = focal
        picture(1).save(tmp_path / f"{name}.jpg", exif=exif)
    labels = gather.cameras_of(sorted(tmp_path.iterdir()), {"a.jpg": "left", "b.jpg": "right"})
    assert [label.partition(", ")[2] for label in labels.values()] == ["in left", "in right"]


def test_broken_tags_are_left_out(tmp_path):
    for suffix in ("png", "webp"):
        picture(1).save(tmp_path / f"a.{suffix}", exif=b"Exif\0\0junkjunk")
        copy, _ = gather._copy_image(tmp_path / f"a.{suffix}", tmp_path / f"copy.{suffix}")
        assert gather.cameras_of([copy], {}) == {copy.name: "{} x {}".format(*read_header(copy).size)}


def test_other_files_are_not_taken_for_those_of_a_stopped_process(tmp_path, monkeypatch, pictures):
    models(tmp_path, monkeypatch, None, **{"global": None, "incremental": None})
    few = tmp_path / "few"
    few.mkdir()
    paths = sorted(pictures.iterdir())
    for path in paths[:4]:
        shutil.copy(path, few)
    refuses("finds no model", process.process, few, tmp_path / "out", error=SceneError)
    shutil.copy(paths[4], few)
    refuses("was started with other files in", process.process, few, tmp_path / "out", error=SceneError)


def test_features_are_searched_in_smaller_images(tmp_path, pictures, features):
    sizes = []
    for size in (1600, 100):
        with features(pictures, tmp_path / str(size), max_features=300, size=size) as opened:
            sizes.append(min(len(opened.read_keypoints(image.image_id)) for image in opened.read_all_images()))
    assert sizes[1] < 0.95 * sizes[0]
    again = {"max_features": 300, "size": 90}
    refuses("with --size 100, got 90", process.process, pictures, tmp_path / "100", error=SceneError, **again)


def test_a_background_that_stands_still_is_said(tmp_path, pictures, monkeypatch):
    models(tmp_path, monkeypatch, pictures, **{"global": None, "incremental": None})
    for still, lines in ((3, 0), (8, 1)):
        monkeypatch.setattr(process, "still_pairs", lambda _, still=still: (still, 28))
        out, said = tmp_path / f"{still}", []
        refuses("no model", process.process, pictures, out, say=said.append, error=SceneError)
        assert sum(f"{still} of 28 pairs show a static background" in line for line in said) == lines


def test_a_training_of_photographs_without_cameras_points_to_process(tmp_path):
    write_images(tmp_path / "walk", [(12, 10)] * 2)
    for folder in (tmp_path / "walk", tmp_path / "walk/images"):
        refuses(f"voronerf process {tmp_path}/walk/images DIR finds the cameras", load_scene, folder, error=SceneError)
    (tmp_path / "web").mkdir()
    picture(1).save(tmp_path / "web/0.webp")
    refuses(f"voronerf process {tmp_path}/web DIR finds the cameras", load_scene, tmp_path / "web", error=SceneError)
    (tmp_path / "walk.MOV").touch()
    refuses(f"voronerf process {tmp_path}/walk.MOV DIR makes one", load_scene, tmp_path / "walk.MOV", error=SceneError)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError) as refused:
        load_scene(tmp_path / "empty")
    assert "process" not in str(refused.value)


def test_an_image_that_cannot_be_read_is_one_line_and_leaves_nothing(tmp_path, pictures):
    Image.open(pictures / "01 a.png").save(tmp_path / "whole.jpg")
    jpeg, png = (tmp_path / "whole.jpg").read_bytes(), (pictures / "01 a.png").read_bytes()
    for number, (content, reason) in enumerate(
        (
            (jpeg[: len(jpeg) // 2], "cannot be read: image file is truncated"),
            (png[: len(png) // 2], "cannot be read: image file is truncated"),
            (b"no image" * 9, "is not an image in PNG, JPEG, WebP, TIFF, BMP format"),
            (b"", "is not an image in PNG, JPEG, WebP, TIFF, BMP format"),
            (png[:16] + b"\x7f" + png[17:], "is not an image in PNG, JPEG, WebP, TIFF, BMP format"),
        )
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in ("00 a.png", "02 a.png", "03 a.png"):
            (folder / name).write_bytes((pictures / name).read_bytes())
        (folder / "bad.jpg").write_bytes(content)
        refuses(f"{folder}/bad.jpg: {reason}", process.process, folder, tmp_path / "out", error=SceneError)
        assert not (tmp_path / "out").exists()


def test_pictures_with_few_features_are_enlarged(tmp_path, pictures, features, monkeypatch):
    octaves, extract = [], pycolmap.extract_features

    def recorded(*arguments, extraction_options, **more):
        octaves.append(extraction_options.sift.first_octave)
        extract(*arguments, extraction_options=extraction_options, **more)

    monkeypatch.setattr(pycolmap, "extract_features", recorded)
    for most, octave in ((100, 0), (8192, -1)):
        octaves.clear()
        features(pictures, tmp_path / str(most), max_features=most, matching="sequential").close()
        assert octaves[0] == 0 and set(octaves[1:]) == {octave}
        assert not list(tmp_path.rglob("tried.db*"))
