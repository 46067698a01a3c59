"""Fills the pages of the site that come from the code, cleans what docstrings leave in them, and adds a scene."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import options
import scene
from mkdocs.structure.files import File

import voronerf

MARKER = "<!-- options -->"


def on_files(files: Any, *, config: Any) -> Any:
    """Adds the page of a scene, which is drawn in the browser."""
    files.append(File.generated(config, "scene.html", abs_src_path=str(scene.scene_page())))
    return files


def on_config(config: Any) -> Any:
    """Says the version at the foot of each page."""
    config.copyright = f"voronerf {voronerf.__version__}"
    return config


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Replaces the marker by the tables of options."""
    if page.file.src_uri == "options.md":
        assert MARKER in markdown, f"docs/options.md must hold {MARKER}"
        return markdown.replace(MARKER, options.markdown())
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Drops the roles of cross-references in docstrings, such as :class:, which only Sphinx reads."""
    return re.sub(r":(?:class|meth|func|mod|attr|data):<code>~?", "<code>", html)
