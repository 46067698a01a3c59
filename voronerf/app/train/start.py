"""A training whose coarse stage learns nothing begins it again from another draw, by one rule, the same on resume.

r rays of a batch.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from voronerf.app.train.build import make_grid, make_routers
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.step import StepOutput
from voronerf.nerf.volume import Batch, RenderOutput

#: Steps after the grid has settled after which a start is judged, and how often a training begins again at most.
JUDGED, DRAWS = 100, 3
#: From draw to draw, the seed of the networks grows by this.
STRIDE = 1_000_003
#: A start has failed if the rays that differ from the background by more than `DIFFERS` meet less than `EMPTY` of
#: opacity on average; or if the own colours of rays deviate by less than `ONE_COLOUR`, and what they should show by
#: more than `COLOURED`.
DIFFERS, EMPTY, ONE_COLOUR, COLOURED = 0.1, 0.02, 1e-3, 0.05


def judge_start(state: State, made: StepOutput) -> None:
    """Begins the coarse stage again if its start has failed, once it is so far; says so.

    Only trainings with an occupancy grid are judged, which can empty itself. At most `DRAWS` further draws are tried.

    Args:
        state: After a step.
        made: That step.
    """
    if state.step != judged_at(state):
        return
    draw = sum(stage.cells == 1 for stage in state.stages)
    if state.router.num_cells > 1 or draw > DRAWS:
        return
    why = why_nothing_is_learnt(made.batch, made.output)
    if why is None:
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
    state.report(f"nothing is learnt by step {state.step}: {why}; begins again from another draw, {draw} of {DRAWS}")


def steps_to_judgement(state: State) -> int:
    """How many steps can be made before :func:`judge_start` may judge; `GROUP` where it will not."""
    left = judged_at(state) - state.step
    return left if left > 0 else GROUP


def judged_at(state: State) -> int:
    """After which step a start is judged; 0 for none."""
    return 0 if state.sampler.grid is None else state.began + state.sampler.settling_steps + JUDGED


def why_nothing_is_learnt(batch: Batch, output: RenderOutput) -> str | None:
    """The fault of a start, from the r rays of one of its steps; None if it is good. Waits for the device."""
    background = torch.zeros(3) if batch.background is None else batch.background
    background = background.to(batch.target)
    light = output.error.new_zeros(len(batch.rays)).index_add(
        0, output.samples.ray_index.long(), output.weights.float()
    )
    differs = (batch.target - background).abs().amax(-1) > DIFFERS
    if bool(differs.any()) and not bool(light[differs].mean() >= EMPTY):
        return "all space is empty"
    seen = light > 0.5
    if int(seen.sum()) > 1:
        colour = (output.colour - (1 - light)[:, None] * background)[seen] / light[seen, None]
        if bool((colour.std(0) < ONE_COLOUR).all()) and bool((batch.target[seen].std(0) > COLOURED).any()):
            return "all has one colour"
    return None
