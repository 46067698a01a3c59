"""Restarts a coarse stage that has learnt nothing, with another seed. A resumed run makes the same decision.

A start is the first attempt at the coarse stage, or an attempt after a restart. A batch has r rays.
"""

from __future__ import annotations

from dataclasses import replace

from voronerf.app.train.build import make_grid, make_routers
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.step import StepOutput
from voronerf.nerf.volume import Batch, RenderOutput

#: The number of steps from the first update of the occupancy grid (without an update, from `Sampler.settling_steps`) to
#: the check of a start, and the maximum number of restarts of a training.
JUDGED, DRAWS = 100, 3
#: The increment of the networks' seed with each restart.
STRIDE = 1_000_003
#: A start has failed if the rays whose target differs from the background by more than `DIFFERS` have a mean opacity
#: below `EMPTY`. It has also failed if the standard deviation of the rays' colours is below `ONE_COLOUR`, while the
#: standard deviation of their targets is above `COLOURED`.
DIFFERS, EMPTY, ONE_COLOUR, COLOURED = 0.1, 0.02, 1e-3, 0.05


def judge_start(state: State, last: StepOutput) -> None:
    """Restarts the coarse stage with a new seed if nothing has been learnt by step `judged_at`, and reports it.

    Only trainings with an occupancy grid are judged, since the grid can become empty. There are at most `DRAWS`
    restarts.

    Args:
        state: The state after a step.
        last: The output of this step.
    """
    if state.step != judged_at(state):
        return
    draw = sum(stage.cells == 1 for stage in state.stages)
    if state.router.num_cells > 1 or draw > DRAWS:
        return
    fault = state.ranks.first(why_nothing_is_learnt(last.batch, last.output))
    if fault is None:
        return
    config = state.config
    for name, router in make_routers(replace(config, seed=config.seed + STRIDE * draw)).items():
        state.routers[name].load_state_dict(router.state_dict())
    sampler = state.sampler
    assert sampler.grid is not None
    sampler.grid.load_state_dict(make_grid(config, state.scene, state.device).state_dict())
    state.optimizer.state.clear()
    state.strategy.forget()
    state.begin_again()
    advice = "" if config.lr == usual_rate(config) else f"; {rate_advice(config)}"
    state.report(
        f"nothing is learnt by step {state.step}: {fault}; restart {draw} of {DRAWS} with another seed{advice}"
    )


def usual_rate(config: TrainConfig) -> float:
    """Returns the default learning rate of a configuration's field."""
    return config.field_type.learning_rate(config.network_options)


def rate_advice(config: TrainConfig, *, lower: bool = False) -> str:
    """Returns advice on a learning rate with which a training fails; ``lower`` if only a lower rate can help."""
    rate, usual = float(config.lr or 0), usual_rate(config)
    fault = "low" if rate < usual and not lower else "high"
    better = f"{usual:.2g}, the default" if rate > usual or fault == "low" else f"{rate / 4:.2g}"
    return f"the learning rate is probably too {fault}, try --lr {better}"


def steps_to_judgement(state: State) -> int:
    """Returns the number of steps until :func:`judge_start` judges the start; `GROUP` if no judgement follows."""
    remaining = judged_at(state) - state.step
    return remaining if remaining > 0 else GROUP


def judged_at(state: State) -> int:
    """Returns the step after which a start is judged; 0 without an occupancy grid, since the start is not judged."""
    grid, first = state.sampler.grid, state.sampler.settling_steps
    return 0 if grid is None else state.began + max(first, grid.settled or 0) + JUDGED


def why_nothing_is_learnt(batch: Batch, output: RenderOutput) -> str | None:
    """Returns the fault of a start, judged by the r rays of a step, or None. Waits for the device."""
    background = batch.target.new_zeros(3) if batch.background is None else batch.background.to(batch.target)
    opacity = output.error.new_zeros(len(batch.rays)).index_add(
        0, output.samples.ray_index.long(), output.weights.float()
    )
    differs = (batch.target - background).abs().amax(-1) > DIFFERS
    if bool(differs.any()) and not bool(opacity[differs].mean() >= EMPTY):
        return "the field is empty everywhere"
    opaque = opacity > 0.5
    if int(opaque.sum()) > 1:
        colour = (output.colour - (1 - opacity)[:, None] * background)[opaque] / opacity[opaque, None]
        if bool((colour.std(0) < ONE_COLOUR).all()) and bool((batch.target[opaque].std(0) > COLOURED).any()):
            return "all rays have the same colour"
    return None
