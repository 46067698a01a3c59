"""Tests of COLMAP folders as users have them: models, file names, masks, and broken folders."""

import os
import shutil
import struct

import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image
from scene_files import COUNT, POINTS, POSES, SIZE, check_pairs, every, write_both, write_colmap, write_images

from voronerf.app.scenes import SceneError, load_scene

NAMES = "cameras", "images", "points3D"


def write_models(folder, counts, pictures="images"):
    """Writes COLMAP models; a model in the subfolder `place` has the first `counts[place]` images."""
    for place, count in counts.items():
        write_colmap(folder / "made", POSES[:count], [SIZE] * count, POINTS, binary=place.endswith(("0", "2")))
        shutil.copytree(folder / "made/sparse/0", folder / place, dirs_exist_ok=True)
        shutil.rmtree(folder / "made")
    write_images(folder / "made", [SIZE] * COUNT)
    shutil.move(folder / "made/images", folder / pictures)


@pytest.mark.parametrize(
    ("counts", "pictures", "data", "largest"),
    [
        ({"sparse/0": 3, "sparse/1": 9, "sparse/2": 4}, "images", (".", "sparse"), "sparse/1"),
        ({"sparse/2": 4, "sparse/10": 9}, "images", (".", "sparse"), "sparse/10"),
        ({"sparse/0": 9, "sparse/1": 9}, "images", (".", "sparse"), "sparse/0"),
        ({"sparse/0": 3, "sparse": 9}, "images", (".",), "sparse"),
        ({"colmap/sparse/0": 3, "colmap/sparse/1": 9}, "images", (".", "colmap/sparse"), "colmap/sparse/1"),
        ({"distorted/sparse/0": 9, "distorted/sparse/1": 5}, "input", (".", "distorted/sparse"), "distorted/sparse/0"),
        ({"0": 3, "1": 9}, "Images", (".",), "1"),
    ],
)
def test_of_several_models_the_largest_is_read_or_the_one_that_is_named(tmp_path, counts, pictures, data, largest):
    write_models(tmp_path, counts, pictures)
    sizes = ", ".join(f"{place} of {count}" for place, count in counts.items())
    other = next(place for place in counts if place != largest)
    for each in data:
        scene = load_scene(tmp_path / each)
        assert scene.name == tmp_path.name and len(scene.train) + len(scene.test) == counts[largest]
        line = f"the largest of the models is read: {sizes} images (--data {tmp_path / other} reads another one)"
        assert line in scene.notes
    for place, count in counts.items():
        if place != "sparse":
            scene = load_scene(tmp_path / place)
            assert len(scene.train) + len(scene.test) == count and not any("largest" in note for note in scene.notes)


def test_the_folder_of_undistorted_images_is_a_scene(tmp_path):
    write_models(tmp_path, {"dense/sparse": COUNT}, "dense/images")
    for folder in (tmp_path, tmp_path / "dense", tmp_path / "dense/sparse"):
        assert len(load_scene(folder).train) == 7
    (tmp_path / "transforms.json").write_text("{}")
    refuses("transforms.json: has no frames", load_scene, tmp_path, error=SceneError)  # the more informative error
    write_models(tmp_path / "outside", {"sparse/0": 3})
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/1").symlink_to(tmp_path / "outside/sparse/0")
    folder = tmp_path / "dense"
    shutil.move(tmp_path / "sparse/1", folder / "sparse/1")
    refuses("must lie in the folder of the scene", load_scene, folder, error=SceneError)


@pytest.mark.parametrize("missing", ["cameras", "images"])
def test_a_model_is_read_of_the_files_that_belong_together(tmp_path, missing):
    write_both(tmp_path)
    write_both(tmp_path, binary=False)
    for name in NAMES:
        text = tmp_path / f"sparse/0/{name}.txt"
        text.write_bytes(b"\xef\xbb\xbf# of Windows\r\n" + text.read_bytes())
    (tmp_path / f"sparse/0/{missing}.bin").unlink()
    assert every(load_scene(tmp_path, format="colmap"))[0] == [f"{index:02d}" for index in range(COUNT)]


