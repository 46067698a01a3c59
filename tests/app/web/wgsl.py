"""Runs a page's shaders on the CPU without a browser: translates WGSL to C++ line by line, with types of wgsl.h."""

from __future__ import annotations

import ctypes
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


def declared(members: str, end: str) -> str:
    """Translates a struct's members or a function's parameters to C++, where types precede names."""
    pairs = [member.strip().split(": ") for member in members.split(",") if member.strip()]
    return "".join(f"{kind} {name}{end}" for name, kind in pairs).removesuffix(",")


def lanes(names: str) -> str:
    """Returns C++ for a swizzle: ``[i]`` for one lane, ``.lanes<...>()`` for several."""
    places = ["xyzwrgba".index(name) % 4 for name in names]
    return f"[{places[0]}]" if len(places) == 1 else f".lanes<{str(places)[1:-1]}>()"


#: Patterns of WGSL, and their C++ replacements.
RULES = (
    (r"//.*", ""),
    (r"@group\(0\) @binding\((\d)\) var<uniform> (\w+): (\w+);", r"\3& \2 = *static_cast<\3*>(bound[\1]);"),
    (r"@group\(0\) @binding\((\d)\) var<storage, \w+> (\w+): array<(\w+)>;", r"\3* \2 = static_cast<\3*>(bound[\1]);"),
    (r"@\w+(\([^()]*\))?\s*", ""),
    (r"^const (\w+)", r"inline static const auto \1"),
    (r"^alias", "using"),
    (r"^struct (\w+) \{([^}]*)\}", lambda found: f"struct {found[1]} {{ {declared(found[2], ';')} }};"),
    (r"^fn (\w+)\(([^)]*)\) -> (\w+)", lambda found: f"{found[3]} {found[1]}({declared(found[2], ',')})"),
    (r"^fn (\w+)\(([^)]*)\)", lambda found: f"void {found[1]}({declared(found[2], ',')})"),
    (r"\bvar (\w+): ([^;]+);", r"\2 \1{};"),
    (r"\bvar\b", "auto"),
    (r"\blet\b", "const auto"),
    (r"\bloop\b", "for (;;)"),
    (r"(?<=[\w\])])\.([xyzw]+|[rgba]+)\b", lambda found: lanes(found[1])),
    (r"(?<![\w.])(\d+\.\d+(e[+-]?\d+)?|\d+e[+-]?\d+)", r"\1f"),
    (r"\b(\d+)i\b", r"\1"),
)


#: The C++ class of a shader and the function that runs it; ``bound`` holds the addresses of its buffers.
CLASS = """
struct Shader{number} {{
void* const* bound;
{members}
void pixel(u32 x, u32 y, u32 width) {{ {body} }}
}};
extern "C" void run{number}(void* const* bound, u32 width, u32 height) {{
Shader{number} shader{{bound}};
for (u32 y = 0; y < height; ++y) for (u32 x = 0; x < width; ++x) shader.pixel(x, y, width);
}}
"""


def translated(text: str) -> str:
    """Translates a shader to the members of a C++ class."""
    for pattern, by in RULES:
        text = re.sub(pattern, by, text, flags=re.MULTILINE)
    return text


def compiled(folder: Path, shaders: dict[str, tuple[str, str]]) -> Callable[..., None]:
    """Compiles shaders; ``shaders`` maps a name to (WGSL text, C++ code that handles pixel (x, y)).

    Returns:
        A function that runs a shader; it takes the shader's name, the picture's width and height, and the buffers in
        binding order.
    """
    compiler = shlex.split(os.environ.get("CXX", "g++"))
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"there is no C++ compiler {compiler[0]}")
    classes = [
        CLASS.format(number=number, members=translated(text), body=body)
        for number, (text, body) in enumerate(shaders.values())
    ]
    (folder / "shaders.cpp").write_text("\n".join(['#include "wgsl.h"', "namespace wgsl {", *classes, "}"]))
    flags = ["-std=c++20", "-ffp-contract=off", "-shared", "-fPIC", f"-I{Path(__file__).parent}"]
    subprocess.run([*compiler, *flags, "shaders.cpp", "-o", "shaders.so"], cwd=folder, check=True)
    library, numbers = ctypes.CDLL(str(folder / "shaders.so")), list(shaders)

    def run(name: str, width: int, height: int, *buffers: np.ndarray) -> None:
        addresses = (ctypes.c_void_p * len(buffers))(*[buffer.ctypes.data for buffer in buffers])
        library[f"run{numbers.index(name)}"](addresses, width, height)

    return run
