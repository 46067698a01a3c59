import math
import threading
from types import SimpleNamespace

import pytest

from voronerf.app.cli.display import TrainingDisplay, busy, console, tracked
from voronerf.app.cli.process import StageDisplay
from voronerf.app.train.callbacks import counted


def test_the_loss_is_that_of_the_steps_whose_loss_was_read():
    """The displayed running average of the loss starts at the first loss that is not NaN.

    On a GPU the losses of the first steps are not read yet, so they are NaN. A resumed run starts at a late step.
    """
    display = TrainingDisplay("run")
    router = SimpleNamespace(num_cells=1)
    for step, loss in ((51, math.nan), (52, math.nan), (53, 0.4), (54, 0.2)):
        state = SimpleNamespace(step=step, loss=loss, router=router, fraction=0.5, rays_done=100, seconds=1.0)
        display.after_step(state)
    assert display.loss == 0.7 * 0.4 + 0.3 * 0.2


def test_what_goes_on_beside_a_training_has_a_bar_with_its_name():
    display = TrainingDisplay("run")
    shown = []
    for number in display.track([5, 6], "scores"):
        task = display.progress.tasks[-1]
        shown.append((number, task.description, task.fields["text"]))
    assert shown == [(5, "scores", "0 of 2"), (6, "scores", "1 of 2")]
    parts = display.track([5, 6], "scores")
    next(iter(parts))
    parts.close()  # as when a training is stopped
    assert [task.description for task in display.progress.tasks] == ["run"]


@pytest.mark.parametrize(("width", "absent"), [(160, ()), (100, ("rays/s",)), (80, ("rays/s", "loss", "step"))])
def test_a_narrow_terminal_keeps_bar_time_and_psnr(width, absent, monkeypatch):
    monkeypatch.setattr(console, "_width", width)
    monkeypatch.setattr(console, "_height", 25)
    display = TrainingDisplay("builtin")
    display.scores = SimpleNamespace(metrics=[{"psnr": 22.5}])
    router = SimpleNamespace(num_cells=16)
    display.after_step(SimpleNamespace(step=12345, loss=0.1, router=router, fraction=0.5, rays_done=1e6, seconds=9.0))
    text = display.progress.tasks[0].fields["text"]
    assert [word for word in ("rays/s", "loss", "step") if word not in text] == list(absent)
    with console.capture() as shown:
        console.print(display.progress.get_renderable())
    (line,) = shown.get().splitlines()
    assert len(line) <= width and "50 %" in line and "psnr 22.50 dB" in line and "-:--:--" in line and "━" * 12 in line


def test_stages_of_a_process_fit_80_columns_and_say_the_time_left(monkeypatch):
    monkeypatch.setattr(console, "_width", 80)
    monkeypatch.setattr(console, "_height", 25)
    display, now = StageDisplay(), [0.0]
    display.progress.get_time = display.progress.tasks[0]._get_time = lambda: now[0]
    display.show("features", 0, 500)
    now[0] = 40.0  # after two batches of four large images
    display.show("features", 8, 500)

    def shown():
        with console.capture() as captured:
            console.print(display.progress.get_renderable())
        return captured.get().splitlines()

    (line,) = shown()
    assert line.rstrip().endswith("8 of 500 0:41:00 left")
    for stage in ("matches", "global mapping: retriangulation and refinement"):
        display.show(stage, 0, 0)
    (line,) = shown()
    assert len(line) <= 80
    assert line.startswith("global mapping: retriangulation and refinement") and "left" not in line


def test_without_a_terminal_lines_tell_how_far_it_is(monkeypatch, capsys):
    monkeypatch.setattr("voronerf.app.cli.display.EVERY", 0.0)
    display = TrainingDisplay("run")
    router = SimpleNamespace(num_cells=16)
    display.after_step(SimpleNamespace(step=5, loss=0.1, router=router, fraction=0.5, rays_done=1e6, seconds=10.0))
    assert list(tracked([5, 6], "the video")) == list(display.track([5, 6], "scores")) == [5, 6]
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        *("  50%  step 5  16 cells  100.0 k rays/s  loss 0.10000", "the video: 0 of 2", "the video: 1 of 2"),
        *("scores: 0 of 2", "scores: 1 of 2"),
    ]
    with busy("reading x"):
        for thread in threading.enumerate():
            if isinstance(thread, threading.Timer):  # the timer that prints the message
                thread.join()
    assert capsys.readouterr().out == "reading x\n"
    monkeypatch.setattr("voronerf.app.cli.display.EVERY", 1000.0)
    with busy("reading x"):
        assert list(tracked([5, 6], "the video")) == [5, 6]
    assert capsys.readouterr().out == ""


def test_one_is_no_plural():
    assert [counted(n, "cell") for n in (0, 1, 1600)] == ["0 cells", "1 cell", "1,600 cells"]
