"""Schedules of a training: the learning rate, and the rays of a step."""

from __future__ import annotations

import math

#: The learning rate, the rays of a step, averaged weights and what is known of empty space change with every so many
#: steps of a training, in between steps are replayed in one call. Longer groups gain little: in these, 3 % of the time
#: is spent in between.
GROUP = 16
#: The most steps that the learning rate rises for. While it is small the densities stay low, so that an occupancy grid,
#: which forgets in eight to thirty steps, would empty itself for good: it learns only afterwards.
WARMUP_STEPS = 100
#: The fraction of the training that it rises for, at most.
WARMUP = 0.02
#: Learning rate at the end, as a fraction of that at the start.
FINAL = 0.05
#: The share of a step's samples that are to be left once empty space is known, if more rays can bring them, and the
#: samples of a ray, in a box and in contracted space, beyond which it grows with them: these go with larger tables,
#: which larger steps keep cheap.
FILL, FILL_SAMPLES, CONTRACTED_FILL_SAMPLES = 0.25, 64, 128


def learning_rate(lr: float, fraction: float, step: int, *, hold: float = 0.0, began: int = 0) -> float:
    """The learning rate of a step: a linear rise over `WARMUP` of the training, then ``lr``, then exponential decay.

    It rises over `WARMUP_STEPS` at most, and over as many where the training began again from another draw.

    Args:
        lr: The highest rate.
        fraction: How much of the training is done, 0..1.
        step: Steps done.
        hold: Fraction of the training after which the rate falls, down to ``lr * FINAL`` at the end.
        began: The step at which it began again; 0 for never.
    """
    risen = max((step - began) / WARMUP_STEPS, 0.0 if began else fraction / WARMUP)
    rise = 0.01 + 0.99 * risen if risen < 1 else 1.0
    fallen = max(0.0, fraction - hold) / (1 - hold)
    return lr * rise * math.exp(math.log(FINAL) * fallen)


def next_rays(now: int, taken: int, *, rays: int, samples: int, growth: float, contracted: bool = False) -> int:
    """Rays of the next step: the more of the samples are left out as empty, the more rays a step takes.

    Args:
        now: Rays of the last step.
        taken: Samples that it had in occupied space.
        rays: Rays of the first step, and the fewest.
        samples: Strata of a ray of the last step.
        growth: The most rays, as a multiple of ``rays``.
        contracted: Whether space is contracted.
    """
    most = CONTRACTED_FILL_SAMPLES if contracted else FILL_SAMPLES
    share = FILL * max(samples / most, 1.0)
    wanted = now * share * rays * samples / max(taken, 1)
    return int(min(max(wanted, rays), rays * growth))