def write_named(folder, name, file, pictures="images", size=SIZE):
    """Writes a model; `name` and `file` map an image's number to its name in the model and on disk."""
    write_colmap(folder, POSES, [SIZE] * COUNT, POINTS, binary=False)
    listed = folder / "sparse/0/images.txt"
    text = listed.read_text()
    for index in range(COUNT):
        text = text.replace(f" {index:02d}.jpg", f" {name(index)}")
        path = folder / pictures / file(index)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, 3 * (index,)).save(path)
    listed.write_text(text)


@pytest.mark.parametrize(
    ("name", "file", "order"),
    [
        ("IMG_{}.JPG", "IMG_{}.png", False),
        ("IMG_{}", "IMG_{}.JPG", False),
        ("frame.{:03d}", "frame.{:03d}.png", False),  # ".000" is no suffix
        ("{}.jpg", "{}.jpg.png", False),
        ("img_{}.jpg", "IMG_{}.JPG", False),
        ("IMG_{}.HEIC", "img_{}.jpeg", False),
        ("camA\\{}.tif", "camA/{}.png", False),
        ("images/{}.jpg", "{}.jpg", False),
        ("/home/someone/a/{}.jpg", "{}.jpg", False),
        ("C:\\a\\{}.jpg", "b/{}.png", False),
        ("IMG_{}.JPG", "image{:03d}.png", True),
        ("/home/someone/gone/{}.jpg", "{:03d}.png", True),
        ("Mu\u0308ller_{}.jpg", "M\u00fcller_{}.jpg", False),  # as macOS writes names
        ("M\u00dcLLER_{}.jpg", "mu\u0308ller_{}.png", False),
        ("E:\\scan\\left\\{}.jpg", "left/{}.jfif", False),
        pytest.param("9" * 5000 + "{}.jpg", "{:03d}.png", True, id="more digits than int takes"),
    ],
)
def test_images_are_found_by_their_names_or_else_by_their_order(tmp_path, name, file, order):
    write_named(tmp_path, name.format, file.format)
    (tmp_path / "images/._0.png").write_bytes(b"of macOS")
    scene = check_pairs(load_scene(tmp_path, normalise=False))
    assert ("no file in images has a name of the model: files are matched by order" in scene.notes) == order


@pytest.mark.parametrize(("name", "file"), [("{}.jpg", "image_{:03d}.png"), ("IMG_{:03d}.JPG", "{}.png")])
def test_an_order_of_which_there_are_two_is_none(tmp_path, name, file):
    """Files are not matched by order if their numeric and alphabetic orders differ: "10" sorts before "9" as text."""
    write_named(tmp_path, lambda index: name.format(index + 5), lambda index: file.format(index + 5))
    refuses("none of its 9 images exists", load_scene, tmp_path, error=SceneError)


def test_a_name_may_be_missing_wherever_it_leads(tmp_path):
    names = ["/home/someone/a/{}.jpg", "/home/someone/a/{}.jpg"]
    write_named(tmp_path, names[0].format, "{}.jpg".format)
    (tmp_path / "images/3.jpg").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 8
    listed = tmp_path / "sparse/0/images.txt"
    text = listed.read_text()
    listed.write_text(text.replace("/home/someone/a/4", "b" * 300))
    scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 7
    listed.write_text(text.replace("/home/someone/a/4", "b\0"))
    refuses("the name of an image must have no zero byte", load_scene, tmp_path, error=SceneError)


@pytest.mark.parametrize("damage", ["count", "text", "link"])
def test_a_broken_model_beside_a_sound_one_is_not_the_largest(tmp_path, damage):
    folder = tmp_path / "scene"
    write_models(folder, {"sparse/0": 4, "sparse/1": 9})
    if damage == "count":
        (folder / "sparse/1/cameras.bin").write_bytes(b"")
        (folder / "sparse/1/images.bin").write_bytes(bytes([255] * 8))
    elif damage == "text":
        (folder / "sparse/1/images.txt").write_text("1 2 3\n")
    else:
        shutil.move(folder / "sparse/1", tmp_path / "elsewhere")
        (folder / "sparse/1").symlink_to(tmp_path / "elsewhere")
    scene = load_scene(folder)
    assert len(scene.train) + len(scene.test) == 4


