import math

from rich.console import Console

from voronerf.app.cli.display import TrainingDisplay
from voronerf.app.train.progress import Progress


def test_the_loss_is_that_of_the_steps_whose_loss_was_read():
    """On a GPU the first losses are not known, and a resumed run begins at a later step."""
    display = TrainingDisplay(Console(quiet=True), "run")
    for step, loss in ((51, math.nan), (52, math.nan), (53, 0.4), (54, 0.2)):
        display.on_step(Progress(step, 1.0, 0.5, loss, 100.0, 1, None))
    assert display.loss == 0.95 * 0.4 + 0.05 * 0.2
