"""Tests of the layers of the code, read from the sources: a module imports only its own layer and lower ones."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# The layers from the bottom up: the library (ops to nerf), the application, scenes made of several runs (editing). A
# "room" is a member of a layer. A module may import from its own room and from rooms of lower layers.
LAYERS = (
    {"ops._core"},
    {"ops", "kernels"},
    {"diagram"},
    {"router"},
    {"nerf"},
    {"app.files", "app.wording"},
    {"app.scenes"},
    {"app.render", "app.evaluate"},
    {"app.train"},
    {"app.run", "app"},
    {"app.export", "app.web"},
    {"app.viewer"},
    {"editing"},
    {"app.cli"},
    {"__init__", "__main__"},
)
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
# The only external packages that a room may import.
OUTSIDE = {"kernels": {"warp", "torch"}}
OUTSIDE |= {room: {"torch"} for room in ("ops._core", "ops", "diagram", "router", "nerf")}
STANDARD_OF_ISA_FILES = {"cstdint", "cstddef", "immintrin.h", "arm_neon.h"}

SOURCES = sorted([*(ROOT / "voronerf").rglob("*.py"), *(ROOT / "kernels").rglob("*.py")])
CORE = sorted(path for path in (ROOT / "csrc").rglob("*") if path.is_file())


def module_name(path: Path) -> str:
    """Returns the dotted name of a module; kernels/ is installed as voronerf.kernels."""
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts if parts[0] == "voronerf" else ["voronerf", *parts])


def room(module: str) -> str:
    """Returns the room (member of a layer) of a module: voronerf.ops.resample -> ops, voronerf -> __init__."""
    parts = module.split(".")
    member = ".".join(parts[1:3])
    return member if member in LEVEL else parts[1] if len(parts) > 1 else "__init__"


def imports(source: str, module: str) -> list[tuple[int, str]]:
    """Returns (line, dotted name) of all imports, also nested ones; names of a package count as modules."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: -node.level]
                base = ".".join([*package, base] if base else package)
            if base in ("voronerf", "voronerf.app") or base.startswith("voronerf.ops"):
                names += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
            else:
                names.append((node.lineno, base))
    return names


def faults(source: str, module: str) -> list[str]:
    """Returns error messages about the imports of one file."""
    importer, wrong = room(module), []
    if importer not in LEVEL:
        return [f"{module} belongs to no layer; name it in LAYERS"]
    for line, name in imports(source, module):
        if name.split(".")[0] != "voronerf":
            allowed = OUTSIDE.get(importer)
            top = name.split(".")[0]
            if allowed is not None and top not in allowed | sys.stdlib_module_names:
                wrong.append(f"{module}:{line} imports {top}; {importer} may import {' and '.join(sorted(allowed))}")
            continue
        # Names of the package itself, such as __version__, are not modules.
        target = room(name)
        if name != "voronerf" and target.startswith("__") and target != "__main__":
            continue
        if target not in LEVEL:
            wrong.append(f"{module}:{line} imports {name}, which belongs to no layer")
        elif LEVEL[target] > LEVEL[importer]:
            wrong.append(f"{module}:{line} imports {name} from a layer above")
        if name.endswith("._C") and not module.startswith("voronerf.ops._core.native"):
            wrong.append(f"{module}:{line} imports the compiled module, which only native may")
        if target == "ops" and "reference" in name.split(".") and importer not in ("ops", "kernels"):
            wrong.append(f"{module}:{line} imports {name}, a specification that only ops read")
    return wrong


def test_imports_go_down() -> None:
    assert [fault for path in SOURCES for fault in faults(path.read_text(), module_name(path))] == []


def test_backends_alone_choose() -> None:
    """Only a few rooms ask whether a backend is available; other code leaves the choice to the table of backends."""
    asking = [
        path
        for path in SOURCES
        if re.search(r"backends\.missing|from voronerf\.ops\._core\.backends import .*missing", path.read_text())
    ]
    assert {room(module_name(path)) for path in asking} <= {"ops._core", "app.cli", "kernels"}, asking


