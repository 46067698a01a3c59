"""A training in a viewer: pictures between its steps, its curve, pause and stop."""

from __future__ import annotations

import time

from voronerf.app.train.progress import Progress
from voronerf.app.train.trainer import Trainer
from voronerf.app.viewer.pictures import Subject
from voronerf.app.viewer.viewer import Viewer

#: Seconds between two changes of the lines and the curve that tell of the training.
TELL = 1.0


def watch(trainer: Trainer, *, host: str = "127.0.0.1", port: int = 8080) -> Training:
    """A viewer of a training; its trainer calls :meth:`Training.on_step` after every step.

    Args:
        trainer: What is viewed.
        host: Address to listen at.
        port: To listen at; 0 is any that is free.

    Raises:
        ConfigError: The address cannot be listened at.
    """
    return Training(Viewer(subject_of(trainer), host=host, port=port), trainer)


def subject_of(trainer: Trainer) -> Subject:
    """What is viewed of a training: pictures have the averaged weights."""
    return Subject(trainer.out.name, trainer.out, trainer.scene, trainer.router, trainer.renderer, trainer.averaged)


class Training:
    """Shows a training in a viewer.

    Nothing is rendered while there is no browser, and the results of training are the same bit for bit with and without
    a viewer.

    Args:
        viewer: Shows it from now on.
        trainer: What is viewed.
    """

    def __init__(self, viewer: Viewer, trainer: Trainer) -> None:
        self.viewer, self.trainer, self.cells = viewer, trainer, trainer.router.num_cells
        self.paused = False
        self.told_at = 0.0
        self.now: Progress | None = None
        if viewer.subject.router is not trainer.router:
            viewer.show(subject_of(trainer))
        gui = viewer.server.gui
        self.line = gui.add_markdown("", order=-3)
        self.button = gui.add_button("Pause", order=-2)
        self.button.on_click(lambda _: self.pause(not self.paused))
        self.end = gui.add_button("Stop training", order=-2, hint="It can be trained further.")
        self.end.on_click(lambda _: self.stop())

    def pause(self, paused: bool) -> None:
        """Holds the training after the step in hand, or lets it go on."""
        self.paused = paused
        self.button.label = "Go on" if paused else "Pause"
        self.viewer.wake.set()

    def stop(self) -> None:
        """Ends the training after the step in hand."""
        self.trainer.request_stop()
        self.viewer.wake.set()

    def on_step(self, now: Progress) -> None:
        """Shows the state after a step; returns when training shall go on."""
        self.now, viewer = now, self.viewer
        if not viewer.clients and not self.paused:
            return
        if now.cells != self.cells:  # after a split
            self.cells = now.cells
            for client in viewer.list_clients():
                viewer.serve_client(client, client.on_diagram)
        if time.perf_counter() - self.told_at > TELL:
            self.tell()
        viewer.refresh()
        viewer.render_next()
        if self.paused:
            self.tell()
            viewer.serve(lambda: not self.paused or self.trainer.stopped)

    def close(self) -> None:
        """Takes the lines and the buttons away."""
        for part in (self.line, self.button, self.end):
            part.remove()

    def tell(self) -> None:
        """Writes the lines about the training, and its curve."""
        self.told_at, now = time.perf_counter(), self.now
        if now is None:
            return
        self.line.content = (
            f"step {now.step:,}, {now.seconds:.0f} s, {now.fraction:.0%}  \n"
            f"{now.cells} cells, {now.rays_per_second / 1000:.1f} k rays/s  \n"
            f"loss {now.loss:.5f}" + ("" if now.psnr is None else f", PSNR {now.psnr:.2f} dB")
        )
        self.viewer.show_curve([(line["seconds"], line["psnr"]) for line in self.trainer.metrics])
