"""Schedules of a training: the learning rate, and the number of rays of a step."""

from __future__ import annotations

import math

#: The number of steps that are replayed in one call. The learning rate, the number of rays, the averaged weights and
#: the revisited voxels change only between such groups. Longer groups gain little: 3 % of the time is spent between
#: groups.
GROUP = 16
#: The maximum number of warm-up steps, in which the learning rate rises. An occupancy grid is updated only after the
#: warm-up, since densities stay low while the rate is small.
WARMUP_STEPS = 100
#: The longest warm-up as a fraction of the training.
WARMUP = 0.02
#: The learning rate at the end, as a fraction of the rate at the start.
FINAL = 0.05
#: `next_rays` aims at `FILL` * (rays of the first step) * (strata per ray) samples in occupied space. If a ray has more
#: strata than `FILL_SAMPLES`, or `CONTRACTED_FILL_SAMPLES` in contracted space, the factor `FILL` is enlarged in
#: proportion: trainings with more strata also have larger tables, whose update costs less per ray in a larger batch.
FILL, FILL_SAMPLES, CONTRACTED_FILL_SAMPLES = 0.25, 64, 128
#: The number of steps from which a training is long, and the maximum of `relative_length`. An estimate of the number
#: of steps leaves out the first `CHEAP_STEPS` steps, which have few strata.
LONG_STEPS, MOST_LENGTH, CHEAP_STEPS = 3500, 8.0, 400
#: The maximum number of strata in a step, which is the largest ``capacity`` of `ops.march_rays`.
MOST_STRATA = 2**27


def relative_length(step: int, fraction: float, steps: int | None = None) -> float:
    """Returns the length of a training: its number of steps / `LONG_STEPS`, 1..`MOST_LENGTH`.

    The learning rate is divided by this length for fields without tables, and for tables in contracted space. Without
    the division, 16 cells without tables reached 28.3 dB on Lego in five minutes, but 15.9 dB in an hour.

    Adam moves a table entry that few rays read by about the full rate, whatever the noise of its gradient. With more
    steps at the same rate, entries walk farther at random: pale fog beside the training rays becomes clouds with
    contrast. The weight decay of tables, which is proportional to the rate, is multiplied by the length: each step
    shrinks such entries as in a short training. With a time budget, the rays of a step on tables are multiplied by the
    square of the length: eight times the time makes twice as many steps.

    Args:
        step: The number of steps done.
        fraction: The completed fraction of the training, 0..1.
        steps: The number of steps of the training; None to estimate it from ``step`` and ``fraction``.
    """
    expected = (step - CHEAP_STEPS) / max(fraction, 1e-9) if steps is None else steps
    return min(max(1.0, expected / LONG_STEPS), MOST_LENGTH)


def learning_rate(lr: float, fraction: float, step: int, *, hold: float = 0.0, began: int = 0) -> float:
    """Returns the learning rate of a step: a linear warm-up over `WARMUP`, then ``lr``, then exponential decay.

    The warm-up takes at most `WARMUP_STEPS` steps; after a restart of the training, exactly `WARMUP_STEPS`.

    Args:
        lr: The highest rate.
        fraction: The completed fraction of the training, 0..1.
        step: The number of steps done.
        hold: The fraction of the training after which the rate falls; at the end, the rate is ``lr * FINAL``.
        began: The step at which the training was restarted; 0 if it was not restarted.
    """
    warmup = max((step - began) / WARMUP_STEPS, 0.0 if began else fraction / WARMUP)
    factor = 0.01 + 0.99 * warmup if warmup < 1 else 1.0
    decay = max(0.0, fraction - hold) / max(1 - hold, 1e-9)
    return lr * factor * math.exp(math.log(FINAL) * decay)


def next_rays(now: int, taken: int, *, rays: int, samples: int, growth: float, contracted: bool = False) -> int:
    """Returns the number of rays of the next step: more rays if more samples of the last step were in empty space.

    Args:
        now: The number of rays of the last step.
        taken: The number of samples of the last step in occupied space.
        rays: The number of rays of the first step, which is the minimum.
        samples: The number of strata per ray in the last step.
        growth: The maximum number of rays, as a multiple of ``rays``.
        contracted: Whether space is contracted.
    """
    limit = CONTRACTED_FILL_SAMPLES if contracted else FILL_SAMPLES
    share = FILL * max(samples / limit, 1.0)
    target = now * share * rays * samples / max(taken, 1)
    return int(min(max(target, rays), rays * growth))
