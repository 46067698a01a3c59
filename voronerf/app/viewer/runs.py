"""What one browser does with a run: export it, open another one beside it, train it further or anew."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from voronerf.app.export import export_cells, export_mesh, export_points, export_splats, export_video
from voronerf.app.run import Run
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import ConfigError
from voronerf.app.train.run_directory import read_curve
from voronerf.app.viewer.door import chosen
from voronerf.app.viewer.pictures import Subject

if TYPE_CHECKING:
    from voronerf.app.viewer.client import Client

#: What can be exported: the name of the file in the folder exports of the run, and what writes it.
FILES: dict[str, tuple[str, Callable[..., Any]]] = {
    "mesh": ("mesh.glb", export_mesh),
    "splats": ("splats.ply", export_splats),
    "points": ("points.ply", export_points),
    "cells": ("cells.glb", export_cells),
    "video": ("video.mp4", export_video),
}


class Stopped(Exception):
    """An export that a browser has stopped, or left."""


class Exports:
    """Exports what a browser shows of a run, inside of its crop; the video goes along its keyframes.

    Args:
        client: that asks.
        run: that is exported.
    """

    def __init__(self, client: Client, run: Run) -> None:
        self.client, self.run, self.stopped = client, run, False
        gui = client.handle.gui
        self.kind = gui.add_dropdown("File", tuple(FILES))
        self.button = gui.add_button("Export", hint="Into the run directory, and as a download.")
        client.on(self.button.on_click, lambda: client.viewer.work(client, partial(self.write, chosen(self.kind))))
        self.stop = gui.add_button("Stop export", visible=False)
        client.on(self.stop.on_click, lambda: setattr(self, "stopped", True))
        self.state = gui.add_markdown("", visible=False)
        self.bar: Any = gui.add_progress_bar(0.0, visible=False)

    def write(self, kind: str) -> None:
        """Writes the file and sends it."""
        client, look = self.client, self.client.look
        name, export = FILES[kind]
        file = self.run.path / "exports" / name
        options: dict[str, Any] = {"box": None if look.crop is None else torch.tensor(look.crop)}
        if kind in ("mesh", "splats", "video"):
            options["track"] = self.track
        if kind == "video" and client.keyframes.cameras:
            options["flight"] = client.keyframes.frames()
        self.stopped = False
        self._working(True)
        self.state.content = f"{kind} ..."
        try:
            export(self.run, file, **options)
        except Stopped:
            self.state.content = "Stopped."
        except Exception:
            self.state.visible = False
            raise
        else:
            self.state.content = f"Wrote `{file}`."
            client.handle.send_file_download(f"{client.viewer.subject.name}-{name}", file.read_bytes())
        finally:
            self._working(False)

    def _working(self, working: bool) -> None:
        self.state.visible, self.button.disabled, self.bar.value = True, working, 0.0
        self.stop.visible = self.bar.visible = working

    def track(self, parts: Sequence[Any], name: str) -> Iterable[Any]:
        """Shows progress, and has pictures rendered between two parts."""
        viewer = self.client.viewer
        for number, part in enumerate(parts):
            self.state.content, self.bar.value = f"{name} ...", 100 * number / len(parts)
            viewer.render_next()
            if self.stopped or self.client.handle.client_id not in viewer.clients:
                raise Stopped
            yield part


class Runs:
    """Opens runs that lie beside this one, and trains.

    Args:
        client: that asks.
        run: that is shown.
    """

    def __init__(self, client: Client, run: Run) -> None:
        self.client, self.run = client, run
        viewer, gui, path = client.viewer, client.handle.gui, run.path.resolve()
        beside = sorted(other.name for other in path.parent.iterdir() if other != path and checkpoint_paths(other))
        if beside and viewer.open is not None:
            other = gui.add_dropdown("Open", (path.name, *beside), hint="Runs that lie beside this one.")
            client.on(other.on_update, lambda: self.open(path.parent / chosen(other)))
        if viewer.train is not None:
            self.seconds = gui.add_slider("Train for [s]", 10, 3600, 10, 60)
            self.cells = gui.add_slider("Cells", 1, 64, 1, 16, hint="Of a training anew; 1 is one network.")
            how = gui.add_button_group("Train", ("further", "anew"))
            client.on(how.on_click, lambda: viewer.work(client, partial(self.train, how.value == "further")))

    def open(self, path: Path) -> None:
        """Shows another run to every browser."""
        viewer = self.client.viewer
        opened = viewer.open
        assert opened is not None
        viewer.work(self.client, lambda: viewer.show(Subject.of(opened(path))))

    def train(self, further: bool) -> None:
        """Trains this run further, or a new one beside it, and shows what came of it.

        Raises:
            ConfigError: the images are not there, or the settings do not allow it.
        """
        viewer, seconds = self.client.viewer, float(chosen(self.seconds))
        assert viewer.train is not None and viewer.open is not None
        scene = viewer.subject.scene
        if not len(scene.train.images):
            raise ConfigError("a training needs the images of the scene, which are not read, or not there")
        path = self.run.path.resolve()
        # As it was trained: views may be shown with other data, or at another size.
        config = replace(self.run.config, steps=None, resume=further, out=path, panels=0)
        if further:
            curve = read_curve(path)
            config = replace(config, budget=seconds + (curve[-1][0] if curve else 0.0))
        else:
            cells = int(chosen(self.cells))
            names = (path.with_name(f"{path.name}-{number}") for number in range(2, 10_000))
            out = next(name for name in names if not name.exists())
            config = replace(
                config, budget=seconds, cells=(cells,) if cells > 1 else (), split_at=None, split_at_steps=None, out=out
            )
        assert config.out is not None
        before = viewer.subject
        try:
            viewer.train(config, scene)
            viewer.show(Subject.of(viewer.open(config.out), scene))
        except BaseException:
            viewer.show(before)
            raise
