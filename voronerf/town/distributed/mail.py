"""What territories send each other: every part has a key, and a rank that sends it and one that gets it.

n rows of a part, c columns. A part for the same rank is not sent. All parts for one other rank are one message.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.town.distributed.group import Group

#: Of a part: the territory, or the rank, that it is from, and the territory that it is for.
Key = tuple[int, int]


class Route(NamedTuple):
    """A way of a part.

    Attributes:
        source: The rank that sends it.
        target: The rank that gets it.
        key: What it is called.
    """

    source: int
    target: int
    key: Key

    def back(self) -> Route:
        """The way of the answer."""
        return Route(self.target, self.source, self.key)


def send(
    group: Group, kind: str, width: int, parts: Mapping[Key, Tensor], routes: Sequence[Route]
) -> dict[Key, Tensor]:
    """Sends the parts of this rank, and returns those that others have sent it.

    Args:
        group: The ranks.
        kind: What the parts are.
        width: c.
        parts: float32 [n, c] by key; none is an empty part.
        routes: All that begin or end here, in an order that both ends have.

    Returns:
        For each key whose route ends here its part, in the order of the routes.

    Examples:
        >>> import torch
        >>> from voronerf.town.distributed.group import Group
        >>> from voronerf.town.distributed.mail import Route, send
        >>> send(Group(torch.device("cpu")), "news", 1, {(0, 1): torch.ones(1, 1)}, [Route(0, 0, (0, 1))])
        {(0, 1): tensor([[1.]])}
    """
    empty = torch.empty(0, width, device=group.device)
    here = _coming(group, routes)
    there: dict[int, list[Tensor]] = defaultdict(list)
    found: dict[Key, Tensor] = {}
    for source, target, key in routes:
        if source == target:
            found[key] = parts.get(key, empty)
        elif source == group.rank:
            there[target].append(parts.get(key, empty))
    came = group.exchange(kind, width, there, {source: len(keys) for source, keys in here.items()})
    for source, keys in here.items():
        found.update(zip(keys, came[source], strict=True))
    return {key: found[key] for _, target, key in routes if target == group.rank}  # in an order that no rank decides


def expect(group: Group, kind: str, width: int, routes: Sequence[Route]) -> None:
    """Asks for what the next :func:`send` of a kind brings, which then comes while this rank computes.

    Args:
        group: The ranks.
        kind: As there.
        width: c, as there.
        routes: As there.
    """
    group.expect(kind, width, {source: len(keys) for source, keys in _coming(group, routes).items()})


def _coming(group: Group, routes: Sequence[Route]) -> dict[int, list[Key]]:
    """The keys of the parts that other ranks send this one, by rank."""
    here: dict[int, list[Key]] = defaultdict(list)
    for source, target, key in routes:
        if source != target == group.rank:
            here[source].append(key)
    return here
