"""The whole method as a training run: configuration, batches, trainer, splits, checkpoints, evaluation, pictures."""
