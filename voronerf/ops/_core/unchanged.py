"""One question for routers, fields and steps: is what a result was made for as it was?"""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import backends


class Never:
    """The answer without the compiled module: nothing is known to be as it was, and what depends on it is looked at
    again in every call."""

    def holds(self) -> bool:
        """Whether all that was noted is as it was."""
        return False

    def _note(self, *noted: Any) -> None:
        """Forgets it."""

    contents = entries = attributes = answer = place = layout = kind = _note


def unchanged() -> Any:
    """A guard that has noted nothing yet (csrc/bindings/unchanged.h says of what it can take note)."""
    module = backends.compiled()
    return Never() if module is None else module.compiled.Unchanged()
