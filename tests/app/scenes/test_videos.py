"""Tests of extracting frames from the videos of phones, browsers and other programs."""

import functools
import struct
import subprocess
import tempfile
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image

from voronerf.app.render.video import write_video
from voronerf.app.scenes import SceneError, gather


@functools.cache
def clip(count):
    """Returns the bytes of a video of a square that moves from left to right in `count` frames."""
    frames = torch.zeros(count, 64, 80, 3, dtype=torch.uint8)
    for number in range(count):
        frames[number, 16:48, number : number + 32] = 220
    with tempfile.TemporaryDirectory() as folder:
        write_video(Path(folder, "a.mp4"), frames, 10)
        return Path(folder, "a.mp4").read_bytes()


def write_clip(path, count, *options):
    """Writes a video of a moving square, converted by ffmpeg's `options`; returns its path."""
    source = path.parent / "made.mp4" if options else path
    source.write_bytes(clip(count))
    if options:
        convert(source, path, *options)
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
        (1, 150, [0]),
        (20, 1, [9]),
    ],
)
def test_frames_of_a_video_are_evenly_spread_and_each_is_taken_once(tmp_path, count, frames, taken):
    said = []
    gather._take_frames(write_clip(tmp_path / "a 5%.mp4", count), tmp_path / "100%d", frames, said.append)
    assert steps_of(tmp_path / "100%d") == list(taken)
    line = f"{tmp_path}/a 5%.mp4: all {count} frames are taken, fewer than --frames {frames}"
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
        ("a.mkv", ("-c", "copy", "-bsf:v", "setts=pts=if(eq(N\\,9)\\,0\\,PTS):dts=0")),  # times that go back
    ],
)
def test_frames_are_counted_whatever_a_container_says(tmp_path, name, options):
    path = write_clip(tmp_path / name, 20, *options)
    for frames, taken in ((5, [1, 5, 9, 13, 17]), (150, range(20))):
        gather._take_frames(path, tmp_path / "frames", frames, lambda _: None)
        np.testing.assert_allclose(steps_of(tmp_path / "frames"), list(taken), atol=int("copy" not in options))


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
    refuses("it has no moving pictures", gather._take_frames, path, tmp_path / "out", 5, print, error=SceneError)


def test_frames_of_two_sizes_are_counted_on(tmp_path):
    """All frames get the first frame's size; browsers change the frame size when the network is slow."""
    large = write_clip(tmp_path / "large.ts", 20, "-c:v", "mpeg2video")
    small = write_clip(tmp_path / "small.ts", 20, "-c:v", "mpeg2video", "-vf", "scale=40:32")
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


COLOURS = ((220, 30, 30), (30, 200, 40), (40, 60, 220), (230, 220, 40), (128, 128, 128), (235, 235, 235))
TAGGED = "format=yuv444p,setparams=colorspace=bt709:color_primaries=bt709:color_trc={}"
HD = f"scale=out_color_matrix=bt709,{TAGGED.format('bt709')},format=yuv420p"
LINEAR = f"scale=out_color_matrix=bt709,{TAGGED.format('iec61966-2-1')},zscale=t=linear:npl=203,format=gbrpf32le"
HLG, PQ = (
    f"{LINEAR},zscale=p=2020,zscale=t={curve}:m=2020_ncl:npl=203{more},format=yuv420p10le"
    for curve, more in (("arib-std-b67", ":agamma=false"), ("smpte2084", ""))
)


