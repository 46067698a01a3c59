"""Hooks of the site: generates pages from the code, cleans docstring markup, converts formulas, and adds scene.html."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import options
import scene
from latex2mathml.converter import convert
from mkdocs.structure.files import File

import voronerf

MARKER = "<!-- options -->"


def on_files(files: Any, *, config: Any) -> Any:
    """Adds the page of a scene that the browser renders."""
    files.append(File.generated(config, "scene.html", abs_src_path=str(scene.scene_page())))
    return files


def on_config(config: Any) -> Any:
    """Adds the version to the footer of each page."""
    config.copyright = f"voronerf {voronerf.__version__}"
    return config


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Replaces `MARKER` in docs/options.md by the tables of options."""
    if page.file.src_uri == "options.md":
        assert MARKER in markdown, f"docs/options.md must hold {MARKER}"
        return markdown.replace(MARKER, options.markdown())
    return markdown


def on_page_content(content: str, **_: Any) -> str:
    """Converts formulas to MathML, which browsers render, and drops Sphinx roles of docstrings such as :class:."""
    content = re.sub(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', _formula, content, flags=re.DOTALL)
    return re.sub(r":(?:class|meth|func|mod|attr|data):<code>~?", "<code>", content)


def _formula(found: re.Match[str]) -> str:
    return str(convert(html.unescape(found[2]), display="inline" if found[1] == "span" else "block"))
