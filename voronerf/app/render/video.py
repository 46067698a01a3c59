"""Writes pictures as a video."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from torch import Tensor
from torch.nn.functional import pad

#: The filters from RGB to HD video. By default, ffmpeg uses the matrix of BT.601 and stores no tags, so that players
#: assume BT.709 for large videos.
TAGS = "colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=limited"
TO_BT709 = f"scale=out_color_matrix=bt709:out_range=limited,setparams={TAGS}"


def check_video(path: Path) -> None:
    """Checks, before any frame is rendered, that :func:`write_video` can write the file; makes its folder."""
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: a video must end in .mp4")
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise ImportError("writing a video needs imageio-ffmpeg and its ffmpeg: pip install imageio-ffmpeg") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise ValueError(f"{path}: must be a file, got a folder")
    partial = _partial(path)
    partial.unlink(missing_ok=True)  # else touch would follow a link
    partial.touch()
    partial.unlink()


def _partial(path: Path) -> Path:
    return path.absolute().with_name(f".{path.stem}.{os.getpid()}{path.suffix}")  # ffmpeg reads `a:b.mp4` as a protocol


def write_video(path: Path, frames: Iterable[Tensor], fps: float) -> None:
    """Writes an H.264 video that all common players show, atomically; makes its folder.

    Args:
        path: the file, .mp4.
        frames: at least one picture, uint8 [h, w, 3] each; the iterable is read one frame at a time. An odd size is
            padded by a copy of the last row or column, since the format stores colour for pairs of pixels.
        fps: frames a second.
    """
    if fps <= 0:
        raise ValueError(f"write_video: fps must be positive, got {fps}")
    check_video(path)
    import imageio_ffmpeg

    frames = iter(frames)
    first = next(frames, None)
    if first is None or first.dim() != 3 or first.shape[-1] != 3 or 0 in first.shape:
        got = "no frame" if first is None else list(first.shape)
        raise ValueError(f"write_video: frames must have shape [h, w, 3] with pixels, got {got}")
    height, width = first.shape[:2]
    partial = _partial(path)
    try:
        writer = imageio_ffmpeg.write_frames(
            str(partial),
            (width + width % 2, height + height % 2),
            fps=fps,
            macro_block_size=2,
            quality=8,
            ffmpeg_log_level="quiet",
            output_params=["-vf", TO_BT709],
        )
        writer.send(None)
        count = 0
        try:
            for frame in chain((first,), frames):
                even = pad(frame.permute(2, 0, 1)[None], (0, width % 2, 0, height % 2), mode="replicate")[0]
                writer.send(even.permute(1, 2, 0).cpu().contiguous().numpy())
                count += 1
        except OSError:  # its message would be ffmpeg's command and whole output
            raise OSError(f"{path}: ffmpeg could not write it, it ended after {count} frames") from None
        finally:
            writer.close()
        try:  # imageio does not return the exit status of ffmpeg
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(partial))
        except RuntimeError:
            written = 0
        if written != count:
            raise OSError(f"{path}: ffmpeg could not write it, {written} of {count} frames")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
