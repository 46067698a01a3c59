"""Tests of decoding and downscaling against slow averages."""

import struct
import sys

import numpy as np
import pytest
import torch
from helpers import python, refuses
from PIL import Image
from scene_files import oriented

from voronerf.app.scenes import SceneError, images
from voronerf.app.scenes.images import area_average, read_header, read_image, read_images


def test_area_average_is_that_of_the_composited_image():
    generator = np.random.default_rng(0)
    image = generator.integers(0, 256, (13, 10, 4), dtype=np.uint8)
    image[:6, :, 3] = generator.choice((0, 255), (6, 10))
    small = area_average(image, 3)
    assert small.shape == (4, 3, 4)
    for background in (0.0, 1.0):
        values = image.astype(np.float64) / 255
        over = values[..., :3] * values[..., 3:] + background * (1 - values[..., 3:])
        reduced = small.astype(np.float64) / 255
        reduced = reduced[..., :3] * reduced[..., 3:] + background * (1 - reduced[..., 3:])
        for y in range(4):
            for x in range(3):
                block = over[3 * y : 3 * y + 3, 3 * x : 3 * x + 3].reshape(9, 3).mean(axis=0)
                assert np.abs(reduced[y, x] - block).max() <= 1.01 / 255


def test_area_average_does_not_bleed_hidden_colours():
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[0, 0] = (200, 100, 50, 255)
    image[1, 1] = (0, 255, 0, 0)  # transparent green
    assert area_average(image, 1) is image
    assert area_average(image, 2)[0, 0].tolist() == [200, 100, 50, 64]
    opaque = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert np.array_equal(area_average(opaque, 4)[0, 0], np.rint(opaque.reshape(16, 3).mean(axis=0)))


@pytest.mark.parametrize("factor", [1, 2, 3, 6, 8, 12, 16])
def test_jpeg_reduction_is_the_area_average(tmp_path, factor):
    height, width = (48, 67) if factor == 8 else (53, 67)
    y, x = np.mgrid[:height, :width]
    smooth = np.stack((127 + 100 * np.sin(x / 9), 127 + 100 * np.cos(y / 7), x + y), axis=-1).astype(np.uint8)
    path = tmp_path / "a.jpg"
    Image.fromarray(smooth).save(path, quality=97, subsampling=0)
    reduced = read_image(path, factor)
    expected = area_average(smooth, factor)
    assert reduced.shape == expected.shape == (height // factor, width // factor, 3)
    assert np.abs(reduced.astype(int) - expected.astype(int)).mean() < 2


@pytest.mark.parametrize(("mode", "tag"), [("RGB", 1), ("RGB", 3), ("RGB", 6), ("RGB", 8), ("L", 6)])
def test_a_jpeg_with_a_second_picture_is_read_like_one_without(tmp_path, mode, tag):
    """A preview or gain map in the JPEG (an MPF index, as phones and Sony cameras write) is ignored."""
    pixels = np.random.default_rng(tag).integers(0, 256, (48, 64, 3), np.uint8)
    picture, exif = Image.fromarray(pixels).convert(mode), oriented(tag)
    one, two = tmp_path / "one.jpg", tmp_path / "two.jpg"
    picture.save(one, quality=90, exif=exif)
    picture.save(two, "MPO", save_all=True, append_images=[picture.resize((16, 12))], quality=90, exif=exif)
    with Image.open(two) as file:
        assert file.format == "MPO"
    assert read_header(one) == read_header(two) and read_header(two).turns == {1: 0, 3: 2, 6: 3, 8: 1}[tag]
    for factor in (1, 2, 3, 8):  # for factor 8, an area average would differ
        assert np.array_equal(read_image(one, factor), read_image(two, factor))


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("RGBA", 4), ("L", 3), ("LA", 4), ("P", 3), ("1", 3)])
def test_modes(tmp_path, mode, channels):
    path = tmp_path / "a.png"
    Image.new("RGB", (5, 4), (255, 255, 255)).convert(mode).save(path)
    pixels = read_image(path, 1)
    assert pixels.shape == (4, 5, channels)
    assert (pixels == 255).all()


def test_one_image_with_alpha_gives_all_alpha(tmp_path):
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    Image.new("RGB", (3, 2), (1, 2, 3)).save(paths[0])
    Image.new("RGBA", (3, 2), (4, 5, 6, 7)).save(paths[1])
    images, sizes, *_ = read_images(paths, 1)
    assert sizes.tolist() == [[3, 2], [3, 2]]
    assert images[:, 0, 0].tolist() == [[1, 2, 3, 255], [4, 5, 6, 7]]
    Image.new("RGB", (2, 3), (7, 8, 9)).save(paths[0])
    images, sizes, *_ = read_images(paths, 1)
    assert images.shape == (2, 3, 3, 4) and sizes.tolist() == [[2, 3], [3, 2]]
    assert (images[0, :, :2] == torch.tensor([7, 8, 9, 255])).all() and not images[0, :, 2:].any()


