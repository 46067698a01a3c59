"""Runs a kernel's machine code for sm_90 on the CPU and counts the instructions that its warps issue.

The code is cuobjdump's disassembly. Each instruction becomes a Python function of a warp, whose 32 lanes are NumPy
vectors. Divergent lanes form groups, which wait for each other at BSYNC and WARPSYNC and join there, as on a GPU. The
group at the lowest address runs first. An instruction counts once for each group, even if its predicate is false.

Pointers are addresses of this process. Global memory is only read: ``Launch`` keeps what the kernel writes. Denormal
numbers are not flushed, and MUFU is exact. An instruction that FORMS lacks is an error when a warp reaches it.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import struct
import subprocess
import sysconfig
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

LANES = np.arange(32)
ALL = 2**32 - 1
ZERO, TRUE = 255, 7
"""The register that is 0, and the predicate that is true. Uniform register 63 is 0."""
PARAMETERS = 0x210
"""The offset of the arguments in constant bank 0."""
SHARED_HIGH, SHARED_RESERVED = 1 << 16, 1024
"""The upper word of generic addresses of shared memory, and the bytes of it that CUDA reserves."""
LOCAL_BYTES = 4096
"""The bytes of a lane's local memory."""
LINE = re.compile(r"^\s+/\*[0-9a-f]{4,}\*/\s+(.*?)\s*;")
FORM = re.compile(r"(?:@(!?U?P\w+) )?([A-Z]\w*)((?:\.\w+)*)\s*(.*)")
REGISTER = re.compile(r"([-~]?)(\|?)(U?)R(\d+|Z)\|?")
i64, u32, f32, f64 = np.int64, np.uint32, np.float32, np.float64


def tools() -> str | None:
    """Returns a PATH that contains cuobjdump and nvdisasm; None if one of them is missing."""
    folders = [str(folder) for folder in Path(sysconfig.get_path("purelib")).glob("nvidia/*/bin")]
    path = ":".join([*folders, *filter(None, [str(Path(found).parent) if (found := shutil.which("nvcc")) else None])])
    path = f"{path}:/usr/local/cuda/bin:/usr/local/bin:/usr/bin:/bin"
    return path if all(shutil.which(name, path=path) for name in ("cuobjdump", "nvdisasm")) else None


class Memory:
    """Bytes, also as numbers of two and four bytes. ``base`` is the address of the first byte."""

    def __init__(self, data: np.ndarray, base: int = 0) -> None:
        self.base, self.numbers = base, {1: data, 2: data.view(np.uint16), 4: data.view(u32)}


PROCESS = Memory(np.frombuffer((ctypes.c_ubyte * (2**47 - 4096)).from_address(4096), np.uint8), 4096)
"""The memory of this process. NumPy has no arrays at address 0."""


class Kernel:
    """The instructions of a kernel, and its constant banks."""

    def __init__(self, texts: list[str], banks: dict[int, bytes] | None = None) -> None:
        self.texts, self.banks = texts, banks or {}
        self.functions: list[Callable[[Warp], None] | None] = [None] * len(texts)

    def function(self, place: int) -> Callable[[Warp], None]:
        """Returns the instruction at a place as a function of a warp."""
        found = self.functions[place]
        if found is None:
            names: dict[str, Any] = {}
            exec(translated(self.texts[place], 16 * place), globals(), names)
            found = self.functions[place] = names["run"]
        return found


def read_kernel(compiled: Path, pattern: str, path: str) -> Kernel:
    """Reads the one kernel of a cubin or object file whose mangled name matches ``pattern``."""
    program = shutil.which("cuobjdump", path=path) or "cuobjdump"
    with tempfile.TemporaryDirectory() as folder:
        if compiled.suffix != ".cubin":
            command = [program, "-arch", "sm_90", "-xelf", "all", compiled.resolve()]
            subprocess.run(command, cwd=folder, check=True, capture_output=True, env={"PATH": path})
            (compiled,) = Path(folder).glob("*.cubin")
        file = compiled.read_bytes()
        start, (each, count, names) = struct.unpack_from("<Q", file, 40)[0], struct.unpack_from("<HHH", file, 58)
        heads = [struct.unpack_from("<IIQQQQ", file, start + each * i) for i in range(count)]
        sections = dict[str, bytes]()
        for name, kind, _, _, place, size in heads:
            at = heads[names][4] + name
            filled = kind != 8  # NOBITS
            sections[file[at : file.index(b"\0", at)].decode()] = file[place : place + size] if filled else bytes(size)
        (kernel,) = (name[6:] for name in sections if name.startswith(".text.") and re.search(pattern, name))
        command = [program, "-sass", "-fun", kernel, compiled]
        said = subprocess.run(command, capture_output=True, text=True, check=True, env={"PATH": path}).stdout
    texts = [match[1] for line in said.splitlines() if (match := LINE.match(line))]
    return Kernel(texts, {2: sections.get(f".nv.constant2.{kernel}", b""), 4: _addresses(sections)})


