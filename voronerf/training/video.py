"""Pictures to a video file."""

from __future__ import annotations

import os
from pathlib import Path

from torch import Tensor
from torch.nn.functional import pad


def write_video(path: Path, frames: Tensor, fps: float) -> None:
    """Writes an H.264 video that players everywhere show; makes its folder. The file appears when it is complete.

    Args:
        path: the file, its suffix a container that ffmpeg knows, such as .mp4.
        frames: uint8 [f, h, w, 3], at least one. An odd size is padded by a copy of its last row or column, since the
            format stores colour for pairs of pixels.
        fps: frames a second.

    Raises:
        ValueError: shape or rate.
        ImportError: imageio-ffmpeg is not installed.
        OSError: ffmpeg cannot write the file.
    """
    if frames.dim() != 4 or frames.shape[-1] != 3 or 0 in frames.shape:
        raise ValueError(f"write_video: frames must have shape [f, h, w, 3] with pixels, got {list(frames.shape)}")
    if fps <= 0:
        raise ValueError(f"write_video: fps must be positive, got {fps}")
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ImportError("writing a video needs imageio-ffmpeg: pip install imageio-ffmpeg") from None
    height, width = frames.shape[1:3]
    even = pad(frames.permute(0, 3, 1, 2), (0, width % 2, 0, height % 2), mode="replicate").permute(0, 2, 3, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        writer = imageio_ffmpeg.write_frames(
            str(partial),
            (even.shape[2], even.shape[1]),
            fps=fps,
            macro_block_size=2,
            quality=8,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        for frame in even:
            writer.send(frame.cpu().contiguous().numpy())
        writer.close()
        if not partial.is_file() or partial.stat().st_size == 0:
            raise OSError(f"{path}: ffmpeg could not write it")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
