"""Tests of comparison panels, contact sheets and videos."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image

from voronerf.app.evaluate import panels
from voronerf.app.render.video import check_video, write_video
from voronerf.nerf.renderer import RenderedImage


@pytest.mark.parametrize("count", [0, 1, 2, 16, 256, 5000])
def test_palette_is_distinct_and_stable(count):
    colours = panels.palette(count)
    assert colours.shape == (count, 3) and colours.dtype == torch.uint8
    assert len({tuple(colour) for colour in colours.tolist()}) == count
    assert torch.equal(colours[:2], panels.palette(2)[:count])


def test_the_first_colours_are_far_apart():
    colours = panels.palette(16).float()
    distance = torch.cdist(colours, colours) + 1000 * torch.eye(16)
    assert float(distance.min()) > 30


def test_cells_and_opacity():
    cells = torch.tensor([[0, 3], [1, 3]], dtype=torch.int32)
    opacity = torch.tensor([[1.0, 1.0], [0.5, 0.0]])
    picture = panels.picture_of_cells(cells, opacity)
    colours = panels.palette(4)
    assert torch.equal(picture[0, 0], colours[0]) and torch.equal(picture[0, 1], colours[3])
    assert picture[1, 1].tolist() == [255, 255, 255]
    expected = (colours[1].float() / 2 + 127.5).round()
    assert float((picture[1, 0].float() - expected).abs().max()) <= 1
    shaded = panels.picture_of_cells(cells, torch.ones(2, 2), torch.zeros(2, 2, 3))
    assert (shaded[0, 0] <= (colours[0] * 0.41).round()).all()


def test_depth_and_error():
    depth = torch.linspace(2, 4, 50).reshape(5, 10)
    picture = panels.picture_of_depth(depth, torch.ones(5, 10))
    assert float(picture[0, 0].float().sum()) > float(picture[-1, -1].float().sum())  # near pixels are bright
    empty = panels.picture_of_depth(depth, torch.zeros(5, 10))
    assert (empty == 255).all()
    flat = panels.picture_of_depth(torch.full((3, 3), 2.0), torch.ones(3, 3))
    assert (flat == flat[0, 0]).all()
    black = panels.picture_of_error(torch.rand(3, 3, 3), torch.full((3, 3, 3), float("nan")))
    assert black.shape == (3, 3, 3)
    assert int(panels.picture_of_error(torch.ones(2, 2, 3), torch.ones(2, 2, 3)).max()) < 10


def test_panel_file(tmp_path):
    colour = torch.rand(7, 9, 3)
    path = tmp_path / "new" / "panel.png"
    cells = torch.zeros(7, 9, dtype=torch.int32)
    opacity = torch.ones(7, 9)
    panels.save_panel(path, colour, RenderedImage(colour, opacity, opacity, colour), cells)
    width, height = Image.open(path).size
    zoom = -(-panels.PICTURE_HEIGHT // 7)
    assert (width, height) == (5 * (9 * zoom + 6) + 6, 7 * zoom + 6 + panels.CAPTION + 6)
    strip = torch.zeros(1, 5000, 3, dtype=torch.uint8)  # 240 rows would need 288 million pixels
    assert panels.contact_sheet({"truth": strip}).shape == (6 + panels.CAPTION + 1 + 6, 5000 + 6 + 6, 3)
    pixels = np.asarray(Image.open(path))
    truth = panels.picture_of_colour(colour)
    assert pixels[6 + panels.CAPTION, 6].tolist() == truth[0, 0].tolist()
    refuses("one size", panels.contact_sheet, {"a": truth, "b": truth[1:]})


def test_depths_of_more_pixels_than_torch_takes_quantiles_of(monkeypatch):
    quantile, most = torch.Tensor.quantile, 2**20

    def limited(values, q):
        assert values.numel() <= most, "quantile() input tensor is too large"
        return quantile(values, q)

    monkeypatch.setattr(torch.Tensor, "quantile", limited)
    depth = torch.rand(1100, 1000)
    assert panels.picture_of_depth(depth, torch.ones_like(depth)).shape == (1100, 1000, 3)


def test_a_video_that_ffmpeg_did_not_finish(tmp_path, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames = (torch.rand(3, 16, 16, 3) * 255).to(torch.uint8)
    monkeypatch.chdir(tmp_path)
    path = Path("turn:1.mp4")  # for ffmpeg, the colon of a relative path ends a protocol
    write_video(path, frames, 10)
    before = path.read_bytes()
    write_frames = imageio_ffmpeg.write_frames

    def broken(name, *args, **kwargs):
        writer = write_frames(name, *args, **kwargs)
        yield writer.send(None)
        try:
            while True:
                writer.send((yield))
        finally:
            writer.close()
            Path(name).write_bytes(Path(name).read_bytes()[:200])

    monkeypatch.setattr(imageio_ffmpeg, "write_frames", broken)
    refuses("ffmpeg could not write it, 0 of 3 frames", write_video, path, frames, 10, error=OSError)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_what_no_video_can_be_written_to(tmp_path, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    refuses("turn.avi: a video must end in .mp4", check_video, tmp_path / "turn.avi")
    (tmp_path / "file").write_text("")
    refuses("file", check_video, tmp_path / "file" / "turn.mp4", error=OSError)

    def missing():
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    refuses("imageio-ffmpeg and its ffmpeg", check_video, tmp_path / "turn.mp4", error=ImportError)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_video(tmp_path, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames = (torch.rand(5, 17, 21, 3) * 255).to(torch.uint8)
    path = tmp_path / "deep" / "turn.mp4"
    write_video(path, frames, 10)
    reader = imageio_ffmpeg.read_frames(str(path))
    assert next(reader)["source_size"] == (22, 18)
    assert len(list(reader)) == 5
    assert [entry.name for entry in path.parent.iterdir()] == ["turn.mp4"]
    rule = "frames must have shape [h, w, 3] with pixels, got "
    refuses(rule + "no frame", write_video, path, frames[:0], 10)
    refuses(rule + "[0, 21, 3]", write_video, path, frames[:, :0], 10)
    refuses("fps must be positive, got 0", write_video, path, frames, 0)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refuses("pip install imageio-ffmpeg", write_video, path, frames, 10, error=ImportError)
