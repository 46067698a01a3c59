"""The viewer in a browser: ``voronerf view`` and ``voronerf train --view``. It needs viser, the extra ``viewer``."""

from voronerf.viewer.training import TrainingViewer
from voronerf.viewer.viewer import Viewer, check_address, view_run

__all__ = ["TrainingViewer", "Viewer", "check_address", "view_run"]
