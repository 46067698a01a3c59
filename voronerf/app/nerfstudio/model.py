"""The model: connects voronerf's networks, renderer, occupancy grid and splits with nerfstudio's rays and losses."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Literal

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.model_components import renderers
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils import colormaps
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from voronerf.app.evaluate.panels import palette
from voronerf.app.nerfstudio.scene import scene_of, seen_from_inside
from voronerf.app.train.build import make_grid, make_renderer, make_routers
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.defaults import resolve
from voronerf.nerf import Batch, RayLoss, Rays, RenderOutput, SplitStrategy, intersect_box
from voronerf.nerf.adam import parameter_groups


@dataclasses.dataclass
class VoronerfModelConfig(ModelConfig):
    """Settings of the model, named as in ``voronerf train``."""

    _target: type = dataclasses.field(default_factory=lambda: VoronerfModel)
    enable_collider: bool = False
    """Not used: the scene gives near and far."""
    eval_num_rays_per_chunk: int = 1 << 15
    field: str = "hashgrid"
    """Kind of network: hashgrid, nerf, mipnerf or kilonerf."""
    field_options: tuple[str, ...] = ()
    """Further options of the field, each as NAME=VALUE, such as log2_entries=19."""
    width: int | None = None
    """Channels of the networks' hidden layers; default: the field's default."""
    cells: tuple[int, ...] = (16,)
    """Cells per level: `16` is 16 cells, `16 16` splits each of them into 16 again."""
    split_at: tuple[float, ...] | None = None
    """When to split, as fractions of max_num_iterations, one per level; default: 0.2 for one level, evenly spaced from
    0.15 to 0.5 for several levels."""
    sampling: str = "stratified"
    """Samples along a ray: stratified in one pass, or hierarchical, with a second pass where the first pass has large
    weights."""
    samples: tuple[int, ...] | None = None
    """Samples per ray of each pass; default: depends on the cameras if empty space is skipped, else 64 for one pass, or
    32 and 32 for two passes."""
    contraction: Literal["auto", "none", "sphere"] = "auto"
    """The rendered space: only the scene box (none), or all of space, contracted outside of a sphere into a shell
    (sphere); auto is none if all cameras stand outside of the box, else sphere."""
    occupancy: bool = True
    """Skip empty space. It has no effect with hierarchical sampling, or for the field mipnerf."""

    def train_config(self, *, contracted: bool) -> TrainConfig:
        """Returns the corresponding settings of ``voronerf train``."""
        return TrainConfig(
            seed=torch.initial_seed() % 2**31,
            field=self.field,
            field_options=self.field_options,
            width=self.width,
            cells=self.cells,
            split_at=self.split_at,
            sampling=self.sampling,
            samples=self.samples,
            contraction="sphere" if contracted else "none",
            occupancy=self.occupancy,
        )


class VoronerfModel(Model):
    """The model: renders nerfstudio's rays by a network per Voronoi cell, and splits the cells during training.

    The metadata of the training images must hold their ``cameras``, and may hold a ``background`` [3] in 0..1.
    """

    config: VoronerfModelConfig

    def populate_modules(self) -> None:
        """Builds the networks (with one cell), grid, renderer and split strategy from the cameras and the scene box."""
        super().populate_modules()
        metadata, device = self.kwargs["metadata"], self.kwargs["device"]
        cameras, box = metadata["cameras"], self.scene_box.aabb
        auto = self.config.contraction == "auto"
        contracted = seen_from_inside(cameras, box) if auto else self.config.contraction == "sphere"
        self.scene = scene_of(cameras, box, contracted=contracted)
        self.settings = resolve(self.config.train_config(contracted=contracted), self.scene)
        self.bounds = None if self.scene.box is None else self.scene.box.to(device)
        background = metadata.get("background")
        self.background = None if background is None else background.to(device)
        self.routers = make_routers(self.settings, device)
        self.networks = nn.ModuleDict(self.routers)  # registers the parameters
        grid = make_grid(self.settings, self.scene, device) if self.settings.occupancy else None
        self.renderer = make_renderer(self.settings, self.scene, self.routers, grid=grid)
        self.ray_loss = RayLoss(self.renderer)
        self.generator = torch.Generator().manual_seed(self.settings.seed)
        self.strategy = SplitStrategy(
            self.routers, self.settings.plan, centres=self.settings.centres, generator=self.generator
        )
        self._output: RenderOutput | None = None

    @property
    def num_cells(self) -> int:
        """The number of cells of the diagram."""
        return self.routers["field"].num_cells

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Returns the parameter groups: "fields", the networks, and "tables", the tables of hash grids if any."""
        dense, tables = parameter_groups(self.routers, self.settings.field_type.sparse_parameters)
        return {"fields": dense, "tables": tables} if tables else {"fields": dense}

    # --- training --------------------------------------------------------------------------------------------------

    def get_training_callbacks(self, training_callback_attributes: TrainingCallbackAttributes) -> list[Any]:
        """Returns the callbacks before and after each step of nerfstudio's trainer."""
        trainer, optimizers = training_callback_attributes.trainer, training_callback_attributes.optimizers
        assert trainer is not None and optimizers is not None
        steps, optimizer = trainer.config.max_num_iterations, optimizers.optimizers["fields"]

        def before(step: int) -> None:
            result = self.strategy.step_pre_backward(optimizer, step / steps, step)
            if result is not None and not result.split.balances:
                kept = len(result.points)
                CONSOLE.log(f"voronerf: no cell split at step {step}, none holds enough of the {kept} samples")
            elif result is not None:  # parameters stay the same objects, with other shapes
                CONSOLE.log(f"voronerf: {self.num_cells} cells at step {step}")
            self.renderer.sampler.step_pre_backward(self.renderer.field, step, self.generator)
            if not self.routers["field"].training:  # after a split or a rendered picture
                self.renderer.train()

        def after(step: int) -> None:
            output, self._output = self._output, None
            assert output is not None
            self.renderer.sampler.step_post_backward(output)
            self.strategy.step_post_backward(output)

        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before, update_every_num_iters=1),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after, update_every_num_iters=1),
        ]

    # --- rays ------------------------------------------------------------------------------------------------------

    def _rays(self, bundle: RayBundle) -> tuple[Rays, Tensor, Tensor]:
        """Converts nerfstudio's rays; also returns the distances [r], [r] at which they enter and leave the scene."""
        # A cone's radius is 2 / sqrt(12) of the width of its pixel (mip-NeRF, section 3.1).
        radii = (bundle.pixel_area[:, 0] / 3).sqrt() if self.renderer.cones else None
        rays = Rays(bundle.origins, bundle.directions, radii)
        near, far, _ = intersect_box(rays.origins, rays.directions, self.bounds, self.scene.near, self.scene.far)
        if bundle.nears is not None and bundle.fars is not None:  # the crop box of the viewer
            near = near.maximum(bundle.nears[:, 0])
            far = far.minimum(bundle.fars[:, 0]).maximum(near)
        return rays, near, far

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Returns colour, accumulation and depth of rays, and ``cells``, the colour of the cell that each ray shows.

        In training, returns the rays: they are rendered together with the loss, see :meth:`get_loss_dict`.
        """
        rays, near, far = self._rays(ray_bundle)
        return {"rays": (rays, near, far)} if self.training else self._see(rays, near, far)

    @torch.no_grad()
    def _see(self, rays: Rays, near: Tensor, far: Tensor) -> dict[str, Tensor]:
        colour, opacity, depth, places = self.renderer.render_colours(rays, near, far)
        background = renderers.BACKGROUND_COLOR_OVERRIDE  # set by the viewer and by ns-render
        background = self.background if background is None else background.to(colour)
        cells = self.routers["field"].diagram.locate(places)
        colours = palette(self.num_cells).to(colour)[cells.long()] / 255
        return {
            "rgb": _over(colour, opacity, background).clamp(0, 1),
            "accumulation": opacity[:, None],
            "depth": depth[:, None],
            "cells": _over(colours * opacity[:, None], opacity, torch.ones_like(colours[0])),
        }

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Returns an RGBA image [h, w, 4] without its background, for ``ns-export``."""
        opacity = outputs["accumulation"]
        behind = 0.0 if self.background is None else self.background * (1 - opacity)
        return torch.cat(((outputs[output_name] - behind) / opacity.clamp_min(1e-10), opacity), dim=-1).clamp(0, 1)

    # --- losses and scores -----------------------------------------------------------------------------------------

    def _truth(self, batch: dict[str, Tensor], background: Tensor | None) -> Tensor:
        """Returns the colours [..., 3] of a batch; images with an alpha channel are composited over a background."""
        image = batch["image"].to(self.device)
        return image if image.shape[-1] == 3 else _over(image[..., :3] * image[..., 3:], image[..., 3], background)

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Returns the loss of voronerf's trainer; images with an alpha channel get a random background per ray."""
        if "rays" not in outputs:
            return {"rgb_loss": (outputs["rgb"] - self._truth(batch, self.background)).square().mean()}
        return {"rgb_loss": self._learn(outputs, batch).loss}

    def _learn(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> RenderOutput:
        """Runs RayLoss once per batch and caches it in `outputs`, for both the loss and the metrics."""
        if "render" not in outputs:
            rays, near, far = outputs["rays"]
            background = self.background if batch["image"].shape[-1] == 3 else torch.rand_like(rays.origins)
            target = self._truth(batch, background)
            outputs["render"] = self._output = self.ray_loss(Batch(rays, near, far, target, background))
        output: RenderOutput = outputs["render"]
        return output

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns the PSNR in dB of a batch of rays, and the number of cells."""
        if "rays" in outputs:
            error = self._learn(outputs, batch).error.mean() / 3
        else:
            error = (outputs["rgb"] - self._truth(batch, self.background)).square().mean()
        return {"psnr": -10 * error.log10(), "cells": torch.tensor(float(self.num_cells))}

    @functools.cached_property  # not in the model's state; downloads its weights on first use
    def lpips(self) -> nn.Module:
        """The LPIPS metric, as in nerfstudio's other methods."""
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        return LearnedPerceptualImagePatchSimilarity(normalize=True).to(self.device)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Returns PSNR, SSIM and LPIPS of an image, and pictures: truth beside render, accumulation, depth, cells."""
        from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

        truth, rgb, opacity = self._truth(batch, self.background), outputs["rgb"], outputs["accumulation"]
        pair = tuple(image.movedim(-1, 0)[None] for image in (truth, rgb))
        scores = {
            "psnr": float(peak_signal_noise_ratio(*pair, data_range=1.0)),
            "ssim": float(structural_similarity_index_measure(*pair, data_range=1.0)),
            "lpips": float(self.lpips(*pair)),
        }
        pictures = {
            "img": torch.cat((truth, rgb), dim=1),
            "accumulation": colormaps.apply_colormap(opacity),
            "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=opacity),
            "cells": outputs["cells"],
        }
        return scores, pictures

    # --- checkpoints -----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the state that nerfstudio's checkpoints hold beside the parameters and the diagram."""
        grid = self.renderer.occupancy
        return {
            "strategy": self.strategy.state_dict(),
            "occupancy": None if grid is None else grid.state_dict(),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`get_extra_state`; the cells are restored with the parameters and the diagram."""
        self.strategy.load_state_dict(state["strategy"])
        if self.renderer.occupancy is not None and state["occupancy"] is not None:
            self.renderer.occupancy.load_state_dict(state["occupancy"])


def _over(colour: Tensor, opacity: Tensor, background: Tensor | None) -> Tensor:
    """Composites colours [..., 3], multiplied by opacity [...], over a background [3] or [..., 3]; None is black."""
    return colour if background is None else colour + (1 - opacity[..., None]) * background