@pytest.mark.parametrize(("place", "data"), [("sparse/0", "."), ("sparse", "."), ("sparse", "0")])
def test_the_folder_of_a_model_is_known_from_within(tmp_path, monkeypatch, place, data):
    write_both(tmp_path)
    monkeypatch.chdir(tmp_path / place)
    scene = load_scene(data)
    assert len(scene.train) + len(scene.test) == 9


def test_images_are_reduced_ones_of_the_same_order(tmp_path):
    """A reduced image is found by its position among all images of the folder, including images not in the model."""
    write_named(tmp_path, "IMG_{}.JPG".format, "IMG_{}.JPG".format)
    write_named(tmp_path, "IMG_{}.JPG".format, "image{:03d}.png".format, "images_2", (6, 5))
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[5:]) + "\n")  # drops the last two images, listed first
    scene = check_pairs(load_scene(tmp_path, downscale=2, normalise=False), 7)
    assert scene.train.images.shape == (6, 5, 6, 3)
    (tmp_path / "images_2/image004.png").unlink()
    refuses("none of its 7 images exists", load_scene, tmp_path, downscale=2, error=SceneError)


def test_images_that_may_be_others_are_not_taken(tmp_path, caplog):
    write_named(tmp_path / "a", "{}".format, "{}.png".format)
    Image.new("RGB", SIZE).save(tmp_path / "a/images/3.jpg")
    refuses("3 may be 3.jpg or 3.png in", load_scene, tmp_path / "a", error=SceneError)
    write_named(tmp_path / "b", "{}.png".format, "{}.png".format)
    Image.new("RGB", SIZE).save(tmp_path / "b/images/3.jpg")
    assert "3" in load_scene(tmp_path / "b").train.names and not caplog.records
    names = [f"cam{index % 2}/{index}.png" for index in range(COUNT)]
    write_named(tmp_path / "c", names.__getitem__, names.__getitem__)
    (tmp_path / "c/images/cam1/3.png").rename(tmp_path / "c/images/cam0/3.png")
    assert "3" not in load_scene(tmp_path / "c").train.names and "1 of 9 listed images are missing" in caplog.text
    write_named(tmp_path / "d", lambda index: f"cam{index % 2}/{index // 2}.png", lambda index: f"{index // 2}.png")
    refuses("none of its 9 images exists", load_scene, tmp_path / "d", error=SceneError)


def test_a_file_is_that_of_one_name_alone(tmp_path, caplog):
    """The file 3.png is read for a missing 3.jpg only if 3.png is not listed and matches no other listed name."""
    for lost in ("3.jpg", "3"):
        write_named(tmp_path / lost, lambda index, lost=lost: lost if index == 4 else f"{index}.png", "{}.png".format)
        scene = load_scene(tmp_path / lost, normalise=False)
        torch.testing.assert_close(scene.train.cameras.poses[scene.train.names.index("3")], POSES[3], atol=1e-5, rtol=0)
        assert "1 of 9 listed images are missing" in caplog.text
    names = [*(f"{index}.jpg" for index in range(4)), "3.tif", *(f"{index}.jpg" for index in range(5, COUNT))]
    write_named(tmp_path / "b", names.__getitem__, "{}.png".format)
    scene = load_scene(tmp_path / "b")
    assert "3" not in (*scene.train.names, *scene.test.names) and "2 of 9 listed images are missing" in caplog.text


def test_names_of_files_elsewhere_are_those_in_the_folder(tmp_path):
    """For a path outside the scene, the scene's file of the same name is read, unless outside files are allowed."""
    elsewhere = tmp_path / "elsewhere"
    write_named(tmp_path / "scene", lambda index: f"{elsewhere}/{index}.png", "{}.png".format)
    elsewhere.mkdir()
    for index in range(COUNT):
        Image.new("RGB", SIZE, (99,) * 3).save(elsewhere / f"{index}.png")
    for allowed, grey in ((False, 1), (True, 99)):
        scene = load_scene(tmp_path / "scene", allow_outside=allowed)
        assert int(scene.train.images[scene.train.names.index("1")].max()) == grey


