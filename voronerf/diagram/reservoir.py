"""Keeps the samples that contribute most to the error of the rendered image.

The importance of a sample is `w * E(r)`: its weight in its ray times the squared colour error of the ray (Elsner et al.
2023, section 3.1). About 10,000 samples are kept per epoch: the heaviest samples of every batch, in equal numbers, so
that all batches count equally.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from voronerf.ops.keep_heaviest import keep_heaviest


class SampleReservoir:
    """The heaviest samples of the last `batches` batches.

    Every batch contributes its `quota = ceil(capacity / batches)` heaviest samples, or all of its samples if they are
    fewer. The samples of at most `batches` batches are held; each further batch replaces the oldest batch.
    Samples with an importance of 0, or with a position or importance that is not finite, are not kept. A heavy sample
    with a position that is not finite still counts towards the quota.

    `add` reads no device value on the host, so a training loop on the host can run ahead of the GPU.

    Attributes:
        capacity: the requested number of samples.
        batches: the number of batches that share the capacity: the batches of one epoch, or the batches between two
            subdivisions.
        quota: the number of samples kept of each batch.

    Examples:
        >>> import torch
        >>> from voronerf import SampleReservoir
        >>> reservoir = SampleReservoir(capacity=4, batches=2)  # the 2 heaviest samples of each of the last 2 batches
        >>> points = torch.arange(9.0).reshape(3, 3)
        >>> reservoir.add(points, torch.tensor([0.1, 0.7, 0.5]))
        >>> kept, importance = reservoir.samples()
        >>> importance
        tensor([0.7000, 0.5000])
        >>> len(reservoir)
        2
    """

    @torch.inference_mode(False)
    def __init__(
        self, capacity: int = 10_000, batches: int = 100, *, d: int = 3, device: torch.device | str = "cpu"
    ) -> None:
        """Makes an empty reservoir of `capacity` samples with d coordinates, for `batches` batches.

        Raises:
            ValueError: A number is below 1.
        """
        if min(capacity, batches, d) < 1:
            came = f"{capacity}, {batches} and {d}"
            raise ValueError(f"SampleReservoir: capacity, batches and d must be at least 1, got {came}")
        self.capacity, self.batches = capacity, batches
        self.quota = -(-capacity // batches)
        self._points = torch.zeros(batches, self.quota, d, dtype=torch.float32, device=device)
        self._importance = torch.zeros(batches, self.quota, dtype=torch.float32, device=device)
        self._added = torch.zeros(1, dtype=torch.int64, device=device)  # the op reads it on the device

    @torch.no_grad()
    def add(
        self,
        points: Tensor,
        importance: Tensor,
        *,
        error: Tensor | None = None,
        ray_index: Tensor | None = None,
        backend: str = "auto",
    ) -> None:
        """Keeps the heaviest samples of one batch; ties go to the first sample.

        Args:
            points: floating [..., d], scene units.
            importance: floating [...], the importance of each sample, on any scale, since only ratios count. With
                ``error``, the weight w of each sample instead, which is multiplied by the error of the sample's ray.
            error: floating [r], the error E of each ray; None counts as 1.
            ray_index: int32 [m], the ray of each of m samples; required with ``error``.
            backend: the backend of the op.

        Raises:
            ValueError: Shapes do not match.
        """
        d = self._points.shape[-1]
        if points.dim() == 0 or points.shape[-1] != d or points.shape[:-1] != importance.shape:
            raise ValueError(
                f"SampleReservoir.add: points must have shape [..., {d}] and importance the same without the {d}, "
                f"got {list(points.shape)} and {list(importance.shape)}"
            )
        device = self._points.device
        points = points.reshape(-1, d).to(device, torch.float32)
        importance = importance.reshape(-1).to(device, torch.float32)
        error = None if error is None else error.to(device, torch.float32)
        index = None if ray_index is None else ray_index.to(device)
        kept = self._points, self._importance, self._added
        keep_heaviest(*kept, points, importance, error=error, ray_index=index, backend=backend)

    def samples(self) -> tuple[Tensor, Tensor]:
        """Returns the kept samples, oldest batch first; m = 0 before the first batch.

        Returns:
            Points float32 [m, d], and importance float32 [m], all > 0.
        """
        added = int(self._added)
        start = added % self.batches if added > self.batches else 0
        importance = self._importance.roll(-start, 0).reshape(-1)
        kept = importance > 0
        return self._points.roll(-start, 0).flatten(0, 1)[kept], importance[kept]

    def __len__(self) -> int:
        return int((self._importance > 0).sum())

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the tensors from which `load_state_dict` restores the reservoir, bit for bit."""
        return {
            "points": self._points.clone(),
            "importance": self._importance.clone(),
            "added": self._added[0].clone(),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the state of a reservoir with the same capacity and number of batches.

        Raises:
            ValueError: an entry is missing, or the capacity or number of batches differs.
        """
        missing = [name for name in ("points", "importance", "added") if name not in state]
        if missing:
            raise ValueError(
                f"SampleReservoir: state must hold {', '.join(missing)}, got {', '.join(state) or 'nothing'}"
            )
        for name, table in (("points", self._points), ("importance", self._importance)):
            if state[name].shape != table.shape:
                raise ValueError(
                    f"SampleReservoir: {name} must have shape {list(table.shape)} (batches, quota), "
                    f"got {list(state[name].shape)}"
                )
        self._points.copy_(state["points"])
        self._importance.copy_(state["importance"])
        self._added.fill_(int(state["added"]))
