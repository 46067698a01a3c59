"""The registration of the method, for nerfstudio's entry point ``nerfstudio.method_configs``."""

from __future__ import annotations

import dataclasses
from typing import Any

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from voronerf.app.nerfstudio.model import VoronerfModelConfig
from voronerf.app.nerfstudio.optimizers import AdamConfig, DecaySchedulerConfig


@dataclasses.dataclass
class VoronerfDataManagerConfig(VanillaDataManagerConfig):
    """Settings of the data manager, which passes the cameras to the model."""

    _target: type = dataclasses.field(default_factory=lambda: VoronerfDataManager)
    train_num_rays_per_batch: int = 4096
    eval_num_rays_per_batch: int = 4096


class VoronerfDataManager(VanillaDataManager[InputDataset]):
    """Adds the training cameras and the background colour to the metadata for the model."""

    def create_train_dataset(self) -> InputDataset:
        """Returns the training images, with cameras and background in the metadata."""
        dataset = super().create_train_dataset()
        alpha_color = self.train_dataparser_outputs.alpha_color
        dataset.metadata.update(cameras=dataset.cameras, background=alpha_color)
        return dataset


@dataclasses.dataclass
class VoronerfTrainerConfig(TrainerConfig):
    """Settings of nerfstudio's trainer; schedulers without ``max_steps`` take the number of iterations."""

    def setup(self, **options: Any) -> Any:
        """Returns the trainer."""
        for group in self.optimizers.values():
            if group["scheduler"] is not None and group["scheduler"].max_steps is None:
                group["scheduler"].max_steps = self.max_num_iterations
        return super().setup(**options)


method = MethodSpecification(
    VoronerfTrainerConfig(
        method_name="voronerf",
        max_num_iterations=30_000,
        steps_per_eval_batch=500,
        steps_per_save=2000,
        pipeline=VanillaPipelineConfig(
            datamanager=VoronerfDataManagerConfig(dataparser=NerfstudioDataParserConfig()), model=VoronerfModelConfig()
        ),
        optimizers={
            "fields": {"optimizer": AdamConfig(), "scheduler": DecaySchedulerConfig()},
            "tables": {"optimizer": AdamConfig(sparse=True), "scheduler": DecaySchedulerConfig()},
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Adaptive Voronoi NeRFs: one small network for each Voronoi cell of space.",
)
