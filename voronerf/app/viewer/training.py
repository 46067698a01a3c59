"""The viewer of a training: pictures between the steps, the PSNR curve, pause and stop."""

from __future__ import annotations

import time
from pathlib import Path

from voronerf.app.train.callbacks import Scores, counted
from voronerf.app.train.loop import Callback
from voronerf.app.train.state import State
from voronerf.app.viewer.pictures import Subject
from voronerf.app.viewer.viewer import Viewer
from voronerf.nerf.schedule import GROUP

#: Seconds between updates of the training's status text and PSNR curve.
TELL = 1.0


def watch(state: State, scores: Scores, *, host: str = "127.0.0.1", port: int = 8080) -> Training:
    """Returns a callback that shows a training in a viewer.

    Args:
        state: The viewed training.
        scores: The scores whose curve is shown.
        host: Address to listen on.
        port: Port to listen on; 0 is any free port.

    Raises:
        ConfigError: The address is unavailable.
    """
    return Training(Viewer(subject_of(state, scores), host=host, port=port), state, scores)


def subject_of(state: State, scores: Scores) -> Subject:
    """Returns the subject of a training, which is shown with its averaged weights."""
    out = scores.out or Path()
    return Subject(out.name, out, state.scene, state.router, state.renderer, state.averaged)


class Training(Callback):
    """A callback that shows a training in a viewer.

    Without a connected browser nothing is rendered. The results of training are the same bit for bit with and without
    a viewer.

    Args:
        viewer: The viewer, which is switched to the training.
        state: The viewed training.
        scores: The scores whose curve is shown.
    """

    def __init__(self, viewer: Viewer, state: State, scores: Scores) -> None:
        self.viewer, self.state, self.scores, self.cells = viewer, state, scores, state.router.num_cells
        self.paused = False
        self.told_at = 0.0
        if viewer.subject.router is not state.router:
            viewer.show(subject_of(state, scores))
        gui = viewer.server.gui
        self.line = gui.add_markdown("", order=-3)
        self.button = gui.add_button("Pause", order=-2)
        self.button.on_click(lambda _: self.pause(not self.paused))
        self.end = gui.add_button("Stop training", order=-2, hint="It can be trained further.")
        self.end.on_click(lambda _: self.stop())

    @property
    def group(self) -> int:  # type: ignore[override]
        """The number of steps between pictures: 1 while a browser is connected."""
        return 1 if self.viewer.clients else GROUP

    def pause(self, paused: bool) -> None:
        """Pauses the training after the current step, or continues it."""
        self.paused = paused
        self.button.label = "Go on" if paused else "Pause"
        self.viewer.wake.set()

    def stop(self) -> None:
        """Ends the training after the current step."""
        self.state.stop()
        self.viewer.wake.set()

    def after_step(self, state: State) -> None:
        """Renders pictures after a step; during a pause, returns when the training continues."""
        viewer, cells = self.viewer, state.router.num_cells
        if not viewer.clients and not self.paused:
            return
        if cells != self.cells:  # after a split
            self.cells = cells
            for client in viewer.list_clients():
                viewer.serve_client(client, client.on_diagram)
        if time.perf_counter() - self.told_at > TELL:
            self.tell()
        viewer.refresh()
        viewer.render_next()
        if self.paused:
            self.tell()
            viewer.serve(lambda: not self.paused or state.stopped)

    def on_end(self, state: State) -> None:
        """Removes the training's status text and its buttons from the panel."""
        for part in (self.line, self.button, self.end):
            part.remove()

    def tell(self) -> None:
        """Updates the training's status text and PSNR curve."""
        self.told_at, now = time.perf_counter(), self.state
        metrics = [line for line in self.scores.metrics if line["psnr"] is not None]  # None is infinite or NaN
        speed = now.rays_done / max(now.seconds, 1e-9) / 1000
        self.line.content = (
            f"step {now.step:,}, {now.seconds:.0f} s, {now.fraction:.0%}  \n"
            f"{counted(self.cells, 'cell')}, {speed:.1f} k rays/s  \n"
            f"loss {now.loss:.5f}" + (f", PSNR {metrics[-1]['psnr']:.2f} dB" if metrics else "")
        )
        self.viewer.show_curve([(line["seconds"], line["psnr"]) for line in metrics if line["part"] == 1])
