"""The application: scenes, trainings, pictures, scores, exports, a viewer and the command line.

It needs the extra ``app``; every part needs Pillow and safetensors, which are therefore checked here.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from voronerf.app.run import Run, open_run

__all__ = ["Run", "open_run"]

PACKAGES = ("PIL", "safetensors", "imageio_ffmpeg", "matplotlib", "rich", "tyro")


def require(*packages: str) -> None:
    """Raises an ImportError that names all missing packages and the extra ``app``, if one of `packages` is missing."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if not set(packages).isdisjoint(missing):
        raise ImportError(f"the command line and voronerf.app need {', '.join(missing)}: pip install 'voronerf[app]'")


require("PIL", "safetensors")


def __getattr__(name: str) -> Any:
    """Imports a public name on its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'voronerf.app' has no attribute {name!r}")
    from voronerf.app import run

    return getattr(run, name)