def chart(width=240, height=80):
    """Returns stripes of `COLOURS`, [height, width, 3]."""
    return np.repeat(np.array(COLOURS, dtype=np.uint8), width // len(COLOURS), 0)[None].repeat(height, 0)


def encoded(folder, filters, *options, codec="libx264", picture=None, frames=2):
    """Writes a video of a picture, by default the chart, after ffmpeg's filters; returns its path."""
    Image.fromarray(chart() if picture is None else picture).save(folder / "chart.png")
    options = ("-vf", filters, "-frames:v", str(frames), "-c:v", codec, "-crf", "8", *options)
    convert(folder / "chart.png", path := folder / "a.mkv", *options, before=("-loop", "1"))
    return path


def taken_from(path, **options):
    """Returns (the first frame of a video, the lines about it)."""
    said = []
    gather._take_frames(path, path.parent / "frames", 1, said.append)
    with Image.open(next((path.parent / "frames").iterdir())) as image:
        return np.asarray(image.convert("RGB")), " ".join(said)


@pytest.mark.parametrize(
    ("filters", "line"),
    [
        ("scale=out_color_matrix=bt601,format=yuv420p", ""),
        (HD, ""),
        ("scale=out_color_matrix=bt709:out_range=full,format=yuvj420p,setparams=colorspace=bt709:range=full", ""),
        ("scale=out_color_matrix=bt601:out_range=full,format=yuvj420p,setparams=range=full", ""),
        (f"{HD},zscale=p=2020:m=2020_ncl,format=yuv420p10le", "bt2020, which are converted to sRGB"),
        (f"{HD},zscale=p=smpte432,format=yuv420p10le", "smpte432, which are converted to sRGB"),
        (HLG, "is HDR (HLG) and is tone-mapped to sRGB"),
        (PQ, "is HDR (PQ) and is tone-mapped to sRGB"),
        (f"{HLG},setparams=color_trc=unknown", "HLG is assumed, by its brightness; is HDR (HLG) and is tone-mapped"),
        (f"{PQ},setparams=color_trc=unknown", "PQ is assumed, by its brightness; is HDR (PQ) and is tone-mapped"),
        (f"{HD},setfield=tff,setparams=field_mode=tff", "is interlaced: one of two lines is interpolated"),
    ],
)
def test_frames_have_the_colours_of_the_video(tmp_path, filters, line):
    interlaced = ("-flags", "+ilme+ildct", "-x264-params", "tff=1") if "tff" in filters else ()
    image, said = taken_from(encoded(tmp_path, filters, *interlaced))
    middles = image[40, 20::40].astype(int)
    assert np.abs(middles - COLOURS).max() <= 8, middles.tolist()
    assert line in said and bool(line) == ("a.mkv: " in said.replace("all 2 frames", ""))


@pytest.mark.parametrize(
    ("tags", "line"),
    [
        ("color_primaries=smpte432:color_trc=bt1361e", "has colours of smpte432"),
        ("color_primaries=bt2020", "has colours of bt2020"),
        ("color_trc=smpte2084:colorspace=bt709", "is HDR (PQ)"),
        ("color_trc=arib-std-b67", "is HDR (HLG)"),
    ],
)
def test_incomplete_tags_of_wide_colours(tmp_path, tags, line):
    Image.fromarray(chart(234, 79)[:, :233]).save(tmp_path / "chart.png")
    convert(tmp_path / "chart.png", tmp_path / "a.mkv", "-vf", f"format=yuv420p10le,setparams={tags}", "-c:v", "ffv1")
    image, said = taken_from(tmp_path / "a.mkv")
    assert image.shape == (79, 233, 3) and line in said


def test_large_videos_without_tags_have_the_colours_of_hd(tmp_path):
    filters = "scale=1280:720:flags=neighbor:out_color_matrix=bt709,format=yuv420p,setparams=colorspace=unknown"
    image, said = taken_from(encoded(tmp_path, filters))
    assert np.abs(image[360, 107::213].astype(int)[:6] - COLOURS).max() <= 5
    assert "has no colour tags: those of HD video (bt709) are assumed" in said


@pytest.mark.parametrize(("aspect", "size"), [("4/3", (320, 80)), ("1/2", (240, 160)), ("1/1", (240, 80))])
def test_pixels_become_square(tmp_path, aspect, size):
    path = encoded(tmp_path, f"format=yuv420p,setsar={aspect}")
    for turned in (False, True):
        image, said = taken_from(path)
        assert image.shape[1::-1] == (size[::-1] if turned else size)
        assert (f"its frames become {image.shape[1]} x {image.shape[0]}" in said) == (aspect != "1/1")
        convert(path, path := tmp_path / "turned.mp4", "-c", "copy", before=("-display_rotation", "90"))


def test_videos_that_are_written_have_the_colours_of_hd(tmp_path):
    pictures = torch.from_numpy(chart(1284, 720))
    write_video(tmp_path / "a.mp4", [pictures] * 2, 24)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(tmp_path / "a.mp4")]
    assert "yuv420p(tv, bt709, " in subprocess.run(command, capture_output=True, text=True, check=False).stderr
    convert(tmp_path / "a.mp4", tmp_path / "a.png", "-vf", "scale=in_color_matrix=bt709", "-frames:v", "1")
    shown = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert np.abs(shown[360, 107::214] - COLOURS).max() <= 4


def test_several_videos_share_the_frames_by_their_lengths(tmp_path):
    (tmp_path / "in").mkdir()
    paths = [write_clip(tmp_path / "in/GX02.MP4", 20), write_clip(tmp_path / "in/GX01.MP4", 5, "-vf", "hflip")]
    said = []
    out, options = tmp_path / "frames", {"say": said.append, "progress": lambda *_: None}
    places = gather.gather(paths, out.with_name("a"), tmp_path / "masks", 5, **options)
    first = {f"1_0000{n}.jpg": "video 1, GX02.MP4" for n in range(1, 5)}
    assert places == {**first, "2_00001.jpg": "video 2, GX01.MP4"}
    assert steps_of(out.with_name("a")) == [2, 7, 12, 17, 46] and not said
    (tmp_path / "in/GX01.THM").write_bytes(b"")
    assert len(gather.gather(tmp_path / "in", out, tmp_path / "masks", 150, **options)) == 25
    assert steps_of(out) == [*range(48, 43, -1), *range(20)]  # in the order of names
    assert said == [
        f"{tmp_path}/in: has no images; frames are taken from GX01.MP4, GX02.MP4",
        f"{tmp_path}/in/GX01.MP4, {tmp_path}/in/GX02.MP4: all 25 frames are taken, fewer than --frames 150",
    ]


def test_the_cause_is_told_if_frames_cannot_be_written(tmp_path, monkeypatch):
    path, ran = write_clip(tmp_path / "a.mp4", 5), gather._run_ffmpeg

    def run(video, options):
        done = ran(video, options)
        if "-filter_complex" in options:
            errors = "[out#1/image2 @ 0x1] Error writing: No space left on device\nConversion failed!\n"
            return subprocess.CompletedProcess(done.args, 228, done.stdout, errors)
        return done

    monkeypatch.setattr(gather, "_run_ffmpeg", run)
    line = "ffmpeg cannot write its frames to {}: Error writing: No space left on device".format(tmp_path / "out")
    refuses(line, gather._take_frames, path, tmp_path / "out", 5, print, error=SceneError)
