"""The files that meshes and points are written to."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from voronerf.files import write_bytes

#: Packages of the extra `export`: the name that is imported, and the name that is installed.
PACKAGES = {"trimesh": "trimesh", "skimage": "scikit-image", "scipy": "scipy"}


def check_export(path: Path, suffixes: tuple[str, ...]) -> None:
    """Finds out before the work is done whether a file can be written; makes its folder.

    Raises:
        ValueError: a suffix that is none of ``suffixes``.
        ImportError: a package of the extra is missing.
        OSError: the folder cannot be made.
    """
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the file must end in {' or '.join(suffixes)}")
    for module, package in PACKAGES.items():
        try:
            importlib.import_module(module)
        except ImportError:
            raise ImportError(f"an export needs {package}: pip install 'voronerf[export]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)


def write_geometry(path: Path, geometry: Any, **options: Any) -> None:
    """Writes a mesh, points or a scene of trimesh in the format of the suffix, whole or not at all."""
    data = geometry.export(file_type=path.suffix[1:].lower(), **options)
    write_bytes(path, data.encode() if isinstance(data, str) else data)
