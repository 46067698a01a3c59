"""Tests of extracting frames from the videos of phones, browsers and other programs."""

import struct
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image

from voronerf.app.render.video import write_video
from voronerf.app.scenes import SceneError, gather

TWO_SIZES = {"large": ("-c:v", "mpeg2video"), "small": ("-vf", "scale=40:32", "-c:v", "mpeg2video")}


def write_clip(path, count, *options):
    """Writes a video of a square that moves from left to right in `count` frames; returns its path."""
    frames = torch.zeros(count, 64, 80, 3, dtype=torch.uint8)
    for number in range(count):
        frames[number, 16:48, number : number + 32] = 220
    write_video(source := path.parent / "made.mp4", frames, 10)
    convert(source, path, *options or ("-c", "copy"))
    source.unlink()
    return path


def convert(source, path, *options, before=()):
    read = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *before, "-i", str(source)]
    subprocess.run([*read, *options, str(path)], check=True)


def steps_of(folder):
    """Returns the square's left edge in each extracted frame, in order."""
    edges = [np.asarray(Image.open(path).convert("L"))[32] > 110 for path in sorted(folder.iterdir())]
    return [int(edge.argmax()) for edge in edges]


@pytest.mark.parametrize(
    ("count", "frames", "taken"),
    [
        (20, 5, [1, 5, 9, 13, 17]),
        (20, 19, [*range(10), *range(11, 20)]),
        (20, 20, range(20)),
        (20, 21, range(20)),
        (7, 150, range(7)),
        (1, 150, [0]),
        (20, 1, [9]),
    ],
)
def test_frames_of_a_video_are_evenly_spread_and_each_is_taken_once(tmp_path, count, frames, taken):
    said = []
    gather._take_frames(write_clip(tmp_path / "a.mp4", count), tmp_path / "frames", frames, said.append)
    assert steps_of(tmp_path / "frames") == list(taken)
    line = f"{tmp_path}/a.mp4: all {count} frames are taken, fewer than --frames {frames}"
    assert said == [line] * (count < frames)


H264, SILENT = ("-c:v", "libx264", "-bf", "2"), ("-f", "lavfi", "-i", "anullsrc=d=9", "-c:v", "copy", "-c:a", "aac")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.webm", ("-c:v", "libvpx", "-f", "webm", "-live", "1")),  # without a duration, as MediaRecorder writes it
        ("a.webm", ("-c:v", "libvpx-vp9", "-b:v", "100k")),
        ("a.mkv", (*H264, "-vf", "setpts='PTS*(1+floor(N/10))'", "-fps_mode", "vfr")),  # variable frame rate
        ("a.mov", SILENT),  # sound longer than the video
        ("a.ts", H264),
        ("a.avi", ("-c:v", "mpeg4", "-bf", "2")),
    ],
)
def test_frames_are_counted_whatever_a_container_says(tmp_path, name, options):
    path = write_clip(tmp_path / name, 20, *options)
    for frames, taken in ((5, [1, 5, 9, 13, 17]), (150, range(20))):
        gather._take_frames(path, tmp_path / "frames", frames, lambda _: None)
        np.testing.assert_allclose(steps_of(tmp_path / "frames"), list(taken), atol=1)


def test_a_wrong_duration_does_not_matter(tmp_path):
    content = write_clip(tmp_path / "a.mkv", 20, *H264).read_bytes()
    place = content.index(b"\x44\x89\x88") + 3  # the segment's duration, a double
    (tmp_path / "b.mkv").write_bytes(content[:place] + struct.pack(">d", 9e6) + content[place + 8 :])
    gather._take_frames(tmp_path / "b.mkv", tmp_path / "frames", 5, lambda _: None)
    assert steps_of(tmp_path / "frames") == [1, 5, 9, 13, 17]


def test_a_video_that_was_cut_without_encoding_has_as_many_frames_as_it_shows(tmp_path):
    whole = write_clip(tmp_path / "a.mp4", 20, *H264)
    convert(whole, path := tmp_path / "cut.mp4", "-c", "copy", before=("-ss", "1.05"))
    for frames, taken in ((3, [12, 15, 18]), (150, range(11, 20))):
        gather._take_frames(path, tmp_path / "frames", frames, lambda _: None)
        assert steps_of(tmp_path / "frames") == list(taken)


def test_sound_with_a_cover_is_no_video(tmp_path):
    Image.new("RGB", (64, 64)).save(tmp_path / "cover.jpg")
    options = ("-f", "lavfi", "-i", "anullsrc=d=1", "-c:v", "copy", "-disposition:v:0", "attached_pic")
    convert(tmp_path / "cover.jpg", path := tmp_path / "a.mp4", *options)
    refuses("must be a video in a supported container", gather._take_frames, path, tmp_path, 5, print, error=SceneError)


def test_times_that_go_back_do_not_matter(tmp_path):
    path = write_clip(tmp_path / "a.mkv", 20, "-c", "copy", "-bsf:v", "setts=pts=if(eq(N\\,9)\\,0\\,PTS):dts=0")
    gather._take_frames(path, tmp_path / "frames", 150, lambda _: None)
    assert steps_of(tmp_path / "frames") == list(range(20))


def test_frames_of_two_sizes_are_counted_on(tmp_path):
    """All frames get the first frame's size; browsers change the frame size when the network is slow."""
    large, small = (write_clip(tmp_path / f"{name}.ts", 20, *options) for name, options in TWO_SIZES.items())
    (tmp_path / "both.ts").write_bytes(large.read_bytes() + small.read_bytes())
    gather._take_frames(tmp_path / "both.ts", tmp_path / "frames", 10, print)
    frames = sorted((tmp_path / "frames").iterdir())
    assert [Image.open(path).size for path in frames] == [(80, 64)] * 10


def test_a_video_becomes_upright_images(tmp_path):
    path, out = write_clip(tmp_path / "a.mp4", 20), tmp_path / "out"
    convert(path, tmp_path / "turned.mp4", "-c", "copy", before=("-display_rotation", "90"))
    gather.gather(tmp_path / "turned.mp4", out, tmp_path / "masks", 5, say=print, progress=lambda *_: None)
    sizes = [Image.open(path).size for path in sorted(out.iterdir())]
    assert sizes == [(64, 80)] * 5
