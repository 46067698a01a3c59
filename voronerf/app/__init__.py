"""The application: scenes, trainings, pictures, scores, exports, a viewer and the command line."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from voronerf.app.run import Run, open_run

__all__ = ["Run", "open_run"]


def __getattr__(name: str) -> Any:
    """Imports a public name on its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'voronerf.app' has no attribute {name!r}")
    from voronerf.app import run

    return getattr(run, name)
