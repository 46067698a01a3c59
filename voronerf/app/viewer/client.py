"""A browser that is connected to the viewer: its camera, the pictures it needs, and its panel."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import viser
from viser.transforms import SO3
from viser.uplot import Scale, Series

from voronerf.app.evaluate.panels import palette
from voronerf.app.viewer.cameras import angle_of_view, frustum, look_point, make_camera, scene_bounds
from voronerf.app.viewer.crop import CropBox
from voronerf.app.viewer.door import chosen
from voronerf.app.viewer.path import Keyframes
from voronerf.app.viewer.pictures import BACKGROUNDS, PANES, Look, cell_at, describe_cell, groups_of
from voronerf.nerf.cameras import Cameras

if TYPE_CHECKING:
    from voronerf.app.viewer.viewer import Viewer

#: Pixels along the longer side of the sharp picture: minimum and maximum if the side follows the window's size, and the
#: largest number that the user can choose.
SHARP, FULL, LARGEST = 512, 1536, 2048
#: Greatest number of training views that are drawn, and pixels along the longer side of their pictures.
MOST_VIEWS, THUMBNAIL = 200, 96
#: The smallest and the largest vertical angle of view in degrees.
NARROWEST, WIDEST = 5, 120
NO_CELL = "Click or tap a cell."
MOUSE = "Drag: turn. Right drag or two fingers: move. Scroll or pinch: zoom. Click or tap: name the cell."
#: Seconds without a movement after which the frame rate is measured anew, and seconds between updates of the shown
#: rate.
PAUSE, SAY = 0.5, 0.25
OWN_GPU = "[Draw it in this browser](/scene.html) with WebGPU: movements then need no pictures from the server."
#: Padding of the curve in pixels: top, right, bottom, left. Without it the labels are cut off.
PADDING = (14, 14, 0, 0)


def shown_angle(fov: float) -> int:
    """Converts an angle of view in radians to the degrees that the panel shows."""
    return min(max(round(math.degrees(fov)), NARROWEST), WIDEST)


class Client:
    """A browser that is connected to the viewer.

    Attributes:
        camera: Function from a number of pixels along the picture's longer side to the browser's camera.
        aspect: Width over height of the canvas.
        fov: The vertical angle of view in radians.
        look: The choices in the panel.
        longest: Pixels along the longer side of the sharp picture.
        follows: Whether `longest` follows the window's size (False once the user has set it).
        opened: Whether an angle of view has been chosen for the canvas.
        degrees: The angle of view that the panel shows.
        version: The number of changes of the picture.
        moved_at: The time of the last change.
        wants_coarse: Whether the browser needs a coarse picture.
        wants_sharp: Whether the browser needs a sharp picture once the camera rests.
        drawn_at: The time when the last sharp picture was done.
        cost: Seconds that the last sharp picture took.
        state: The line about the picture in the panel.
        panel: The folder of all controls: closed on a canvas that is higher than wide, elsewhere without a header.
    """

    def __init__(self, handle: viser.ClientHandle, viewer: Viewer) -> None:
        self.handle, self.viewer = handle, viewer
        self.longest, self.follows, self.opened = SHARP, True, False
        self.times: deque[float] = deque(maxlen=20)  # times of the last coarse pictures
        self.said_at = 0.0
        self.version, self.moved_at, self.drawn_at, self.cost = 0, 0.0, 0.0, 0.0
        self.wants_coarse = self.wants_sharp = True
        start = viewer.server.initial_camera
        self.aspect, self.fov = 1.0, start.fov
        self.camera: Callable[[int], Cameras] = partial(make_camera, np.eye(3), start.position, start.fov, 1.0)
        self._look_around()
        self._start()
        handle.camera.on_update(self._moved)
        self._follow()  # the camera may have moved before `on_update`
        handle.scene.on_click()(self._clicked)

    def _start(self) -> None:
        scene, diagram = self.viewer.subject.scene, self.viewer.subject.diagram
        self.look = Look(level=diagram.depth, background="black" if scene.background is None else "white")
        self.nodes: dict[str, list[Any]] = {kind: [] for kind in ("centres", "cameras", "crop", "keyframes")}
        self.curve: viser.GuiUplotHandle | None = None
        # viser always opens the sheet of a phone, which would hide half of the picture.
        self.panel = self.handle.gui.add_folder("Settings" if self.aspect < 1 else None, expand_by_default=False)
        with self.panel:
            self._build()
        self.draw_curve()

    def on_subject(self) -> None:
        """Shows another subject, from its first test view."""
        for kind in self.nodes:
            self.clear(kind)
        self.handle.gui.reset()
        self._start()
        self.stand(self.viewer.subject.scene.test.cameras, 0)
        self.change()

    def tell(self, title: str, body: str) -> None:
        """Shows a notification for a few seconds."""
        self.handle.add_notification(title, body, auto_close_seconds=15.0)

    # --- camera ----------------------------------------------------------------------------------------------------

    @property
    def shows_nodes(self) -> bool:
        """True if centres, cameras, a crop box or keyframes are drawn into the scene."""
        return any(self.nodes.values())

    async def _moved(self, _: object) -> None:
        self.viewer.serve_client(self, self._follow)
        self.change()

    def _follow(self) -> None:
        """Reads the browser's camera; sets the angle of view of a new browser to show the whole first test view.

        A slow page first reports viser's default angle of view, and applies the server's angle later. A reconnected
        page keeps its angle.
        """
        is_valid = self._look_around()
        if is_valid and not self.opened and math.isclose(self.fov, self.viewer.server.initial_camera.fov, rel_tol=1e-3):
            self._open(angle_of_view(self.viewer.subject.scene.test.cameras, 0, self.aspect))

    def _look_around(self) -> bool:
        """Reads the browser's camera; if canvas size or camera is invalid, keeps the old camera and returns False."""
        now = self.handle.camera
        numbers = (*now.wxyz, *now.position, now.fov)
        is_shown = min(now.image_width, now.image_height) > 0 and np.any(now.wxyz)
        if not is_shown or not np.isfinite(numbers).all() or not 0 < now.fov < math.pi:
            return False
        self.aspect, self.fov = now.aspect, now.fov
        if self.follows:
            self.longest = int(min(max(SHARP, now.image_width, now.image_height), FULL))
        self.camera = partial(make_camera, SO3(now.wxyz).as_matrix(), now.position, now.fov, now.aspect)
        return True

    def change(self, **look: Any) -> None:
        """Replaces the fields ``look`` of the browser's `Look`, and requests new pictures."""
        self.look = replace(self.look, **look)
        self.version += 1
        if time.perf_counter() - self.moved_at > PAUSE:
            self.times = deque(maxlen=20)
        self.moved_at = time.perf_counter()
        self.wants_coarse = self.wants_sharp = True
        self.viewer.wake.set()

    def on_diagram(self) -> None:
        """Resets the level and the choice of cells after a split, which renumbers the cells."""
        depth = self.viewer.subject.diagram.depth
        self.level.max, self.level.visible = max(depth, 2), depth > 1
        self.level.value = depth  # type: ignore[misc]
        self.info.content = NO_CELL
        if self.nodes["centres"]:
            self._show_centres(True)
        self.change(level=depth, hidden=frozenset(), picked=None)

    def stand(self, cameras: Cameras, view: int) -> None:
        """Moves the browser's camera to one of several cameras."""
        target = frustum(cameras, view)
        with self.handle.atomic():
            self.handle.camera.position = target["position"]
            self.handle.camera.look_at = look_point(self.viewer.subject.scene, cameras, view).numpy()
            self.handle.camera.up_direction = cameras.poses[view, :3, 1].double().numpy()
            self._open(angle_of_view(cameras, view, self.aspect))

    def _open(self, fov: float) -> None:
        """Sets the vertical angle of view, in radians, and shows it in the panel."""
        self.opened = True
        self.handle.camera.fov = fov
        self.degrees = shown_angle(fov)
        self.angle.value = self.degrees  # type: ignore[misc]

    def _choose_angle(self, degrees: int) -> None:
        if degrees != self.degrees:  # equal after `_open`, which has set both
            self.opened, self.degrees = True, degrees
            self.handle.camera.fov = math.radians(degrees)
        self._look_around()
        self.change()

    def count_picture(self, camera: Cameras) -> None:
        """Counts a coarse picture, and shows the frame rate while the camera moves."""
        times, now = self.times, time.perf_counter()  # another thread may replace `self.times`
        times.append(now)
        if len(times) > 1 and now - self.said_at > SAY:
            rate = (len(times) - 1) / (now - times[0])
            self.state.content = f"rendering {camera.width} x {camera.height} pixels, {rate:.0f} frames a second"
            self.said_at = now

    # --- the panel -------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, depth = self.handle.gui, self.viewer.subject.diagram.depth
        gui.add_markdown(MOUSE)
        if self.viewer.page is not None:
            gui.add_markdown(OWN_GPU)
        self.state = gui.add_markdown("rendering")
        pane = gui.add_dropdown("Show", PANES, initial_value="colour", hint="What each pixel shows.")
        self.on(pane.on_update, lambda: self.change(pane=chosen(pane)))
        hint = "Pixels along the longer side of the sharp picture; at first the window's size."
        size = gui.add_slider("Pixels", 128, LARGEST, 1, self.longest, hint=hint)
        self.on(size.on_update, lambda: self._resize(chosen(size)))
        self.degrees, hint = shown_angle(self.fov), "Top to bottom, in degrees."
        self.angle = gui.add_slider("Field of view", NARROWEST, WIDEST, 1, self.degrees, hint=hint)
        self.on(self.angle.on_update, lambda: self._choose_angle(chosen(self.angle)))
        behind = gui.add_dropdown("Background", tuple(BACKGROUNDS), initial_value=self.look.background)
        self.on(behind.on_update, lambda: self.change(background=chosen(behind)))
        with gui.add_folder("Cells"):
            self.level = gui.add_slider("Level", 1, max(depth, 2), 1, depth, visible=depth > 1)
            self.on(self.level.on_update, lambda: self.change(level=chosen(self.level)))
            self.info = gui.add_markdown(NO_CELL)
            hide = gui.add_button_group("Cell", ("hide", "only this", "show all"))
            self.on(hide.on_click, lambda: self._hide(hide.value))
        with gui.add_folder("Scene", expand_by_default=False):
            centres = gui.add_checkbox("Centres", False)
            self.on(centres.on_update, lambda: self._show_centres(centres.value))
            cameras = gui.add_checkbox("Cameras", False, hint="The training views; click on one to stand there.")
            self.on(cameras.on_update, lambda: self._show_cameras(cameras.value))
            self.crop = CropBox(self)
        with gui.add_folder("Camera path", expand_by_default=False):
            self.keyframes = Keyframes(self)

    def draw_curve(self) -> None:
        """Draws PSNR in dB over training seconds, from the second evaluation on."""
        if len(self.viewer.points) < 2:
            return
        seconds, psnr = np.array(self.viewer.points, dtype=np.float64).T
        if self.curve is not None:
            self.curve.data = (seconds, psnr)
            return
        series = (Series(label="s"), Series(label="PSNR [dB]", stroke="#00897b", width=2))
        with self.panel:
            self.curve = self.handle.gui.add_uplot(
                (seconds, psnr), series, scales={"x": Scale(time=False)}, aspect=1.8, padding=PADDING, order=1e9
            )

    def on(self, register: Callable[[Callable[[Any], None]], object], work: Callable[[], object]) -> None:
        """Registers ``work`` as the callback of a panel element; if it fails, the client is disconnected."""
        register(lambda _: self.viewer.serve_client(self, work))

    def _resize(self, longest: int) -> None:
        self.longest, self.follows = longest, False
        self.change()

    # --- cells -----------------------------------------------------------------------------------------------------

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self.viewer.do(lambda: self.viewer.serve_client(self, lambda: self.pick(*event.screen_pos)))

    def pick(self, x: float, y: float) -> None:
        """Picks and describes the cell at a position in the picture, 0..1 from the left and from the top."""
        subject = self.viewer.subject
        cell = cell_at(subject, self.camera(self.longest), self.look, x, y)
        self.change(picked=cell)
        self.info.content = NO_CELL if cell is None else describe_cell(subject.diagram, cell, self.look.level)

    def _hide(self, action: str) -> None:
        if action == "show all":
            self.change(hidden=frozenset())
        elif (picked := self.look.picked) is not None:
            groups = groups_of(self.viewer.subject.diagram, self.look.level)
            inside = groups == groups[picked]
            cells = frozenset((inside if action == "hide" else ~inside).nonzero()[:, 0].tolist())
            self.change(hidden=self.look.hidden | cells if action == "hide" else cells)

    # --- objects in the scene --------------------------------------------------------------------------------------

    def clear(self, kind: str) -> None:
        """Removes the objects of one kind from the scene."""
        for node in self.nodes[kind]:
            node.remove()
        self.nodes[kind] = []

    def _show_centres(self, show: bool) -> None:
        self.clear("centres")
        if show:
            diagram, contraction = self.viewer.subject.diagram, self.viewer.subject.renderer.contraction
            centres = diagram.leaf_centres if contraction is None else contraction.inverse(diagram.leaf_centres)
            bounds = scene_bounds(self.viewer.subject.scene)
            cloud = self.handle.scene.add_point_cloud(
                "/centres",
                centres.cpu().numpy(),
                palette(diagram.num_cells).numpy(),
                point_size=0.012 * float((bounds[1] - bounds[0]).norm()),
                point_shape="circle",
                precision="float32",
            )
            self.nodes["centres"] = [cloud]
        self.change()

    def _show_cameras(self, show: bool) -> None:
        self.clear("cameras")
        if show:
            scene = self.viewer.subject.scene
            cameras, count = scene.train.cameras, min(len(scene.train), MOST_VIEWS)
            spread = float((cameras.origins - cameras.origins.mean(0)).norm(dim=-1).mean())
            with self.handle.atomic():
                for view in (number * len(scene.train) // count for number in range(count)):
                    picture = None
                    if len(scene.train.images):
                        truth = scene.train.truth(view, scene.background_colour())
                        step = -(-max(truth.shape[:2]) // THUMBNAIL)
                        picture = (truth[::step, ::step] * 255).to(torch.uint8).numpy()
                    node: Any = self.handle.scene.add_camera_frustum(
                        f"/cameras/{view}",
                        scale=0.06 * max(spread, 1e-3),
                        thickness=1.5,
                        thickness_units="screen",
                        image=picture,
                        **frustum(cameras, view),
                    )
                    self.on(node.on_click, partial(self.stand, cameras, view))
                    self.nodes["cameras"].append(node)
        self.change()
