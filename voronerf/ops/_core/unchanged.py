"""Guards of cached results: have the objects that a result depends on changed? Used by routers, fields and steps."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import backends


class Never:
    """A guard for use without the compiled module; `holds` is always False, so every call checks its dependencies."""

    def holds(self) -> bool:
        """Returns False, since this guard notes no objects."""
        return False

    def _note(self, *noted: Any) -> None:
        """Ignores the objects."""

    contents = entries = attributes = answer = place = layout = kind = _note


def unchanged() -> Any:
    """Creates an empty guard; csrc/bindings/unchanged.h lists the properties that it can note."""
    module = backends.compiled()
    return Never() if module is None else module.compiled.Unchanged()
