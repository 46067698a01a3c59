"""The crop box of one browser, with two corners that the user drags."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from voronerf.app.run import read_crop, write_crop
from voronerf.app.viewer.cameras import scene_bounds

if TYPE_CHECKING:
    from voronerf.app.viewer.client import Client

#: The minimum side of the box and the size of a corner's arrows, as fractions of the scene's diagonal.
LEAST, ARROWS = 0.01, 0.12


class CropBox:
    """A crop box, outside of which nothing is rendered; it is drawn into the scene."""

    def __init__(self, client: Client) -> None:
        self.client, subject = client, client.viewer.subject
        bounds = scene_bounds(subject.scene)
        self.size = float((bounds[1] - bounds[0]).norm())
        try:
            saved = read_crop(subject.folder)
        except ValueError:
            saved = None
        self.corners = (bounds if saved is None else saved).double().numpy()
        gui = client.handle.gui
        self.shown = gui.add_checkbox("Crop", False, hint="Render a box only; drag its corners.")
        client.on(self.shown.on_update, self.show)
        self.button = gui.add_button(
            "Save crop",
            visible=False,
            hint="Saves the box in the run directory; use it with render or export --crop saved.",
        )
        client.on(self.button.on_click, self.save)

    def show(self) -> None:
        """Draws the box with its corners, or removes it."""
        client, self.button.visible = self.client, self.shown.value
        client.clear("crop")
        if self.shown.value:
            scene = client.handle.scene
            self.box = scene.add_box("/crop/box", color=(0, 137, 123), wireframe=True)
            corners = [
                scene.add_transform_controls(
                    f"/crop/{name}", ARROWS * self.size, disable_rotations=True, depth_test=False, position=place
                )
                for name, place in zip(("low", "high"), self.corners)
            ]
            for number, corner in enumerate(corners):

                async def moved(_: object, number: int = number, corner: Any = corner) -> None:
                    client.viewer.serve_client(client, partial(self.drag, number, corner.position))

                corner.on_update(moved)
            client.nodes["crop"] = [self.box, *corners]
        self.update()

    def drag(self, number: int, place: Any) -> None:
        """Moves the lowest corner, number 0, or the highest corner, number 1.

        Raises:
            ValueError: The place is not a valid position. The viewer's own page never sends such a place.
        """
        place = np.asarray(place, dtype=np.float64)
        if place.shape != (3,) or not (np.abs(place) < 1e9).all():
            raise ValueError(f"a corner of the crop cannot be at {place}")
        least = LEAST * self.size * np.array((-1, 1))[number]
        bound = (np.minimum, np.maximum)[number]
        self.corners = self.corners.copy()
        self.corners[number] = bound(place, self.corners[1 - number] + least)
        self.update()

    def update(self) -> None:
        """Redraws the box and requests a new picture."""
        if self.shown.value:
            self.box.position = self.corners.mean(0)
            self.box.dimensions = tuple(self.corners[1] - self.corners[0])
        low, high = (tuple(corner) for corner in self.corners.tolist())
        self.client.change(crop=(low, high) if self.shown.value else None)

    def save(self) -> None:
        """Writes the box into the run directory."""
        try:
            write_crop(self.client.viewer.subject.folder, torch.from_numpy(self.corners))
        except OSError as error:
            self.client.tell("Crop not saved", str(error))
        else:
            self.client.tell("Crop saved", "For render and export: --crop saved")
