"""The viewer in a browser: ``voronerf view`` and ``voronerf train --view``. It needs viser, the extra ``viewer``."""

from voronerf.app.viewer.pictures import Subject
from voronerf.app.viewer.training import Training, watch
from voronerf.app.viewer.viewer import Viewer, check_address, view_run

__all__ = ["Subject", "Training", "Viewer", "check_address", "view_run", "watch"]
