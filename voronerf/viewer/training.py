"""The viewer of a training: pictures between its steps, its curve, pause."""

from __future__ import annotations

import contextlib
import time

from voronerf.training.progress import Progress
from voronerf.training.trainer import Trainer
from voronerf.viewer.pictures import Subject
from voronerf.viewer.viewer import Viewer

#: Seconds between two changes of the lines and the curve that tell of the training.
TELL = 1.0


class TrainingViewer(Viewer):
    """Shows a training; its trainer calls :meth:`on_step` after every step.

    Pictures have the averaged weights. Nothing is rendered while there is no browser, and the results of training are
    the same bit for bit with and without a viewer.

    Args:
        trainer: what is viewed.
        host: address to listen at.
        port: to listen at; 0 is any that is free.
    """

    def __init__(self, trainer: Trainer, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        subject = Subject(
            trainer.out.name, trainer.out, trainer.scene, trainer.router, trainer.renderer, trainer.averaged
        )
        super().__init__(subject, host=host, port=port)
        self.trainer, self.cells = trainer, trainer.router.num_cells
        self.paused = False
        self.told_at = 0.0
        self.now: Progress | None = None
        gui = self.server.gui
        self.line = gui.add_markdown("", order=-3)
        self.button = gui.add_button("Pause", order=-2)
        self.button.on_click(lambda _: self.pause(not self.paused))

    def pause(self, paused: bool) -> None:
        """Holds the training after the step in hand, or lets it go on."""
        self.paused = paused
        self.button.label = "Go on" if paused else "Pause"
        self.wake.set()

    def on_step(self, now: Progress) -> None:
        """Shows the state after a step; returns when training shall go on."""
        self.now = now
        if not self.clients and not self.paused:
            return
        if now.cells != self.cells:  # after a split, or back at a checkpoint from before one
            self.cells = now.cells
            for client in self.list_clients():
                self.serve_client(client, client.on_diagram)
        if time.perf_counter() - self.told_at > TELL:
            self.tell()
        self.refresh()
        self.render_next()
        if self.paused:
            self.tell()
            self.serve(lambda: not self.paused or self.trainer.stopped)

    def stay(self) -> None:
        """Shows what came of the training, until Ctrl-C."""
        self.button.visible = False
        self.tell()
        for client in self.list_clients():
            client.change()
        with contextlib.suppress(KeyboardInterrupt):
            self.serve()

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
        self.show_curve([(line["seconds"], line["psnr"]) for line in self.trainer.metrics])
