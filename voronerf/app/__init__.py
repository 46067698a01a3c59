"""The application: scenes, trainings, pictures, scores, exports, a viewer and the command line."""

from voronerf.app.run import Run, open_run

__all__ = ["Run", "open_run"]
