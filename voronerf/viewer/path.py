"""Keyframes of a camera path, collected in a browser and saved in the run directory."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from voronerf.rendering.cameras import Cameras
from voronerf.rendering.paths import CameraPath, smooth_path, write_camera_path
from voronerf.viewer.door import chosen

if TYPE_CHECKING:
    from voronerf.viewer.client import Client

FPS = 24


class Keyframes:
    """The keyframes of one browser.

    Args:
        client: whose camera they are of.
        folder: the run directory.
    """

    def __init__(self, client: Client, folder: Path) -> None:
        self.client, self.folder = client, folder
        self.cameras: list[Cameras] = []
        gui = client.handle.gui
        keys = gui.add_button_group("Keyframes", ("add", "undo", "clear"))
        client.on(keys.on_click, lambda: self.edit(keys.value))
        self.state = gui.add_markdown("No keyframes.")
        self.seconds = gui.add_slider("Seconds", 1.0, 60.0, 1.0, 10.0)
        self.closed = gui.add_checkbox("Closed", False, hint="Go back to the first keyframe.")
        self.button = gui.add_button("Save path", disabled=True)
        client.on(self.button.on_click, self.save)

    def edit(self, what: str) -> None:
        """Adds the present camera ("add"), or takes the last keyframe ("undo") or all of them ("clear") away."""
        if what == "add":
            self.cameras.append(self.client.camera(self.client.longest))
        else:
            self.cameras = self.cameras[:-1] if what == "undo" else []
        count = len(self.cameras)
        self.button.disabled = not count
        self.state.content = "No keyframes." if not count else f"{count} keyframe{'s' * (count > 1)}."

    def save(self) -> None:
        """Writes the path as ``camera_paths/path-N.json`` of the run directory, in the size of the sharp picture."""
        keyframes = same_size(self.cameras)
        count = round(chosen(self.seconds) * FPS)
        frames = smooth_path(keyframes, count, closed=self.closed.value)
        folder = self.folder / "camera_paths"
        number = 1
        while (file := folder / f"path-{number}.json").exists():
            number += 1
        try:
            write_camera_path(file, CameraPath(frames, FPS, keyframes, self.closed.value))
        except OSError as error:
            self.client.handle.add_notification("Path not saved", str(error), color="red")
            return
        command = f"voronerf render {shlex.quote(str(self.folder))} --path {shlex.quote(str(file))}"
        self.client.handle.add_notification("Path saved", f"Render it with: {command}")


def same_size(cameras: list[Cameras]) -> Cameras:
    """Cameras in the size of the last one, made even for a video, each with its vertical angle of view."""
    width, height = (max(2, side // 2 * 2) for side in (cameras[-1].width, cameras[-1].height))
    focal = torch.stack([camera.intrinsics[0, 1] * (height / camera.height) for camera in cameras])
    middle = torch.tensor((width / 2, height / 2)).repeat(len(cameras), 1)
    intrinsics = torch.cat((focal[:, None], focal[:, None], middle), dim=1)
    return Cameras(torch.cat([camera.poses for camera in cameras]), intrinsics, width, height)
