"""The error of a scene that cannot be read."""


class SceneError(ValueError):
    """An unusable scene; the message is one line and names the file."""
