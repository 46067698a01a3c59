import math
from types import SimpleNamespace

from voronerf.app.cli.display import TrainingDisplay


def test_the_loss_is_that_of_the_steps_whose_loss_was_read():
    """On a GPU the first losses are not known, and a resumed run begins at a later step."""
    display = TrainingDisplay("run")
    router = SimpleNamespace(num_cells=1)
    for step, loss in ((51, math.nan), (52, math.nan), (53, 0.4), (54, 0.2)):
        state = SimpleNamespace(step=step, loss=loss, router=router, fraction=0.5, rays_done=100, seconds=1.0)
        display.after_step(state)
    assert display.loss == 0.95 * 0.4 + 0.05 * 0.2


def test_what_goes_on_beside_a_training_has_a_bar_with_its_name():
    display = TrainingDisplay("run")
    shown = []
    for number in display.track([5, 6], "scores"):
        task = display.progress.tasks[-1]
        shown.append((number, task.description, task.fields["text"]))
    assert shown == [(5, "scores", "0 of 2"), (6, "scores", "1 of 2")]
    parts = display.track([5, 6], "scores")
    next(iter(parts))
    parts.close()  # as where a training is stopped
    assert [task.description for task in display.progress.tasks] == ["run"]