@cache
def _variables(data: bytes) -> np.ndarray:
    """Returns a copy of global variables, which lives as long as the process."""
    return np.frombuffer(data, np.uint8).copy()


def _addresses(sections: dict[str, bytes]) -> bytes:
    """Returns constant bank 4: the addresses of global variables."""
    names, bank = list(sections), bytearray(sections.get(".nv.constant4", b""))
    for place, symbol, addend in struct.iter_unpack("<QQq", sections.get(".rela.nv.constant4", b"")):
        section, value = struct.unpack_from("<HQ", sections[".symtab"], 24 * (symbol >> 32) + 6)
        struct.pack_into("<Q", bank, place, _variables(sections[names[section]]).ctypes.data + value + addend)
    return bytes(bank)


# Warps ---------------------------------------------------------------------------------------------------------------


class Launch:
    """A launch: what its blocks share, and what they write.

    Attributes:
        stored: By the size of numbers, 1, 2 or 4 bytes, the stored numbers by their place in PROCESS.
        added: The places and float32 numbers of atomic additions.
        counts: The number of issued instructions, by place in the code.
        steps: The number of issued instructions, by the one of ``records`` that the warp loaded last. Before the first,
            and after a store to the first ``states`` bytes of dynamic shared memory, the number is -1.
    """

    def __init__(
        self, kernel: Kernel, grid: int, threads: int, shared: int, arguments: bytes, records: range, states: int
    ) -> None:
        self.kernel, self.threads, self.shared = kernel, threads, shared
        self.records, self.states = records, SHARED_RESERVED + states
        self.arguments = np.frombuffer(arguments, np.uint8).copy()
        head = bytearray(PARAMETERS)
        struct.pack_into("<6I", head, 0, threads, 1, 1, grid, 1, 1)
        struct.pack_into("<I", head, 0x28, LOCAL_BYTES)
        struct.pack_into("<Q", head, 0x198, self.arguments.ctypes.data)  # for generic reads of arguments
        banks = {**kernel.banks, 0: bytes(head) + arguments}
        self.banks = {i: Memory(np.frombuffer(bank + bytes(-len(bank) % 4), np.uint8)) for i, bank in banks.items()}
        self.stored: dict[int, dict[int, int]] = {1: {}, 2: {}, 4: {}}
        self.added: list[tuple[np.ndarray, np.ndarray]] = []
        self.counts, self.steps = [0] * len(kernel.texts), Counter[int]()

    def run(self, block: int) -> None:
        """Runs a block."""
        shared = Memory(np.full(SHARED_RESERVED + self.shared, 0x7F, np.uint8))
        warps = [Warp(self, block, index, shared) for index in range(self.threads // 32)]
        with np.errstate(all="ignore"):
            while any(warp.barriers[-1] for warp in warps):
                for warp in warps:
                    warp.run()


class Warp:
    """A warp: its registers, and groups of lanes at addresses."""

    def __init__(self, launch: Launch, block: int, index: int, shared: Memory) -> None:
        self.launch, self.shared = launch, shared
        self.local = Memory(np.full(32 * LOCAL_BYTES, 0x7F, np.uint8))
        self.registers, uniform = np.full((256, 32), 0x7FC0BAD0, u32), np.zeros((64, 1), u32)
        self.registers[ZERO] = 0
        self.R, self.S, self.F = (list(self.registers.view(kind)) for kind in (u32, np.int32, f32))
        self.UR, self.US, self.UF = (list(uniform.view(kind)) for kind in (u32, np.int32, f32))
        self.P, self.UP = ([np.full(count, i == TRUE) for i in range(8)] for count in (32, 1))
        self.special = {"TID.X": 32 * index + LANES, "CTAID.X": block, "CgaCtaId": 0, "SWINHI": SHARED_HIGH}
        self.barriers = [0] * 16 + [ALL]  # the lanes that each waits for; the last has all lanes until they exit
        self.pc, self.bits, self.mask = 0, ALL, lanes_of(ALL)
        self.ready: list[tuple[int, int]] = []  # addresses and lanes of other groups
        self.waiting: dict[int, list[int]] = {}  # by the next address: barrier, needed lanes, lanes that arrived
        self.stopped = self.moved = False
        self.step = -1

    def run(self) -> None:
        """Runs up to the next barrier of the block or the end."""
        functions, function = self.launch.kernel.functions, self.launch.kernel.function
        counts, steps = self.launch.counts, self.launch.steps
        self.stopped = not self.barriers[-1]
        while not self.stopped:
            place = self.pc >> 4
            counts[place] += 1
            steps[self.step] += 1
            self.pc += 16
            (functions[place] or function(place))(self)
            if self.moved:
                self._turn()

    def send(self, lanes: int, address: int) -> None:
        """Moves active lanes to an address."""
        self.bits &= ~lanes
        self.ready.append((address, lanes))
        self.moved = True

    def send_each(self, mask: np.ndarray, addresses: np.ndarray) -> None:
        """Moves each lane of a mask to its own address."""
        for address in np.unique(addresses[mask]).tolist():
            self.send(bits_of(mask & (addresses == address)), address)

    def wait(self, lanes: int, barrier: int) -> None:
        """Lets active lanes wait until all lanes of a barrier wait at the same address."""
        if lanes:
            self.waiting.setdefault(self.pc, [barrier, self.barriers[barrier], 0])[2] |= lanes
            self.bits &= ~lanes
            self.moved = True

    def leave(self, lanes: int, barriers: Iterable[int]) -> None:
        """Takes active lanes out of barriers."""
        for barrier in barriers:
            self.barriers[barrier] &= ~lanes
        for entry in self.waiting.values():
            entry[1] &= ~lanes if entry[0] in barriers else ALL
        self.bits &= self.barriers[-1]
        self.moved = True

    def _turn(self) -> None:
        """Goes on with the lanes at the lowest address."""
        self.ready.append((self.pc, self.bits))
        for address, (_, needed, arrived) in list(self.waiting.items()):
            if not needed & ~arrived:
                del self.waiting[address]
                self.ready.append((address, arrived))
        self.ready = sorted(group for group in self.ready if group[1])
        self.moved, self.stopped = False, self.stopped or not self.barriers[-1]
        if self.ready:
            self.pc, self.bits = self.ready.pop(0)
            self.mask = lanes_of(self.bits)
        elif not self.stopped:
            raise RuntimeError(f"lanes wait for each other at {[hex(address) for address in self.waiting]}")


@cache
def lanes_of(bits: int) -> np.ndarray:
    """Returns the lanes of a number's bits as a mask."""
    return (bits >> LANES & 1).astype(bool)


def bits_of(mask: np.ndarray) -> int:
    """Returns a mask of lanes as a number."""
    return int.from_bytes(np.packbits(mask, bitorder="little").tobytes(), "little")


# Functions that instructions call -------------------------------------------------------------------------------------


def put(to: np.ndarray, value: Any, mask: np.ndarray) -> None:
    """Sets the lanes of a mask."""
    np.copyto(to, value, casting="unsafe", where=mask)


def pair(rows: list[np.ndarray], first: int) -> np.ndarray:
    """Returns two registers as 64-bit integers."""
    return rows[first].astype(i64) | rows[first + 1].astype(i64) << 32


def rounded(exact: np.ndarray, way: str) -> np.ndarray:
    """Returns float64 numbers rounded to float32: RM down, RP up, RZ to 0."""
    near = exact.astype(f32)
    below = np.where(near > exact, np.nextafter(near, f32(-np.inf)), near)
    above = np.where(near < exact, np.nextafter(near, f32(np.inf)), near)
    return {"RM": below, "RP": above, "RZ": np.where(exact < 0, above, below)}[way]


def to_integer(x: np.ndarray, low: int, high: int) -> np.ndarray:
    """Returns whole numbers as integers within bounds; NaN gives 0."""
    return np.clip(np.nan_to_num(x.astype(f64), nan=0.0), low, high).astype(i64)


def slow_division(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns where FCHK reports that a / b needs special treatment."""
    up, down = (np.frexp(x)[1] for x in (a, b))
    return ~(np.isfinite(a) & np.isfinite(b) & (b != 0) & (abs(down) < 126) & (up > -101) & (abs(up - down) < 126))


def bfloat16(x: np.ndarray) -> np.ndarray:
    """Returns the bits of numbers rounded to bfloat16, in the low halves of words."""
    bits = np.asarray(x, f32).view(u32)
    return np.where(np.isnan(x), u32(0x7FFF), (bits + 0x7FFF + (bits >> 16 & 1)) >> 16)


def widened(words: np.ndarray) -> np.ndarray:
    """Returns the two bfloat16 numbers of each word, in order."""
    return (words.view(np.uint16).astype(u32) << 16).view(f32)


def whole(mask: np.ndarray) -> bool:
    """Returns whether all lanes run an instruction of the warp, for which some of them alone are an error."""
    if mask.any() and not mask.all():
        raise RuntimeError("only some lanes run an instruction of the whole warp")
    return bool(mask.all())


def multiply(w: Warp, to: int, a: int, b: int, c: int) -> None:
    """HMMA.16816: adds the product of [16, 16] and [16, 8] bfloat16 numbers to c."""
    left = widened(w.registers[a : a + 4]).reshape(2, 2, 8, 4, 2).transpose(1, 2, 0, 3, 4).reshape(16, 16)
    right = widened(w.registers[b : b + 2]).reshape(2, 8, 4, 2).transpose(0, 2, 3, 1).reshape(16, 8)
    result = (left @ right).reshape(2, 8, 4, 2).transpose(0, 3, 1, 2).reshape(4, 32)
    added = w.registers[c : c + 4].view(f32) if c != ZERO else f32(0)
    w.registers[to : to + 4] = (result + added).view(u32)


def load_matrices(w: Warp, at: np.ndarray, to: int, transposed: bool) -> None:
    """LDSM.4: loads four matrices [8, 8] of 16-bit numbers from rows in shared memory."""
    rows = w.shared.numbers[4][(at[:, None] & ALL) // 4 + np.arange(4)]
    if transposed:
        rows = np.ascontiguousarray(rows.view(np.uint16).reshape(4, 8, 8).transpose(0, 2, 1)).view(u32)
    w.registers[to : to + 4] = rows.reshape(4, 32)


def store_matrices(w: Warp, at: np.ndarray, start: int) -> None:
    """STSM.4: stores what LDSM.4 loads."""
    w.shared.numbers[4][(at[:, None] & ALL) // 4 + np.arange(4)] = w.registers[start : start + 4].reshape(32, 4)


def shuffled(value: np.ndarray, lane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the values of other lanes, and whether there are such lanes."""
    inside = (lane >= 0) & (lane < 32)
    return value[np.where(inside, lane, LANES)], inside


def permuted(a: Any, b: Any, selector: int) -> Any:
    """PRMT: returns four bytes of a and b, or the signs of bytes."""
    result: Any = u32(0)
    for i in range(4):
        code = selector >> 4 * i & 15
        byte = (b if code & 4 else a) >> 8 * (code & 3) & 255
        result = result | ((byte >> 7) * 255 if code & 8 else byte) << 8 * i
    return result


def looked_up(a: Any, b: Any, c: Any, table: int) -> Any:
    """LOP3 and PLOP3: returns the bitwise function of three operands that a table of eight bits gives."""
    if table == 0xC0:
        return a & b
    a, b, c = (x if isinstance(x, np.ndarray) else u32(x) for x in (a, b, c))
    result = a & ~a
    for case in range(8):
        if table >> case & 1:
            result = result | (a if case & 4 else ~a) & (b if case & 2 else ~b) & (c if case & 1 else ~c)
    return result


def _place(w: Warp, space: str | int, at: np.ndarray) -> tuple[Memory, np.ndarray]:
    """Returns the memory of addresses, and their places in it."""
    if isinstance(space, int):
        return w.launch.banks[space], at & ALL
    if space == "L":
        return w.local, at & ALL
    if space == "S" or (space == "" and at.size and at[0] >> 32 == SHARED_HIGH):
        return w.shared, at & ALL
    return PROCESS, at - PROCESS.base


def load(w: Warp, mask: np.ndarray, rows: list[np.ndarray], to: int, space: str | int, at: Any, size: int) -> None:
    """Loads words, or one integer of one or two bytes, from a bank or from memory that is generic, G, S or L."""
    at = np.broadcast_to(at, rows[0].shape) + (LANES * LOCAL_BYTES if space == "L" else 0)
    memory, at = _place(w, space, at[mask])
    if size == 16 and at.size and int(at[0]) + memory.base in w.launch.records:
        w.step = w.launch.records.index(int(at[0]) + memory.base)
    width = min(size, 4)
    for k in range(size // width):
        values = memory.numbers[width][at // width + k]
        if memory is PROCESS and (stored := w.launch.stored[width]):
            values = np.array([stored.get(*item) for item in zip((at + 4 * k).tolist(), values.tolist())], u32)
        rows[to + k][mask] = values


def store(w: Warp, mask: np.ndarray, space: str, at: Any, start: int, size: int) -> None:
    """Stores words, or the low bytes of one, in memory that is generic, G, S or L."""
    at = np.broadcast_to(at, 32) + (LANES * LOCAL_BYTES if space == "L" else 0)
    memory, at = _place(w, space, at[mask])
    if memory is w.shared and at.size and at[0] < w.launch.states:
        w.step = -1
    width = min(size, 4)
    for k in range(size // width):
        values = w.R[start + k if start != ZERO else ZERO][mask] & (2 ** (8 * width) - 1)
        if memory is PROCESS:
            w.launch.stored[width].update(zip((at + 4 * k).tolist(), values.tolist()))
        else:
            memory.numbers[width][at // width + k] = values


def add(w: Warp, mask: np.ndarray, at: np.ndarray, start: int, count: int) -> None:
    """REDG: adds to numbers in global memory."""
    for k in range(count):
        w.launch.added.append((at[mask] - PROCESS.base + 4 * k, w.F[start + k][mask]))


# Instructions --------------------------------------------------------------------------------------------------------

# The effect of each instruction. A letter and a number stand for an operand: r unsigned, s signed, f float32, e
# float64, w and v 64-bit integers without and with a sign, q two registers, p a predicate, n a plain number, i the
# number of a register, b of a barrier, c of a bank, a an address, t a special register, z one of PLAIN. `m` is the mask
# of lanes, `lanes` the same as a number, `here` the next address. Additions whose carries may be wanted set x.
FORMS = {
    "NOP": "pass",
    "MOV": "r0 = r1",
    "IMAD IMAD.MOV IMAD.MOV.U32 IMAD.U32 IMAD.SHL.U32 IMAD.IADD": "r0 = r1 * r2 + r3",
    "IMAD.X": "x = w1 * w2 + w3 + p4; r0 = x",
    "IMAD.WIDE": "q0 = v1 * v2 + q3",
    "IMAD.WIDE.U32": "q0 = w1 * w2 + q3",
    "IMAD.HI.U32": "r0 = w1 * w2 + q3 >> 32",
    "VIADD": "r0 = r1 + r2",
    "IADD3": "x = w1 + w2 + w3; r0 = x",
    "IADD3.X": "x = w1 + w2 + w3 + p4 + p5; r0 = x",
    "LEA": "x = (w1 << n3 & ALL) + w2; r0 = x",
    "LEA.HI": "x = (w3 << n4 | w1 >> 32 - n4) % 2**32 + w2; r0 = x",
    "LEA.HI.X": "x = (w3 << n4 | w1 >> 32 - n4) % 2**32 + w2 + p5; r0 = x",
    "LEA.HI.SX32": "x = (v1 >> 32 - n3) % 2**32 + w2; r0 = x",
    "LEA.HI.X.SX32": "x = (v1 >> 32 - n3) % 2**32 + w2 + p4; r0 = x",
    "LOP3.LUT": "x = looked_up(r1, r2, r3, n4); r0 = x; z5",
    "PLOP3.LUT": "p0 = looked_up(p2, p3, p4, n5); z1",
    "SHF.L.U32": "r0 = w1 << np.minimum(w2, 32)",
    "SHF.L.U32.HI SHF.L.U64.HI": "r0 = (w3 << 32 | w1) << np.minimum(w2, 32) >> 32",
    "SHF.R.U32.HI": "r0 = w3 >> np.minimum(w2, 32)",
    "SHF.R.S32.HI": "r0 = v3 >> np.minimum(w2, 32)",
    "SHF.R.S64": "r0 = (v3 << 32 | w1) >> np.minimum(w2, 63)",
    "PRMT": "r0 = permuted(r1, r3, n2)",
    "POPC": "r0 = np.bitwise_count(r1)",
    "FLO.U32": "r0 = np.frexp(r1.astype(f64))[1] - 1",
    "SEL": "r0 = np.where(p3, r1, r2)",
    "VIMNMX": "s0 = np.where(p3, np.minimum(s1, s2), np.maximum(s1, s2))",
    "VIMNMX.U32": "r0 = np.where(p3, np.minimum(r1, r2), np.maximum(r1, r2))",
    "VIADDMNMX.RELU": "s0 = np.maximum(np.where(p4, np.minimum(s1 + s2, s3), np.maximum(s1 + s2, s3)), 0)",
    "FADD": "f0 = f1 + f2",
    "FMUL": "f0 = f1 * f2",
    "FMUL.RZ": "f0 = rounded(e1 * e2, 'RZ')",
    "FFMA": "f0 = e1 * e2 + e3",
    "FFMA.RM": "f0 = rounded(e1 * e2 + e3, 'RM')",
    "FFMA.SAT": "f0 = np.clip(np.nan_to_num(e1 * e2 + e3), 0, 1)",
    "FSEL": "f0 = np.where(p3, f1, f2)",
    "FCHK": "p0 = slow_division(f1, f2)",
    "FRND": "f0 = np.rint(f1)",
    "FRND.FLOOR": "f0 = np.floor(f1)",
    "MUFU.RCP": "f0 = 1 / f1",
    "MUFU.RSQ": "f0 = 1 / np.sqrt(f1)",
    "MUFU.EX2": "f0 = np.exp2(f1)",
    "MUFU.SIN": "f0 = np.sin(2 * np.pi * e1)",
    "MUFU.COS": "f0 = np.cos(2 * np.pi * e1)",
    "F2I": "r0 = to_integer(np.rint(f1), -(2**31), 2**31 - 1)",
    "F2I.TRUNC": "r0 = to_integer(np.trunc(f1), -(2**31), 2**31 - 1)",
    "F2I.U32.TRUNC": "r0 = to_integer(np.trunc(f1), 0, ALL)",
    "I2FP.F32.S32": "f0 = s1",
    "I2FP.F32.U32": "f0 = r1",
    "I2F.U32.RP": "f0 = rounded(r1.astype(f64), 'RP')",
    "F2FP.BF16.F32.PACK_AB": "r0 = bfloat16(f1) << 16 | bfloat16(f2)",
    "F2FP.RELU.BF16.F32.PACK_AB": "r0 = bfloat16(np.maximum(f1, 0)) << 16 | bfloat16(np.maximum(f2, 0))",
    "HSET2.BF16_V2.GTU.AND": "r0 = (~(widened(r1) <= 0) * np.uint16(0xFFFF)).view(u32); z2; z3",
    "HMMA.16816.F32.BF16": "if whole(m): multiply(w, i0, i1, i2, i3)",
    "CS2R": "q0 = np.zeros(1, i64); z1",
    "S2R S2UR": "r0 = w.special[t1]",
    "R2UR": "if m.any(): w.UR[i0][0] = r1[m.argmax()]",
    "VOTE.ANY": "r0 = bits_of(w.mask & p2); z1",
    "SHFL.BFLY": "whole(m); x, y = shuffled(r2, LANES ^ s3); r1 = x; p0 = y; z4",
    "BSSY": "w.barriers[b0] = lanes",
    "BSYNC": "w.wait(lanes, b0)",
    "BREAK": "w.leave(lanes, [b0])",
    "EXIT": "w.leave(lanes, range(17))",
    "BMOV.32.CLEAR": "r0 = w.barriers[b1]; w.barriers[b1] = 0",
    "BMOV.32": "w.barriers[b0] = int(r1[w.mask.argmax()])",
    "WARPSYNC.ALL": "w.wait(lanes, 16)",
    "BAR.SYNC": "assert w.bits == w.barriers[-1]; w.stopped = True",
    "BRA BRA.U CALL.REL": "w.send(lanes, n0)",
    "BRA.DIV": "if w.bits != r0[0]: w.send(lanes, n1)",
    "BRX": "w.send_each(m, v0 + n1 + here)",
    "RET.REL": "w.send_each(m, w0 + n1)",
    "LDC": "load(w, m, rows, i0, c1, a1, size)",
    **{f"LD{space}": f"load(w, m, rows, i0, '{space}', a1, size)" for space in ("", "G", "S", "L")},
    **{f"ST{space}": f"store(w, m, '{space}', a0, i1, size)" for space in ("", "G", "S", "L")},
    "LDSM.16.M88.4": "if whole(m): load_matrices(w, a1, i0, False)",
    "LDSM.16.MT88.4": "if whole(m): load_matrices(w, a1, i0, True)",
    "STSM.16.M88.4": "if whole(m): store_matrices(w, a0, i1)",
    **{f"REDG.ADD.F32{x}.RN": f"add(w, m, a0, i1, {x[1:] or 1})" for x in ("", "x2", "x4")},
}
FORMS = {name: does for names, does in FORMS.items() for name in names.split()}


def _comparisons() -> Iterable[tuple[str, str]]:
    """Returns the forms of ISETP and FSETP."""
    for how, holds, strict in (
        *(("LT", "a < b", "a < b"), ("LE", "a <= b", "a < b"), ("GT", "a > b", "a > b"), ("GE", "a >= b", "a > b")),
        *(("EQ", "a == b", "False"), ("NE", "a != b", "a != b"), ("NAN", "False", "")),
    ):
        for combine, sign in (("AND", "&"), ("OR", "|")):
            sets = f"; y = p4 & True; p0 = x {sign} y; p1 = ~x {sign} y"
            for kind, ab in ((how, "a, b = s2, s3"), (f"{how}.U32", "a, b = r2, r3")):
                yield f"ISETP.{kind}.{combine}", f"{ab}; x = {holds}{sets}"
                # The upper words of 64-bit numbers; the last operand is the result for the lower words.
                yield f"ISETP.{kind}.{combine}.EX", f"{ab}; x = ({strict}) | (a == b) & p5{sets}"
            yield f"FSETP.{how}.{combine}", f"a, b = f2, f3; x = ({holds}) & (a == a) & (b == b){sets}"
            unordered = how if how == "NAN" else f"{how}U"
            yield f"FSETP.{unordered}.{combine}", f"a, b = f2, f3; x = ({holds}) | (a != a) | (b != b){sets}"


FORMS |= _comparisons()
SIZES = {"U8": 1, "U16": 2, "64": 8, "128": 16}
NEUTRAL = {"E", "FTZ", "NTZ", "LU", "CONSTANT", "STRONG", "GPU", "NOINC", "NODEC", "DEFER_BLOCKING"}
"""Suffixes that change nothing here."""
PLAIN = ("RZ", "RZ.H0_H0", "SRZ", "PT", "!PT", "UPT", "!UPT", "0x1f")
"""Operands that have no effect. Other operands in their place are errors."""
TOKEN = re.compile(r"\b([rsfewvqpnibactz])(\d)\b")


def translated(text: str, address: int) -> str:
    """Returns the source of the function ``run(w)``, which does what an instruction at an address does."""
    match = FORM.fullmatch(text.replace(".reuse", ""))
    when, name, kinds, rest = match.groups() if match else (None, text, "", "")
    uniform = "U" * (name[0] == "U" or name == "S2UR")
    name, suffixes = name.removeprefix("U"), kinds.split(".")[1:]
    sized = [suffix for suffix in suffixes if suffix in SIZES and re.fullmatch("LD[CGSL]?|ST[GSL]?", name)]
    form = ".".join([name, *(suffix for suffix in suffixes if suffix not in {*NEUTRAL, *sized})])
    operands = [part.strip() for part in (rest.split() if name in ("BRX", "RET") else rest.split(","))]
    size = SIZES[sized[0]] if sized else 4
    conditions, outs, place = [when] if when else [], [], 0 if name == "LOP3" else 1
    while name in ("LOP3", "IADD3", "LEA", "IMAD") and re.fullmatch("U?P.", operands[place]):
        outs.append(operands.pop(place))  # where the result is not 0, or carries
    while form in ("BRA", "BRA.U") and len(operands) > 1:
        conditions.append(operands.pop(0))
    try:
        mask = " & ".join(["w.UP[7]" if uniform else "w.mask", *(_operand("p", given) for given in conditions)])
        lines = [f"m, rows, size, here = {mask}, w.{uniform}R, {size}, {address + 16}"]
        if "lanes" in FORMS[form]:
            lines.append(f"lanes = {'bits_of(m)' if conditions else 'w.bits'}")
        for statement in FORMS[form].split("; "):
            letter, number, value = re.fullmatch(r"(?:([rsfqp])(\d) = )?(.*)", statement).groups()
            value = TOKEN.sub(lambda found: _operand(found[1], operands[int(found[2])]), value)
            lines += _sets(letter, operands[int(number)], value) if letter else [value]
        for i, out in enumerate(outs):
            if not re.search(r"\bx\b", "; ".join(lines)):
                raise KeyError(form)
            lines += _sets("p", out, "x != 0" if name == "LOP3" else f"x >> 32 > {i}")
    except (AttributeError, KeyError, IndexError, ValueError) as error:
        raise NotImplementedError(f"{text} at {address:#x}") from error
    return "\n ".join(["def run(w):", *lines])


def _sets(letter: str, text: str, value: str) -> list[str]:
    """Returns statements that set an operand."""
    if text in ("RZ", "URZ", "PT", "UPT"):
        return []
    uniform, number = re.fullmatch(r"(U?)[RP](\d+)", text).groups()
    rows = f"w.{uniform}{letter.upper().replace('Q', 'R')}"
    if letter == "q":
        return [f"y = {value}", f"put({rows}[{number}], y, m)", f"put({rows}[{int(number) + 1}], y >> 32, m)"]
    return [f"put({rows}[{number}], {value}, m)"]


def _operand(letter: str, text: str) -> str:
    """Returns an operand as an expression; FORMS explains the letters."""
    if letter == "n":
        return str(int(text, 0))
    if letter in "ib":
        return str(ZERO if text == "RZ" else int(text.lstrip("URB")))
    if letter == "t":
        return repr(text.removeprefix("SR_"))
    if letter == "z":
        return str(PLAIN.index(text))
    if letter == "c":
        return str(int(text.split("]")[0].removeprefix("c["), 0))
    if letter == "a":
        terms = text.rpartition("[")[2].rstrip("]").split("+")
        return " + ".join(_operand("q", term[:-3]) if term.endswith(".64") else _operand("v", term) for term in terms)
    if letter == "p":
        no, uniform, name = re.fullmatch(r"(!?)(U?)P(\d|T)", text).groups()
        return f"{'~' if no else ''}w.{uniform}P[{name.replace('T', str(TRUE))}]"
    match = REGISTER.fullmatch(text)
    if match is None and letter in "fe":
        return f"f32({float(text.replace('QNAN', 'nan'))})".replace("inf", "np.inf").replace("nan", "np.nan")
    if match is None:
        number = int(text, 0)
        return str((number + 2**31) % 2**32 - 2**31 if letter in "sv" else number & ALL)
    sign, size, uniform, name = match.groups()
    number = int(name.replace("Z", "63" if uniform else str(ZERO)))
    rows = f"w.{uniform}{ {'s': 'S', 'v': 'S', 'f': 'F', 'e': 'F'}.get(letter, 'R') }"
    if letter == "q":
        return "0" if name == "Z" else f"pair({rows}, {number})"
    row = f"abs({rows}[{number}])" if size else f"{rows}[{number}]"
    if letter == "w" and sign == "-":  # its sum carries like that of the complement and 1
        return f"(2**32 - {row}.astype(i64))"
    return f"({sign}{row})" + {"e": ".astype(f64)", "v": ".astype(i64)", "w": ".astype(i64)"}.get(letter, "")
