"""C in its own process: ``python -m converters.runtimes.c.child``.

Two processes: one compiles headers, and may start the compiler; this one loads the libraries that come of it, and may
start nothing. Neither writes outside of a folder of their own, and neither reaches a network.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from converters.files.children import confinement
from converters.files.children.bounded import run_bounded
from converters.files.children.child import Model, claim_stdout, serve
from converters.files.children.frames import Tensors
from converters.formats.programs.artifact import contract_held
from converters.formats.programs.members import Header, header_of
from converters.formats.programs.weights import weights_name
from converters.runtimes.base import REFUSED
from converters.runtimes.rows import as_declared, fed_rows, row_count
from signatures.code import CodeOptions
from signatures.errors import ExportModelError

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
_C_DTYPES = {"bool": "int32"}
#: What the compiler may take: bytes of memory and seconds of processor time, and of each so much more for each byte of
#: text (of weights, gcc 12 and clang 14 take up to 43 bytes and 0.23 µs).
COMPILER_BYTES, COMPILER_SECONDS = 1 << 30, 30
_BYTES_PER_BYTE, _SECONDS_PER_BYTE = 200, 4e-6
#: Bytes of memory that libraries, and what they are fed, may take in this process.
_MEMORY_BYTES = 4 << 30


class CompileError(Exception):
    """The compiler's own words."""


def driver(header: Header, code: CodeOptions) -> str:
    """A source file that calls a header's functions row by row, for whatever is fed under the policy's names."""
    p = header.prefix
    state = [header.state] if header.state else []
    fed = [f"input.{f.name}" for f in header.inputs] + [f"memory.{f.name}" for f in (*header.noise, *state)]
    given = [f"output.{f.name}" for f in header.outputs]
    given += [f"memory.{header.state.name}"] if header.state and header.next_state else []
    copies = [f"memcpy(&{n}, (const char *)in[{i}] + row * sizeof {n}, sizeof {n});" for i, n in enumerate(fed)]
    answers = [f"memcpy((char *)out[{i}] + row * sizeof {n}, &{n}, sizeof {n});" for i, n in enumerate(given)]
    loads, load = code.weights == "file", "int judge_load(const void *weights, size_t size)"
    lines = "\n        ".join([*copies, f"without += {p}_compute(&input, &memory, &output);", *answers])
    return (
        f'#define {p.upper()}_IMPLEMENTATION\n#define {p.upper()}_SELFTEST\n#include "policy.h"\n#include <stddef.h>\n'
        f"static {p}_memory memory;\nvoid judge_reset(uint64_t seed);\nint judge_selftest(void);\n"
        f"int judge(size_t rows, const void *const *in, void *const *out);\n"
        + (f"{load};\n{load} {{ return {p}_load(&memory, weights, size); }}\n" if loads else "")
        + f"void judge_reset(uint64_t seed) {{ {p}_reset(&memory, seed); }}\n"
        f"int judge_selftest(void) {{ return {p}_selftest(&memory); }}\n"
        f"int judge(size_t rows, const void *const *in, void *const *out)\n{{\n    static {p}_input input;\n"
        f"    static {p}_output output;\n    int without = 0;\n    (void)in;\n    (void)out;\n"
        f"    for (size_t row = 0; row < rows; row++) {{\n        {lines}\n    }}\n    return without;\n}}\n"
    )