@pytest.mark.parametrize("again", ["03.jpg", "./03.jpg", "../images/03.jpg", "link.jpg"])
def test_an_image_that_is_listed_twice_is_not_also_held_out(tmp_path, again):
    write_named(tmp_path, lambda index: again if index == 8 else f"{index:02d}.jpg", "{:02d}.jpg".format)
    (tmp_path / "images/link.jpg").symlink_to(tmp_path / "images/03.jpg")
    scene = load_scene(tmp_path)
    assert f"images are listed twice; only the first entry counts: {again.rpartition('/')[2]}" in scene.notes
    assert sorted((*scene.train.names, *scene.test.names)) == [f"{index:02d}" for index in range(8)]


@pytest.mark.parametrize(
    ("place", "name"),
    [("rgb", "{:02d}.jpg"), ("My 100% Frames", "C:\\a\\{:02d}.JPG"), ("rgb", "rgb/{:02d}.jpg"), (".", "{:02d}.jpg")],
)
@pytest.mark.parametrize("data", [".", "sparse/0"])
def test_a_folder_of_images_with_another_name(tmp_path, place, name, data):
    write_named(tmp_path, name.format, "{:02d}.jpg".format, "made")
    half_black(tmp_path / "masks/03.jpg.png", SIZE)
    half_black(tmp_path / "depth/03.jpg", SIZE)
    (tmp_path / place).mkdir(exist_ok=True)
    for path in (tmp_path / "made").iterdir():
        path.rename(tmp_path / place / path.name)
    scene = load_scene(tmp_path / data)
    # Names with the folder are paths in the scene's folder.
    where = tmp_path.name if place == "." or "rgb/" in name else place
    assert f"images are read from {where}, since there is no folder images" in scene.notes
    assert scene.name == tmp_path.name and len(scene.train) + len(scene.test) == 9
    assert "1 of 9 images have a mask in masks, whose black pixels do not count" in scene.notes


def test_two_folders_of_images_with_other_names_are_refused(tmp_path):
    write_named(tmp_path, "{:02d}.jpg".format, "{:02d}.jpg".format, "rgb")
    shutil.copytree(tmp_path / "rgb", tmp_path / "small")
    line = "has no folder images, and rgb as well as small has images of the model; rename the folder of the images to"
    refuses(line, load_scene, tmp_path, error=SceneError)
    shutil.rmtree(tmp_path / "rgb")
    for path in (tmp_path / "small").iterdir():
        path.rename(path.with_name(f"x{path.name}"))
    refuses("images_4, ...; rename the folder of the images to images", load_scene, tmp_path, error=SceneError)


def test_places_of_automatic_reconstruction_and_of_glomap(tmp_path):
    """A place with images comes before a place without, and `transforms.json` before both."""
    folder = tmp_path / "automatic"
    write_models(folder, {"dense/0/sparse": 9, "sparse/0": 5}, "dense/0/images")
    (folder / "dense/1").mkdir()
    for data, name in ((folder, "automatic"), (folder / "dense/0", "0"), (folder / "dense/0/sparse", "0")):
        scene = load_scene(data)
        assert len(scene.train) == 7 and scene.name == name
    line = f"the first of the folders in dense is read (--data {folder / 'dense/1'} reads another one)"
    assert line in load_scene(folder).notes
    folder = tmp_path / "glomap"
    write_models(folder, {"output/0": 9})
    for data in (folder, folder / "output", folder / "output/0"):
        scene = load_scene(data)
        assert len(scene.train) == 7 and scene.name == "glomap"
    (folder / "transforms.json").write_text("{}")
    refuses("transforms.json: has no frames", load_scene, folder, error=SceneError)


def write_list(path, *lines):
    path.write_bytes(b"\xef\xbb\xbf" + "\n".join(("# names", "", *lines, "")).encode())


BOTH = "6 images are in no list", "those of train_list.txt and test_list.txt: 1 of 9"


