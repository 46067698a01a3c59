"""Trains a field with the parts of the library: python examples/train.py SCENE SECONDS"""

import sys
import time

import torch

from voronerf import HashGridField, OccupancyGrid, VoronoiRouter
from voronerf.app.evaluate import evaluate, mean_scores
from voronerf.app.scenes import load_scene
from voronerf.nerf import Adam, Occupancy, PlannedSplit, RayBatches, RayLoss, Renderer, SplitStrategy, TrainingStep
from voronerf.nerf.distributed import Ranks
from voronerf.nerf.samplers import usual_samples
from voronerf.nerf.schedule import GROUP, learning_rate, next_rays
from voronerf.nerf.terms import SparseDepth

torch.manual_seed(0)
ranks = Ranks.join()  # with torchrun, one of several processes
scene, seconds = load_scene(sys.argv[1]), float(sys.argv[2])
space, views, generator = scene.space(), scene.train, torch.Generator().manual_seed(0)
cube, pixel, contracted = scene.cube(space), scene.pixel(space), space.contraction is not None
samples = usual_samples((cube[1][0] - cube[0][0]) / pixel, contracted=contracted, seconds=seconds)
field = HashGridField(**HashGridField.scene_options(pixel, cube, contracted, seconds))
router = VoronoiRouter(field, torch.zeros(1, 3), coords="first3", share=["features"])  # coarse: one cell
sampler = Occupancy(OccupancyGrid.for_training(scene.box, samples, contraction=space.contraction), samples, space=space)
renderer = Renderer({"field": router}, sampler).train()
loss = RayLoss(renderer, terms=[SparseDepth(0.003)])
optimizer = Adam.of({"field": router}, lr=0.02, views=len(views), sparse=["features"])
strategy = SplitStrategy({"field": router}, [PlannedSplit(at=0.2, children=16)], generator=generator)
where = {"near": scene.near, "far": scene.far, "box": scene.box, "background": scene.background_colour()}
batches = RayBatches(views.cameras, views.images, masks=views.masks, sparse=views.sparse_depth, **where)
parts = {"strategy": strategy, "generator": generator, "ranks": ranks}
training_step = TrainingStep(batches, loss, optimizer, **parts)  # recorded and replayed
rays, step, start = 512, 0, time.perf_counter()
while (fraction := ranks.first((time.perf_counter() - start) / seconds)) < 1:
    strategy.step_pre_backward(optimizer, fraction, step)  # splits into 16 copies of the coarse cell
    optimizer.set_learning_rate(learning_rate(0.02, fraction, step + GROUP // 2, hold=0.25))
    made = training_step(rays, GROUP, at=step)
    step += GROUP
    most = {"samples": sampler.strata, "growth": 8, "contracted": contracted}
    rays = ranks.first(next_rays(rays, made.samples, rays=512, **most))
with optimizer.averaged():
    sampler.finish(router, seed=0)
    psnr = mean_scores(evaluate(renderer, scene, views=20))["psnr"]
print(f"{step} steps, {router.num_cells} cells, PSNR {psnr:.2f}")
