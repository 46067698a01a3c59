"""Keyframes of a camera path: collected in a browser, drawn, played, and saved in the run directory."""

from __future__ import annotations

import shlex
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from voronerf.app.render.paths import CameraPath, smooth_path, write_camera_path
from voronerf.app.viewer.cameras import frustum, scene_bounds
from voronerf.app.viewer.door import chosen
from voronerf.nerf.cameras import Cameras

if TYPE_CHECKING:
    from voronerf.app.viewer.client import Client

FPS = 24
#: Greatest number of keyframes of one browser.
MOST = 500
#: Size of a drawn keyframe as a fraction of the scene's diagonal; number of points of the line through the keyframes.
SIZE, POINTS = 0.04, 200


class Keyframes:
    """The keyframes of one browser's camera."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.cameras: list[Cameras] = []
        gui = client.handle.gui
        keys = gui.add_button_group("Keyframes", ("add", "undo", "clear"))
        client.on(keys.on_click, lambda: self.edit(keys.value))
        self.state = gui.add_markdown("No keyframes.")
        self.seconds = gui.add_slider("Seconds", 1.0, 60.0, 1.0, 10.0)
        self.closed = gui.add_checkbox("Closed", False, hint="Go back to the first keyframe.")
        client.on(self.closed.on_update, self.draw)
        self.play = gui.add_button("Preview", disabled=True)
        client.on(
            self.play.on_click, lambda: client.viewer.do(lambda: client.viewer.serve_client(client, self.preview))
        )
        self.button = gui.add_button("Save path", disabled=True)
        client.on(self.button.on_click, self.save)

    def edit(self, action: str) -> None:
        """Adds the current camera ("add"), or removes the last keyframe ("undo") or all keyframes ("clear")."""
        if action == "add":
            self.cameras = [*self.cameras, self.client.camera(self.client.longest)][:MOST]
        else:
            self.cameras = self.cameras[:-1] if action == "undo" else []
        self.draw()

    def draw(self) -> None:
        """Draws the keyframes and the line through them."""
        client, count = self.client, len(self.cameras)
        self.button.disabled = self.play.disabled = not count
        self.state.content = "No keyframes." if not count else f"{count} keyframe{'s' * (count > 1)}"
        client.clear("keyframes")
        low, high = scene_bounds(client.viewer.subject.scene)
        scene, nodes = client.handle.scene, list[Any]()
        with client.handle.atomic():
            for number, camera in enumerate(self.cameras):
                name, size = f"/keyframes/{number}", SIZE * float((high - low).norm())
                # Lines of a thickness in scene units would cover the picture when the camera is at the keyframe.
                node = scene.add_camera_frustum(
                    name,
                    scale=size,
                    color=(90, 90, 90),
                    thickness=1.5,
                    thickness_units="screen",
                    **frustum(camera, 0),
                )
                nodes.append(node)
            if count > 1:
                line = smooth_path(same_size(self.cameras), POINTS, closed=bool(self.closed.value)).origins.numpy()
                points = np.stack((line[:-1], line[1:]), 1)
                nodes.append(
                    scene.add_line_segments(
                        "/keyframes/line", points, colors=(0, 137, 123), thickness=2.0, thickness_units="screen"
                    )
                )
        client.nodes["keyframes"] = nodes
        client.change()

    def frames(self) -> CameraPath:
        """Returns the smooth path, with frames of the last keyframe's size."""
        keyframes, closed = same_size(self.cameras), bool(self.closed.value)
        count = round(chosen(self.seconds) * FPS)
        return CameraPath(smooth_path(keyframes, count, closed=closed), FPS, keyframes, closed)

    def preview(self) -> None:
        """Moves the camera along the path in real time; serves other browsers meanwhile."""
        if not self.cameras:
            return
        viewer, frames, started = self.client.viewer, self.frames().frames, time.perf_counter()
        while (number := int((time.perf_counter() - started) * FPS)) < len(frames):
            if self.client.handle.client_id not in viewer.clients:
                return
            self.client.stand(frames, number)
            while time.perf_counter() < started + (number + 1) / FPS:
                if not viewer.render_next():
                    time.sleep(0.002)
        self.client.stand(frames, len(frames) - 1)

    def save(self) -> None:
        """Writes the path as ``camera_paths/path-N.json`` of the run directory."""
        run = self.client.viewer.subject.folder
        numbers = range(1, 10_000)
        file = next(path for n in numbers if not (path := run / "camera_paths" / f"path-{n}.json").exists())
        try:
            write_camera_path(file, self.frames())
        except OSError as error:
            self.client.tell("Path not saved", str(error))
            return
        command = f"voronerf render {shlex.quote(str(run))} --path {shlex.quote(str(file))}"
        self.client.tell("Path saved", f"Render it with: {command}")


def same_size(cameras: list[Cameras]) -> Cameras:
    """Resizes cameras to the last camera's size, made even for a video; keeps vertical angles of view."""
    width, height = (max(2, side // 2 * 2) for side in (cameras[-1].width, cameras[-1].height))
    focal = torch.stack([camera.intrinsics[0, 1] * (height / camera.height) for camera in cameras])
    middle = focal.new_tensor((width / 2, height / 2)).repeat(len(cameras), 1)
    intrinsics = torch.cat((focal[:, None], focal[:, None], middle), dim=1)
    return Cameras(torch.cat([camera.poses for camera in cameras]), intrinsics, width, height)
