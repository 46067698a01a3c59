"""Rules of the words of docstrings, comments and pages that a program can check; CONTRIBUTING.md has the others."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# First words that leave a reader without a subject.
OF_DOCSTRING = re.compile(r"(What|Whether|Where|Of|Those|That|As|From|How|Which)\b")
OF_COMMENT = re.compile(r"(What|Whether|Of|Those|That of)\b")
OF_ARGUMENT = re.compile(r"(?i)\s+`*\*{0,2}\w+`*(?: \([^)]*\))?: (of|what|where|those|that|as|from|how|which)\b")
WITHOUT_NOUN = re.compile(r"(?i)\b(that|those) of\b")
SUFFIXES = {".py": "#", ".h": "//", ".cpp": "//", ".cu": "//", ".wgsl": "//", ".js": "//", ".md": None}
FOLDERS = ("voronerf", "kernels", "csrc", "tests", "benchmarks", "examples", "docs", ".ci")


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Yields line and text of every docstring, of attributes too."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield statement.lineno, text


def comments(source: str, mark: str) -> Iterator[tuple[int, str]]:
    """Yields line and text of every block of lines that hold only a comment."""
    block: list[str] = []
    for number, line in enumerate([*source.splitlines(), ""], 1):
        if line.strip().startswith(mark):
            block.append(line.strip().lstrip("#/: "))
        elif block:
            yield number - len(block), "\n".join(block)
            block = []


def faults(path: Path, source: str) -> list[str]:
    """Returns a message with the line number for each broken rule in a file."""
    mark = SUFFIXES[path.suffix]
    texts = [(line, text, OF_DOCSTRING) for line, text in docstrings(source)] if path.suffix == ".py" else []
    texts += [(line, text, OF_COMMENT) for line, text in comments(source, mark)] if mark else [(1, source, None)]
    result = []
    for line, text, first in texts:
        if first is not None and (word := first.match(text.strip())):
            result.append(f"{path}:{line}: begins with {word[0]!r}")
        for number, row in enumerate(text.splitlines(), line):
            if path.suffix == ".py" and (word := OF_ARGUMENT.match(row)):
                result.append(f"{path}:{number}: an argument begins with {word[1]!r}")
            result += [f"{path}:{number}: {words[0]!r} has no noun" for words in WITHOUT_NOUN.finditer(row)]
    return result


def test_words() -> None:
    pages = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG", "SECURITY")]
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")) if path.suffix in SUFFIXES]
    assert len(files) > 500
    found = [fault for path in [*pages, *files] if path != Path(__file__) for fault in faults(path, path.read_text())]
    assert not found, "\n".join(found)


def test_every_rule_finds_its_fault() -> None:
    function = 'def f():\n    """Returns that of y.\n\n    Args:\n        x: of y\n    """\n'
    source = f'"""Of a file."""\n# What is kept.\n{function}'
    assert [fault.split(": ", 1)[1] for fault in faults(Path("x.py"), source)] == [
        "begins with 'Of'",
        "'that of' has no noun",
        "an argument begins with 'of'",
        "begins with 'What'",
    ]
    assert faults(Path("x.md"), "# Title\n\nThose of a page") == ["x.md:3: 'Those of' has no noun"]
    assert faults(Path("x.cu"), "  // Whether it is.\n") == ["x.cu:1: begins with 'Whether'"]
