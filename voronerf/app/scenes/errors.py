"""The error of a scene that cannot be read."""


class SceneError(ValueError):
    """The data of a scene cannot be used. The message is one line and names the file."""