class _Library:
    def __init__(self, path: Path, seed: int, build: _Builder) -> None:
        contract = contract_held(path)
        code = CodeOptions.of(contract.tool)
        self.header = header_of(path.stem, contract.signature, code)
        self.library = ctypes.CDLL(str(build(driver(self.header, code), path)))
        if code.weights == "file":
            file = path.with_name(weights_name(path.stem)).read_bytes()
            self.weights = np.frombuffer(
                file, np.uint8
            ).copy()  # numpy aligns what it makes; the library reads it there
            pointer = ctypes.c_void_p(self.weights.ctypes.data)
            if refused := self.library.judge_load(pointer, ctypes.c_size_t(self.weights.size)):
                raise ValueError(f"its weights are refused with {refused}")
        if wrong := self.library.judge_selftest():
            raise ValueError(f"its self test finds {wrong} wrong numbers")
        self.library.judge_reset(ctypes.c_uint64(seed))

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        header, outputs = self.header, self.header.answered
        rows = row_count(header, feeds)
        fed = [fed_rows(f, feeds.get(f.spec.name), rows, _C_DTYPES) for f in header.fed]
        made = [np.zeros((rows, f.size), _C_DTYPES.get(f.spec.dtype, f.spec.dtype)) for f in outputs]
        pointers = [(ctypes.c_void_p * max(1, len(a)))(*(x.ctypes.data for x in a)) for a in (fed, made)]
        if without := self.library.judge(ctypes.c_size_t(rows), *pointers):
            raise ValueError(f"an index of {without} inputs lies outside of the table that it is looked up in")
        found = {f.spec.name: as_declared(f, a, rows) for f, a in zip(outputs, made, strict=True)}
        return {name: found[name] for name in fetch}


class _Builder:
    """The process that compiles: a source goes in, the path of a library or the compiler's words come out."""

    def __init__(self, folder: Path, asked: BinaryIO, answers: BinaryIO) -> None:
        self.folder, self.asked, self.answers, self.count = folder, asked, answers, 0

    def __call__(self, source: str, header: Path) -> Path:
        self.count += 1
        file = self.folder / f"{self.count}.c"
        file.write_text(source, "ascii")
        shutil.copyfile(header, self.folder / "policy.h")
        self.asked.write(f"{self.count}\n".encode())
        self.asked.flush()
        answer = json.loads(self.answers.readline())
        if answer["rc"]:
            raise CompileError(f"{REFUSED}:\n{answer['said'][:2000]}")
        return file.with_suffix(".so")


def _compile(program: str, folder: Path, asked: BinaryIO, answers: BinaryIO) -> None:
    """Compile what is asked for until nobody asks."""
    for line in asked:
        file = folder / f"{int(line)}.c"  # what asks has loaded libraries: no path, and no option, of theirs
        command = [program, *FLAGS, "-o", str(file.with_suffix(".so")), str(file), "-lm"]
        size = (folder / "policy.h").stat().st_size
        done = run_bounded(
            command,
            folder,
            COMPILER_BYTES + size * _BYTES_PER_BYTE,
            COMPILER_SECONDS + int(size * _SECONDS_PER_BYTE),
        )
        answers.write(json.dumps({"rc": done.returncode, "said": done.stderr}).encode() + b"\n")
        answers.flush()


def main() -> None:
    """Entry of the child process."""
    (program,) = sys.argv[1:]
    folder = Path(os.environ["TMPDIR"])
    (ask_out, ask_in), (answer_out, answer_in) = os.pipe(), os.pipe()
    if os.fork() == 0:
        for end in (ask_in, answer_out, 0, 1):
            os.close(end)
        os.dup(os.open(os.devnull, os.O_RDWR))
        confinement.confine(str(folder), starts=True)
        _compile(program, folder, os.fdopen(ask_out, "rb"), os.fdopen(answer_in, "wb"))
        os._exit(0)
    os.close(ask_out)
    os.close(answer_in)
    build = _Builder(folder, os.fdopen(ask_in, "wb"), os.fdopen(answer_out, "rb"))
    resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY_BYTES, _MEMORY_BYTES))
    confinement.confine(str(folder))
    out = claim_stdout()

    def load(header: Mapping[str, Any]) -> Model:
        seed = header.get("seed")
        return _Library(Path(header["path"]), int.from_bytes(os.urandom(8), "little") if seed is None else seed, build)

    serve("c", Path(program).name, load, (CompileError, ExportModelError), out)


if __name__ == "__main__":
    main()
    sys.exit()