@pytest.mark.parametrize(
    ("source", "module", "fault"),
    [
        ("from voronerf.router import VoronoiRouter", "voronerf.ops.nearest_centre", "from a layer above"),
        ("def f():\n    import voronerf.app.cli.program", "voronerf.app.train.loop", "from a layer above"),
        ("from voronerf import diagram", "voronerf.ops.cell_sort.reference", "from a layer above"),
        ("from ..train import loop", "voronerf.app.scenes.blender", "from a layer above"),
        ("from voronerf.ops._core import _C", "voronerf.ops.nearest_centre", "only native may"),
        ("from voronerf.ops.pixel_rays.reference import pixel_rays", "voronerf.nerf.rays", "that only ops read"),
        ("def f():\n    from voronerf.ops.resample import reference", "voronerf.editing.parts", "that only ops read"),
        ("import numpy", "voronerf.nerf.loss", "nerf may import torch"),
        ("import voronerf", "voronerf.ops.nearest_centre", "from a layer above"),
        ("import torch", "voronerf.attic", "belongs to no layer"),
        ("import numpy", "voronerf.kernels.nearest_centre", "kernels may import torch and warp"),
    ],
)
def test_faults_are_found(source: str, module: str, fault: str) -> None:
    assert any(fault in message for message in faults(source, module))


def needed(source: str, module: str, modules: set[str]) -> set[str]:
    """Returns the modules that a module imports, without the viewer's type-only imports, which form cycles."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and "app.viewer" in module:
            node.body = []
    imported: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            imported.update(name if name in modules else node.module for name in names.values())
    return (imported & modules) - {module, "voronerf"}


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Returns the modules in import cycles."""

    def reached(module: str) -> set[str]:
        seen: set[str] = set()
        waiting = [module]
        while waiting:
            for name in graph[waiting.pop()] - seen:
                seen.add(name)
                waiting.append(name)
        return seen

    return sorted(module for module in graph if module in reached(module))


def test_no_module_needs_itself() -> None:
    names = {path: module_name(path).removesuffix(".__init__") for path in SOURCES}
    modules = set(names.values())
    assert circles({name: needed(path.read_text(), name, modules) for path, name in names.items()}) == []


def test_circles_are_found() -> None:
    sources = {
        "a.b": "def f():\n    from a import c",
        "a.c": "from a.d import x",
        "a.d": "if TYPE_CHECKING:\n    import a.b",
        "a.e": "import a.b",
    }
    graph = {name: needed(source, name, set(sources)) for name, source in sources.items()}
    assert circles(graph) == ["a.b", "a.c", "a.d"]


def test_few_functions_take_many_arguments() -> None:
    many = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                if len([argument for argument in arguments if argument.arg not in ("self", "cls")]) > 8:
                    many.append(f"{path.relative_to(ROOT)}: {node.name}")
    assert len(many) <= 26, many


def test_core_knows_no_framework() -> None:
    assert CORE
    for path in CORE:
        includes = re.findall(r'^\s*#\s*include\s*[<"]([^>"]+)', path.read_text(), re.MULTILINE)
        for include in includes:
            assert include.split("/")[0] not in ("torch", "ATen", "c10"), f"{path.name} includes {include}"
            assert not include.startswith(("pybind11", "Python.h")) or path.parent.name == "bindings", path.name


def test_instruction_set_files_share_no_inline_functions() -> None:
    """Source files for an instruction set include no inline functions: the linker could keep an AVX-512 copy."""
    waiting = [path for path in CORE if path.name.endswith("_isa.cpp")]
    assert waiting
    seen = set()
    while waiting:
        path = waiting.pop()
        seen.add(path)
        for bracket, include in re.findall(r'^\s*#\s*include\s*([<"])([^>"]+)', path.read_text(), re.MULTILINE):
            if bracket == "<":
                assert include in STANDARD_OF_ISA_FILES, f"{path.name} includes <{include}>"
            elif (ROOT / "csrc" / include) not in seen:
                waiting.append(ROOT / "csrc" / include)
