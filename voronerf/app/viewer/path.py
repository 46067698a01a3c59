"""Keyframes of a camera path: collected in a browser, drawn, dragged, played, and kept in the run directory."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from viser.transforms import SO3

from voronerf.app.render.paths import CameraPath, read_camera_path, smooth_path, write_camera_path
from voronerf.app.viewer.cameras import FLIP, scene_bounds
from voronerf.app.viewer.door import chosen
from voronerf.nerf.cameras import Cameras

if TYPE_CHECKING:
    from voronerf.app.viewer.client import Client

FPS = 24
#: Keyframes that are made of a path without any, and those of one browser at the most.
FEW, MOST = 12, 500
#: Size of a keyframe as a share of the scene's diagonal, and points of the line through all.
SIZE, POINTS = 0.04, 200
NOTHING = "-"


class Keyframes:
    """The keyframes of one browser.

    Args:
        client: whose camera they are of.
        folder: the run directory.
    """

    def __init__(self, client: Client, folder: Path) -> None:
        self.client, self.folder = client, folder
        self.cameras: list[Cameras] = []
        self.selected: int | None = None
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
        self.files = gui.add_dropdown("Load path", self.list_files(), hint="Of the folder camera_paths of the run.")
        client.on(self.files.on_update, lambda: self.load(chosen(self.files)))

    def list_files(self) -> tuple[str, ...]:
        """What can be loaded."""
        return (NOTHING, *sorted(file.name for file in (self.folder / "camera_paths").glob("*.json")))

    def edit(self, what: str) -> None:
        """Adds the present camera ("add"), or takes the last keyframe ("undo") or all of them ("clear") away."""
        if what == "add":
            self.cameras = [*self.cameras, self.client.camera(self.client.longest)][:MOST]
        else:
            self.cameras = self.cameras[:-1] if what == "undo" else []
        self.selected = None
        self.draw()

    def frames(self) -> CameraPath:
        """The smooth path, in the size of the sharp picture."""
        keyframes = same_size(self.cameras)
        count = round(chosen(self.seconds) * FPS)
        return CameraPath(
            smooth_path(keyframes, count, closed=self.closed.value), FPS, keyframes, bool(self.closed.value)
        )

    # --- what is drawn ---------------------------------------------------------------------------------------------

    def draw(self) -> None:
        """Draws the keyframes, the line through them, and arrows at the one that is selected."""
        client, count = self.client, len(self.cameras)
        self.button.disabled = self.play.disabled = not count
        self.state.content = "No keyframes." if not count else f"{count} keyframe{'s' * (count > 1)}; click on one."
        client.clear("keyframes")
        low, high = scene_bounds(client.viewer.subject.scene)
        size = SIZE * float((high - low).norm())
        scene, nodes = client.handle.scene, []
        with client.handle.atomic():
            for number, camera in enumerate(self.cameras):
                wxyz, place = pose_of(camera)
                node: Any = scene.add_camera_frustum(
                    f"/keyframes/{number}",
                    fov=2 * float(torch.atan(camera.height / 2 / camera.intrinsics[0, 1])),
                    aspect=camera.width / camera.height,
                    scale=size,
                    color=(0, 137, 123) if number == self.selected else (90, 90, 90),
                    wxyz=wxyz,
                    position=place,
                )
                client.on(node.on_click, partial(self.select, number))
                nodes.append(node)
            if count > 1:
                line = smooth_path(same_size(self.cameras), POINTS, closed=bool(self.closed.value)).origins.numpy()
                points = np.stack((line[:-1], line[1:]), 1)
                nodes.append(
                    scene.add_line_segments(
                        "/keyframes/line", points, colors=(0, 137, 123), thickness=2.0, thickness_units="screen"
                    )
                )
            if self.selected is not None:
                wxyz, place = pose_of(self.cameras[self.selected])
                arrows: Any = scene.add_transform_controls(
                    "/keyframes/arrows", 2.5 * size, depth_test=False, wxyz=wxyz, position=place
                )

                async def moved(event: Any) -> None:
                    work = partial(self.drag, arrows.wxyz, arrows.position, event.phase == "end")
                    client.viewer.serve_client(client, work)

                arrows.on_update(moved)
                nodes.append(arrows)
        client.nodes["keyframes"] = nodes
        client.change()

    def select(self, number: int) -> None:
        """Puts arrows at a keyframe, or takes them away from it."""
        self.selected = None if self.selected == number or number >= len(self.cameras) else number
        self.draw()

    def drag(self, wxyz: Any, place: Any, done: bool) -> None:
        """Moves and turns the selected keyframe.

        Raises:
            ValueError: a page of the viewer cannot have sent the pose.
        """
        wxyz, place = np.asarray(wxyz, dtype=np.float64), np.asarray(place, dtype=np.float64)
        there = wxyz.shape == (4,) and place.shape == (3,) and 0.5 < np.linalg.norm(wxyz) < 2
        if not there or not (np.abs(place) < 1e9).all():
            raise ValueError(f"a keyframe cannot be at {place}, turned by {wxyz}")
        if self.selected is None:
            return
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = SO3(wxyz / np.linalg.norm(wxyz)).as_matrix() @ FLIP, place
        camera = self.cameras[self.selected]
        self.cameras[self.selected] = replace(camera, poses=torch.from_numpy(pose).float()[None])
        if done:
            self.draw()
            return
        node = self.client.nodes["keyframes"][self.selected]
        node.wxyz, node.position = wxyz, place

    def preview(self) -> None:
        """Flies along the path in the time that it takes; other browsers are served meanwhile."""
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

    # --- files -----------------------------------------------------------------------------------------------------

    def load(self, name: str) -> None:
        """Takes the keyframes of a file; of one that has frames only, some of those."""
        if name == NOTHING:
            return
        try:
            path = read_camera_path(self.folder / "camera_paths" / name)
        except (ValueError, OSError) as error:
            self.client.tell("Path not loaded", str(error))
            return
        keyframes = path.keyframes
        if keyframes is None:
            count = min(FEW, len(path.frames))
            keyframes = path.frames[torch.linspace(0, len(path.frames) - 1, count).round().long()]
        self.cameras, self.selected = [keyframes[[number]] for number in range(min(len(keyframes), MOST))], None
        self.seconds.value = min(max(round(len(path.frames) / path.fps), 1.0), 60.0)  # type: ignore[misc]
        self.closed.value = path.closed  # type: ignore[misc]
        self.draw()

    def save(self) -> None:
        """Writes the path as ``camera_paths/path-N.json`` of the run directory, in the size of the sharp picture."""
        folder = self.folder / "camera_paths"
        number = 1
        while (file := folder / f"path-{number}.json").exists():
            number += 1
        try:
            write_camera_path(file, self.frames())
        except OSError as error:
            self.client.tell("Path not saved", str(error))
            return
        self.files.options = self.list_files()
        command = f"voronerf render {shlex.quote(str(self.folder))} --path {shlex.quote(str(file))}"
        self.client.tell("Path saved", f"Render it with: {command}")


def pose_of(camera: Cameras) -> tuple[Any, Any]:
    """The quaternion and the position of a camera in viser's axes."""
    pose = camera.poses[0].double().numpy()
    return SO3.from_matrix(pose[:3, :3] @ FLIP).wxyz, pose[:3, 3]


def same_size(cameras: list[Cameras]) -> Cameras:
    """Cameras in the size of the last one, made even for a video, each with its vertical angle of view."""
    width, height = (max(2, side // 2 * 2) for side in (cameras[-1].width, cameras[-1].height))
    focal = torch.stack([camera.intrinsics[0, 1] * (height / camera.height) for camera in cameras])
    middle = torch.tensor((width / 2, height / 2)).repeat(len(cameras), 1)
    intrinsics = torch.cat((focal[:, None], focal[:, None], middle), dim=1)
    return Cameras(torch.cat([camera.poses for camera in cameras]), intrinsics, width, height)