@pytest.mark.parametrize("factor", [1, 3])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_bands_of_rows_are_parts_of_the_whole(tmp_path, monkeypatch, mode, factor):
    whole = np.random.default_rng(0).integers(0, 256, (53, 37, len(mode)), dtype=np.uint8)
    Image.fromarray(whole).save(tmp_path / "a.png")
    monkeypatch.setattr(images, "BAND", 200)
    assert np.array_equal(read_image(tmp_path / "a.png", factor), area_average(whole, factor))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="units of ru_maxrss")
def test_large_images_are_reduced_one_after_another(tmp_path):
    """Memory holds one large image at a time: 16 million pixels, 48 MB in RGB and 192 MB as float32."""
    for index in range(3):
        Image.new("L", (4000, 4000), index).save(tmp_path / f"{index}.png")
    code = (
        "import resource, sys; from pathlib import Path; from voronerf.app.scenes.images import read_images; "
        "most = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; before = most(); "
        "read_images(sorted(Path(sys.argv[1]).glob('*.png')), 100); print(most() - before)"
    )
    assert int(python("-c", code, tmp_path)) < 40_000


def test_what_does_not_fit_into_memory_is_not_decoded(tmp_path, monkeypatch):
    paths = [tmp_path / f"{index}.png" for index in range(4)]
    for path in paths:
        Image.new("RGB", (100, 50)).save(path)
    needed = 100 * 50 * (4 * 3 + 550)  # bytes of the images and of scoring a view
    monkeypatch.setattr(images, "available_memory", lambda: needed / 0.75)
    assert read_images(paths, 1)[0].shape == (4, 50, 100, 3)
    monkeypatch.setattr(images, "available_memory", lambda: (needed - 1) / 0.75)
    message = "4 images of 100 x 50 need 0.00 GiB with --downscale 1, more than 75% of the 0.00 GiB that are free"
    refuses(f"0.png: {message}", read_images, paths, 1, keep="memory", error=SceneError)
    assert read_images(paths, 2)[0].shape == (4, 25, 50, 3)


def to_linear(values):
    """Returns the linear values of sRGB's."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def write_profile(primaries):
    """Returns an ICC profile with sRGB's curve and these primaries, rows XYZ relative to D50 (ICC.1:2010, 8.3)."""

    def xyz(values):
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(65536 * value) for value in values))

    values = np.rint(65535 * to_linear(np.linspace(0, 1, 1024))).astype(int)
    curve = b"curv\0\0\0\0" + struct.pack(">I1024H", 1024, *values)
    tags = {b"desc": b"desc" + bytes(8) + struct.pack(">I", 2) + b"p\0" + bytes(78), b"wtpt": xyz((0.9642, 1, 0.8249))}
    tags |= {name: xyz(row) for name, row in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries)}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, data, start = b"", b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    header = struct.pack(">I4sI4s4s4s", start + len(data), b"    ", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    header = header.ljust(36, b"\0") + b"acsp".ljust(32, b"\0") + struct.pack(">3i", 63190, 65536, 54061)
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


SRGB = ((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141))
DISPLAY_P3 = ((0.5151, 0.2412, -0.0011), (0.292, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841))


@pytest.mark.parametrize(("mode", "kind"), [("RGB", "png"), ("RGB", "jpg"), ("RGBA", "png")])
def test_colours_of_a_profile_become_srgb(tmp_path, mode, kind):
    """Phones write the colours of Display P3, whose numbers are smaller than in sRGB."""
    values = np.broadcast_to(np.array([200, 80, 60, 100][: len(mode)], dtype=np.uint8), (16, 16, len(mode)))
    read, profiles = {}, {"none": None, "srgb": write_profile(SRGB), "p3": write_profile(DISPLAY_P3), "bad": b"x"}
    for name, profile in profiles.items():
        Image.fromarray(values).save(tmp_path / f"{name}.{kind}", icc_profile=profile, quality=100)
        read[name] = read_image(tmp_path / f"{name}.{kind}", 2)[3, 3].tolist()
    assert read["none"] == read["srgb"] == read["bad"]
    linear = np.linalg.solve(np.array(SRGB).T, np.array(DISPLAY_P3).T @ to_linear(np.array(read["none"][:3]) / 255))
    expected = 255 * np.where(linear > 0.0031308, 1.055 * linear.clip(0) ** (1 / 2.4) - 0.055, 12.92 * linear)
    assert np.abs(np.array(read["p3"][:3]) - expected.clip(0, 255)).max() <= 3 and read["p3"][0] > 210
    assert read["p3"][3:] == read["none"][3:]
