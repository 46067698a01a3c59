"""A simulated browser tab, which exchanges viser's messages with a viewer."""

from __future__ import annotations

import io
import math
import time

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from viser.transforms import SO3
from websockets.sync.client import connect

from voronerf.app.viewer.cameras import FLIP

CAMERA = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0] * 3, "fov": 1.0, "near": 0.01, "far": 1000.0}
CAMERA |= {"image_height": 48, "image_width": 48, "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, 0.0, 1.0]}
CLICK = {"event_type": "click", "ray_origin": [0.0] * 3, "ray_direction": [0.0, 0.0, 1.0], "modifier": None}


def resolved(value, buffers):
    """Returns a message's value, or the binary buffer that it refers to."""
    return buffers[value["__binary_index"]] if isinstance(value, dict) and "__binary_index" in value else value


class Tab:
    """A client of a viewer; the viewer renders while :meth:`until` waits.

    Args:
        viewer: The viewer that serves the tab.
        cameras: Cameras that include the tab's first camera.
        index: The index of the first camera.
        size: The canvas size in pixels, (width, height).
        number: The number of earlier tabs of this viewer.

    Attributes:
        pictures: The received background images in order, uint8 arrays [h, w, 3].
        gui: The properties of the panel's controls, by label or, for a text, by its first 20 characters.
        nodes: The scene nodes by name.
    """

    def __init__(self, viewer, cameras, index=0, *, size=(48, 48), number=0) -> None:
        self.viewer, self.size = viewer, size
        self.pictures, self.depths, self.gui, self.nodes, self.notes = [], [], {}, {}, []
        protocol = f"viser-v{viser.__version__}"
        self.socket = connect(f"ws://{viewer.host}:{viewer.port}", subprotocols=[protocol], max_size=None)
        self.number, self.version = number, None
        self.look(cameras, index)

    def close(self) -> None:
        self.socket.close()

    def send(self, kind, **values) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def look(self, cameras, index=0) -> None:
        """Moves to a camera and takes its angle of view."""
        pose = cameras.poses[index].double().numpy()
        fov = 2 * math.atan(cameras.height / 2 / float(cameras.intrinsics[index, 1]))
        place = {"position": pose[:3, 3].tolist(), "look_at": (pose[:3, 3] - pose[:3, 2]).tolist(), "fov": fov}
        place |= {"wxyz": SO3.from_matrix(pose[:3, :3] @ FLIP).wxyz.tolist()}
        place |= {"image_width": self.size[0], "image_height": self.size[1]}
        self.send("ViewerCameraMessage", **{**CAMERA, **place})

    def set(self, label, value) -> None:
        """Changes a control of the panel, or presses a button."""
        self.send("GuiUpdateMessage", uuid=self.gui[label]["uuid"], updates={"value": value})

    def drag(self, name, place, wxyz=(1.0, 0.0, 0.0, 0.0)) -> None:
        """Waits for a transform control of the scene, and drags it to a position."""
        self.until(lambda: name in self.nodes)
        node = {"name": name, "owner": self.nodes[name].get("owner", "")}
        self.send("TransformControlsDragStartMessage", **node)
        self.send("TransformControlsUpdateMessage", wxyz=list(wxyz), position=place, **node)
        self.send("TransformControlsDragEndMessage", **node)

    def click(self, x, y) -> None:
        self.send("ScenePointerMessage", **CLICK, screen_pos=[[x, y]])

    def read(self) -> None:
        """Processes the received messages."""
        while True:
            try:
                data = self.socket.recv(timeout=0.02)
            except TimeoutError:
                return
            length = int.from_bytes(data[8:16], "little")
            inner = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + length]))
            buffers, at = [], 16 + length
            for size in inner["binaryBufferLengths"]:
                at += -at % 8
                buffers.append(data[at : at + size])
                at += size
            for message in inner["messages"]:
                self.take({key: resolved(value, buffers) for key, value in message.items()})

    def take(self, message) -> None:
        kind, props = message["type"], message.get("props") or {}
        if kind == "BackgroundImageMessage" and message["rgb_data"]:
            self.pictures.append(np.array(Image.open(io.BytesIO(message["rgb_data"]))))
            self.depths.append(message["depth_data"])
        elif kind == "GuiUpdateMessage":
            for part in self.gui.values():
                if part["uuid"] == message["uuid"]:
                    part.update(message["updates"])
        elif kind == "GuiRemoveMessage":
            self.gui = {
                label: part for label, part in self.gui.items() if message["uuid"] not in (part["uuid"], part["folder"])
            }
        elif kind.startswith("Gui") and "uuid" in message:
            label = props.get("label") or props.get("_markdown", kind)[:20]
            control = {"uuid": message["uuid"], "folder": message.get("container_uuid"), "value": message.get("value")}
            self.gui[label] = control | props
        elif kind == "RemoveSceneNodeMessage":
            self.nodes = {name: node for name, node in self.nodes.items() if not name.startswith(message["name"])}
        elif "name" in message and props:
            self.nodes[message["name"]] = {"kind": kind, "owner": message.get("owner", ""), **props}
        elif kind == "NotificationShowMessage":
            self.notes.append(props or message)

    def until(self, done, seconds=20.0):
        """Lets the viewer render until ``done()`` is true, and returns its value."""
        end = time.monotonic() + seconds
        while True:
            self.viewer.render_next()
            self.read()
            value = done()
            if value:
                return value
            assert time.monotonic() < end, f"timed out after {seconds} s"

    def rest(self):
        """Waits for the sharp picture after a change and returns it, uint8 [h, w, 3]."""
        client = self.until(lambda: self.viewer.clients.get(self.number))
        self.until(lambda: client.version != self.version and not (client.wants_sharp or client.wants_coarse))
        self.version = client.version
        self.read()
        return self.pictures[-1]