@pytest.mark.parametrize(
    ("model", "lists", "train", "test", "notes"),
    [
        ("{:02d}.jpg", {"test": ["03.jpg", "05.jpg"]}, (0, 1, 2, 4, 6, 7, 8), (3, 5), ("sparse/0/test.txt: 2 of 9",)),
        ("{:02d}.jpg", {"test": ["images/03\r", "images/05.JPG\r"]}, (0, 1, 2, 4, 6, 7, 8), (3, 5), ()),
        ("{:02d}.jpg", {"test": ["03", "77", "# 05"]}, (0, 1, 2, 4, 5, 6, 7, 8), (3,), ("1 of 2 names in",)),
        ("{:02d}.jpg", {"test": ["images\\03.png", "./images/05.png"]}, (0, 1, 2, 4, 6, 7, 8), (3, 5), ()),
        ("a/{:02d}.jpg", {"test": ["03.jpg", "05.jpg", "77.jpg"]}, (0, 1, 2, 4, 6, 7, 8), (3, 5), ("1 of 3 names in",)),
        ("{:02d}.jpg", {"test": ["77"]}, range(1, 8), (0, 8), ("1 of 1 names in", "every 8th image is held out")),
        ("{:02d}.jpg", {"test": []}, range(1, 8), (0, 8), ()),
        ("{:02d}.jpg", {"train_list": ["01", "02"], "test_list": ["03"]}, (1, 2), (3,), BOTH),
        ("{:02d}.jpg", {"train_list": ["01", "02"]}, (1, 2), (0, 3, 4, 5, 6, 7, 8), ()),
        ("{:02d}.jpg", {"test_list": ["03"], "test": ["04"]}, (0, 1, 2, 4, 5, 6, 7, 8), (3,), ()),
    ],
)
def test_lists_of_test_images(tmp_path, model, lists, train, test, notes):
    write_named(tmp_path, model.format, model.format)
    for name, lines in lists.items():
        write_list(tmp_path / ("sparse/0/test.txt" if name == "test" else f"{name}.txt"), *lines)
    scene = load_scene(tmp_path)
    for split, numbers in ((scene.train, train), (scene.test, test)):
        assert [int(name[-2:]) for name in split.names] == list(numbers)
    for line in notes:
        assert line in " ".join(scene.notes)
    said = "test images are those of" in " ".join(scene.notes)
    assert said == (len(test) + len(train) < 9 or tuple(test) != (0, 8))


def test_lists_and_names_of_windows(tmp_path):
    write_named(tmp_path, "a\\{:02d}.jpg".format, "a/{:02d}.jpg".format)
    write_list(tmp_path / "sparse/0/test.txt", "a\\03.jpg")
    assert load_scene(tmp_path).test.names == ("03",)


def test_lists_of_llff_and_lists_that_are_broken(tmp_path):
    write_both(tmp_path)
    write_list(tmp_path / "test_list.txt", "03.jpg")
    assert load_scene(tmp_path, format="llff").test.names == ("03",)
    write_list(tmp_path / "train_list.txt", "01", "03")
    refuses("train_list.txt and the images for testing must differ", load_scene, tmp_path, error=SceneError)
    (tmp_path / "train_list.txt").unlink()
    (tmp_path / "test_list.txt").write_text("03.jpg", encoding="utf-16")
    refuses("test_list.txt: is UTF-16 text; save it as UTF-8", load_scene, tmp_path, error=SceneError)
    (tmp_path / "test_list.txt").unlink()
    (tmp_path / "test_list.txt").symlink_to("/etc/passwd")
    refuses("test_list.txt: must lie in the folder of the scene", load_scene, tmp_path, error=SceneError)
    names = [f"{'left' if index % 2 else 'right'}/{index // 2:02d}.jpg" for index in range(COUNT)]
    write_named(tmp_path / "two", names.__getitem__, names.__getitem__)
    write_list(tmp_path / "two/sparse/0/test.txt", "03.jpg")
    refuses("03.jpg may be left/03.jpg or right/03.jpg: the list", load_scene, tmp_path / "two", error=SceneError)
    write_list(tmp_path / "two/sparse/0/test.txt", "left/03.jpg", "right/03")
    assert load_scene(tmp_path / "two").test.names == ("images_right_03", "images_left_03")[::-1]


