"""What makes training pictures of one scene differ in colour: exposure and white balance.

c training pictures, r rays of a batch. Colours are in 0..1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from voronerf.nerf import Batch

#: Steps before pictures get colours of their own, and how many steps back what is remembered of a picture has faded.
START, MEMORY = 1000, 256
#: The least and the largest gain.
GAINS = 1 / 8, 8.0


class Appearance:
    """A gain for each channel of each training picture: the picture is the field's colours times its gains.

    The geometric mean of all pictures is 1, so that the field has their average look. Batches have the colours of
    their pictures divided by the gains, and so every way to a loss learns from them. The gains are those with the least
    squared error to what the field shows along the latest rays of a picture, which is a division of two sums.

    Attributes:
        gains: [c, 3].
        sums: [c, 6], of the products of seen and true colours, and of the squares of the seen ones.
        steps: Batches that were learnt from.

    Args:
        pictures: c.
        device: Where batches live.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays
        >>> from voronerf.nerf import Batch
        >>> from voronerf.app.train.appearance import START, Appearance
        >>> appearance = Appearance(2, torch.device("cpu"))
        >>> rays, ends = Rays(torch.zeros(2, 3), torch.eye(3)[:2]), torch.ones(2)
        >>> dark_and_bright = torch.tensor([[0.2], [0.8]]).expand(2, 3)
        >>> for _ in range(START + 1):
        ...     batch = appearance.neutral(Batch(rays, ends, ends, dark_and_bright, view=torch.tensor([0, 1])))
        ...     appearance.learn(batch, torch.full((2, 3), 0.4))
        >>> appearance.gains[:, 0], batch.target[:, 0]
        (tensor([0.5000, 2.0000]), tensor([0.4000, 0.4000]))
    """

    def __init__(self, pictures: int, device: torch.device) -> None:
        self.gains = torch.ones(pictures, 3, device=device)
        self.sums = torch.zeros(pictures, 6, device=device)
        self.steps = 0

    def neutral(self, batch: Batch) -> Batch:
        """A batch as if all its pictures had gains of 1."""
        if self.steps < START:
            return batch
        assert batch.view is not None
        return replace(batch, target=batch.target / self.gains.index_select(0, batch.view))

    def learn(self, batch: Batch, seen: Tensor) -> None:
        """Finds the gains anew.

        Args:
            batch: Of :meth:`neutral`.
            seen: [r, 3], the colours of the rays as the field shows them.
        """
        assert batch.view is not None
        target = batch.target
        if self.steps >= START:
            target = target * self.gains.index_select(0, batch.view)
        products = torch.cat((seen * target, seen * seen), 1).nan_to_num_(0.0, 0.0, 0.0)  # of steps that are left out
        place = (batch.view * 6)[:, None] + torch.arange(6, device=batch.view.device)
        self.sums.mul_(1 - 1 / MEMORY).view(-1).index_add_(0, place.view(-1), products.view(-1))
        self.steps += 1
        if self.steps >= START:
            both, squares = self.sums.split(3, 1)
            gains = torch.where(squares > 0, both / squares, 1).clamp(*GAINS).log()
            self.gains.copy_((gains - gains.mean(0)).exp())

    def state_dict(self) -> dict[str, Tensor]:
        """All that changes."""
        return {"gains": self.gains, "sums": self.sums, "steps": torch.tensor(self.steps)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes what :meth:`state_dict` gave."""
        self.gains.copy_(state["gains"])
        self.sums.copy_(state["sums"])
        self.steps = int(state["steps"])