def half_black(path, size):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.uint8(255) * (np.arange(size[0]) >= size[0] // 2)[None].repeat(size[1], 0)).save(path)


@pytest.mark.parametrize(
    ("name", "file", "mask", "size"),
    [
        ("{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.jpg.png", SIZE),  # COLMAP's naming
        ("{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.png", SIZE),  # nerfstudio's naming
        ("{:02d}.png", "{:02d}.png", "Masks/{:02d}.png", SIZE),
        ("{:02d}", "{:02d}.JPG", "masks/{:02d}.JPG.png", SIZE),
        ("a/{:02d}.jpg", "a/{:02d}.jpg", "masks/a/{:02d}.jpg.png", SIZE),
        ("../images/{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.jpg.png", SIZE),
        ("/home/someone/{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.jpg.png", SIZE),
        ("{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.jpg.png", (48, 40)),
        ("{:02d}.jpg", "{:02d}.jpg", "masks/{:02d}.jpg.png", (50, 41)),
    ],
)
def test_masks_beside_the_images_of_a_model(tmp_path, name, file, mask, size):
    write_named(tmp_path, name.format, file.format)
    for index in (0, 1, 4):
        half_black(tmp_path / mask.format(index), size)
    scene = load_scene(tmp_path)
    folder = mask.partition("/")[0]
    assert f"3 of 9 images have a mask in {folder}, whose black pixels do not count" in scene.notes
    for split in (scene.train, scene.test):
        for view, label in enumerate(split.names):
            kept = torch.ones(10, 12, dtype=torch.bool)
            kept[:, :6] = label not in ("00", "01", "04")
            assert torch.equal(split.mask(view), kept)


def test_masks_of_reduced_images(tmp_path):
    write_images(tmp_path, [(48, 40)] * COUNT)
    lens = ("SIMPLE_PINHOLE", (80.0, 24.0, 20.0))
    write_colmap(tmp_path, POSES, [(48, 40)] * COUNT, POINTS, lenses=[lens] * COUNT)
    (tmp_path / "images_4").mkdir()
    for index in range(COUNT):
        Image.new("RGB", (12, 10)).save(tmp_path / f"images_4/{index:02d}.png")
        half_black(tmp_path / f"masks/{index:02d}.jpg.png", (48, 40))
    block = np.full((40, 48), 255, np.uint8)
    block[9, 13] = 0
    Image.fromarray(block).save(tmp_path / "masks/02.jpg.png")
    scene = load_scene(tmp_path, downscale=4)
    assert [int(mask.sum()) for mask in scene.train.masks] == [60, 119, 60, 60, 60, 60, 60]
    assert not scene.train.masks[1][2, 3]  # a block with a black pixel
    half_black(tmp_path / "masks_4/03.png", (12, 10))
    scene = load_scene(tmp_path, downscale=4)
    assert "1 of 9 images have a mask in masks_4, whose black pixels do not count" in scene.notes
    for size, reason in (((40, 48), "03.png: is 40 x 48 pixels"), ((6, 5), "03.png: is 6 x 5 pixels, 03.png is 12 x")):
        half_black(tmp_path / "masks_4/03.png", size)
        refuses(reason, load_scene, tmp_path, downscale=4, error=SceneError)
    (tmp_path / "masks_4/03.png").unlink()
    (tmp_path / "masks_4/03.png").symlink_to("/etc/passwd")
    refuses("must lie in the folder of the scene", load_scene, tmp_path, downscale=4, error=SceneError)


def broken(name, at, layout, *values):
    """Returns a function that overwrites a part of a model's file."""

    def change(model):
        data = bytearray((model / f"{name}.bin").read_bytes())
        struct.pack_into(layout, data, at, *values)
        (model / f"{name}.bin").write_bytes(data)

    return change


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (broken("images", 0, "<Q", 2**60), "images.bin: is cut short or broken: 11529215"),
        (broken("images", 8 + 64 + 7, "<Q", 2**40), "observations do not fit into"),
        (broken("points3D", 0, "<Q", 10**6), "points3D.bin: is cut short or broken: 1000000"),
        (broken("images", 12, "<d", np.nan), "image 08.jpg: its pose must be a unit"),
        (
            broken("cameras", 12, "<i", 77),
            "camera 1: camera model number 77, newer than COLMAP 4.2, is not supported (colmap image_undistorter makes",
        ),
        (broken("cameras", 12, "<i", 13), "camera 1: camera model DIVISION is not supported"),
        (lambda model: os.truncate(model / "cameras.bin", 511), "cameras.bin: is cut short"),  # of 512 bytes
        (broken("cameras", 32, "<d", -1.0), "camera 1 must have a size, finite parameters"),
        (broken("images", 44, "<d", 1e300), "its pose must be a unit quaternion and a"),
        (broken("images", 8 + 60, "<I", 99), "camera 99, which is missing in cameras.bin"),
        (broken("images", 8 + 64, "<6s", b"../../"), "must lie in the folder"),
        (lambda model: os.truncate(model / "images.bin", 90), "images.bin: is cut short"),
        (lambda model: (model / "images.bin").write_bytes(bytes(8)), "images.bin: has no images"),
        (lambda model: (model / "more.bin").symlink_to("/etc/passwd"), "more.bin: must lie in the folder of the scene"),
        (lambda model: (model.parents[1] / "images/03.jpg").write_bytes(b"no"), "03.jpg: is not an image"),
        (
            lambda model: Image.new("RGB", (10, 12)).save(model.parents[1] / "images/03.jpg"),
            "images.bin says 12 x 10: it was cropped or has another aspect ratio; use the images for which the cameras",
        ),
    ],
)
def test_broken_colmap_folders_are_one_line(tmp_path, damage, reason):
    write_both(tmp_path)
    damage(tmp_path / "sparse/0")
    refuses(reason, load_scene, tmp_path, error=SceneError)


def test_numbers_of_points_that_are_none_are_passed_over(tmp_path):
    """An invalid point number is ignored: COLMAP writes 2^64 - 1 for a feature without a point."""
    write_both(tmp_path, binary=False)
    model, before = tmp_path / "sparse/0", load_scene(tmp_path)
    (model / "points3D.txt").write_text((model / "points3D.txt").read_text() + f"{2**63} 1 2 3 0 0 0 1 1 0 2 0 3 0\n")
    lines = (model / "images.txt").read_text().splitlines()
    at = next(number for number, line in enumerate(lines) if len(line.split()) >= 30)
    (model / "images.txt").write_text("\n".join([*lines[:at], f"{lines[at]} 1 2 {2**64 - 1}", *lines[at + 1 :]]) + "\n")
    after = load_scene(tmp_path)
    assert torch.equal(before.train.cameras.poses, after.train.cameras.poses)


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("cameras", "1 PINHOLE 12 ten 20 20 6 5", "cameras.txt: line 1 does not describe a camera"),
        ("cameras", f"1 PINHOLE {10**400} 10 20 20 6 5", "camera 1 must have a size, finite parameters"),
        ("cameras", "1 PINHOLE 12 10 20 20 6", "camera 1: PINHOLE must have 4 parameters, got 3"),
        ("cameras", "1 PINHOLE 12 10 20,5 20 6 5", "camera, since it has decimal commas: write 20.5 instead of 20,5"),
        ("images", "1 0,5 0 0 0 0 0 0 1 a b.jpg", "does not describe an image, since it has decimal commas: write 0.5"),
        ("points3D", "7 1,5e-3 2 3 9 9 9 1 1 0", "not describe a point, since it has decimal commas: write 1.5e-3"),
        ("images", "1 1 0 0 0 0 0", "images.txt: line 1 does not describe an image"),
        ("points3D", "7 one 2 3", "points3D.txt: line 1 does not describe a point"),
        *[(name, "1".encode("utf-16"), f"{name}.txt: is UTF-16 text; save it as UTF-8") for name in NAMES],
    ],
)
def test_broken_text_is_one_line(tmp_path, file, text, reason):
    write_both(tmp_path, binary=False)
    (tmp_path / f"sparse/0/{file}.txt").write_bytes(text if isinstance(text, bytes) else f"{text}\n".encode())
    refuses(reason, load_scene, tmp_path, error=SceneError)
