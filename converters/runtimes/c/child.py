"""C in its own process: ``python -m export_model.converters.runtimes.c.child``.

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

from export_model.converters.files.children import confinement
from export_model.converters.files.children.bounded import run_bounded
from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.formats.programs.artifact import contract_held
from export_model.converters.formats.programs.members import Header, header_of
from export_model.converters.formats.programs.weights import weights_name
from export_model.converters.runtimes.agents import (
    AGENTS,
    CHOSEN,
    SIZES,
    UNUSUAL,
    Drive,
    answers_of,
    fields_of_agent,
    fields_with_size,
)
from export_model.converters.runtimes.base import REFUSED
from export_model.converters.runtimes.rows import OUTSIDE, as_declared, fed_rows, row_count
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import safe_name
from export_model.signatures.errors import ExportModelError

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


def driver(file: str, header: Header, code: CodeOptions, branches: Sequence[int] = ()) -> str:
    """A source file that calls a header's functions row by row, for whatever is fed under the policy's names.

    And for ``AGENTS`` agents, each with its own memory.
    """
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
        f'#define {p.upper()}_IMPLEMENTATION\n#define {p.upper()}_SELFTEST\n#include "{file}"\n#include <stddef.h>\n'
        f"static {p}_memory memory, memories[{AGENTS}];\nvoid judge_reset(uint64_t seed);\nint judge_selftest(void);\n"
        f"int judge(size_t rows, const void *const *in, void *const *out);\n"
        + (f"{load};\n{load}\n{{\n    for (int i = 0; i < {AGENTS}; i++)\n" if loads else "")
        + (f"        if ({p}_load(&memories[i], weights, size)) return 4;\n" if loads else "")
        + (f"    return {p}_load(&memory, weights, size);\n}}\n" if loads else "")
        + f"void judge_reset(uint64_t seed) {{ {p}_reset(&memory, seed); }}\n"
        f"int judge_selftest(void) {{ return {p}_selftest(&memory); }}\n"
        f"int judge(size_t rows, const void *const *in, void *const *out)\n{{\n    static {p}_input input;\n"
        f"    static {p}_output output;\n    int without = 0;\n    (void)in;\n    (void)out;\n"
        f"    for (size_t row = 0; row < rows; row++) {{\n        {lines}\n    }}\n    return without;\n}}\n"
        + _agents_driver(header, code, branches)
    )


def _agents_driver(header: Header, code: CodeOptions, branches: Sequence[int]) -> str:
    """The functions that drive agents, which take turns in one array."""
    p, each, state = header.prefix, f"    for (int i = 0; i < {AGENTS}; i++) ", header.state
    keep = f"memories[i].{state.name}" if state else ""
    members = [f"outputs[i].{f.name}" for f in header.outputs] + [f"memories[i].{f.name}" for f in header.noise]
    members += [keep] if state and header.next_state else []
    fed = [(f"inputs[i].{f.name}", f"(const char *)in[{n}] + (size_t)i * sizeof ") for n, f in enumerate(header.inputs)]
    take = " ".join(f"memcpy({to}, {source}{to}, sizeof {to});" for to, source in fed)
    place = f"(size_t)(turn * {AGENTS} + i) * sizeof "
    tell = " ".join(f"memcpy((char *)out[{n}] + {place}{at}, {at}, sizeof {at});" for n, at in enumerate(members))
    sizes = "".join(f"{p}_size_{f.name}, " for f in fields_with_size(header))
    functions = {
        "void judge_begin(uint64_t seed)": [f"{each}{p}_reset(&memories[i], seed + (uint64_t)i);"],
        "int judge_act(int repeat, const void *const *in, void *const *out)": [
            f"    static {p}_input inputs[{AGENTS}];\n    int without = 0;\n    (void)in;\n    (void)out;",
            *([f"    static char kept[{AGENTS}][sizeof memories[0].{state.name}];"] if state else []),
            f"{each}{{ {take} }}",
            *([f"{each}memcpy(kept[i], {keep}, sizeof kept[i]);"] if state else []),
            "    for (int turn = 0; turn < repeat; turn++) {",
            *([f"    {each}memcpy({keep}, kept[i], sizeof kept[i]);"] if state else []),
            f"        without += {p}_act_all({AGENTS}, inputs, memories, outputs);\n    {each}{{ {tell} }}\n    }}",
            *([f"{each}unusual[i] = {p}_unusual(&inputs[i]);"] if code.guard is not None else []),
            "    return without;",
        ],
        "void judge_choose(int count, int32_t *classes)": [
            "    (void)count;\n    (void)classes;",
            f"{each}for (int n = 0; n < count; n++, classes += {len(branches)})",
            f"        {p}_choose(&memories[i], &outputs[i], classes);"
            if header.choice_field(branches)
            else "        {}",
        ],
        "int judge_sizes(int32_t *sizes, int32_t *counts)": [
            f"    static const int32_t known[] = {{{sizes}0}};",
            f"    static const int32_t branches[] = {f'{p.upper()}_BRANCHES' if branches else '{0}'};",
            f"{each}counts[i] = unusual[i];\n    memcpy(sizes, known, sizeof known);",
            f"    for (int i = 0; i < {len(branches)} && i < (int)(sizeof branches / 4); i++)",
            f"        sizes[{len(fields_with_size(header))} + i] = branches[i];",
            "    return (int)(sizeof branches / 4);",
        ],
    }
    text = "\n".join("\n".join([f"{head};", head, "{", *body, "}"]) for head, body in functions.items())
    return f"static {p}_output outputs[{AGENTS}];\nstatic int32_t unusual[{AGENTS}];\n{text}\n"


class _Library:
    def __init__(self, path: Path, seed: int, build: _CompilerProcess) -> None:
        contract = contract_held(path)
        code = CodeOptions.of(contract.tool)
        self.header, self.branches = header_of(contract.name, contract.signature, code), contract.signature.branches
        self.library = ctypes.CDLL(str(build(self.header, code, self.branches, path)))
        if code.weights == "file":
            file = path.with_name(weights_name(contract.name)).read_bytes()
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
        if (drive := Drive.of(request)) is not None:
            return self._drive(drive, feeds, fetch)
        header, outputs = self.header, self.header.answered
        rows = row_count(header, feeds)
        fed = [fed_rows(f, feeds.get(f.spec.name), rows, _C_DTYPES) for f in header.fed]
        made = [np.zeros((rows, f.size), _C_DTYPES.get(f.spec.dtype, f.spec.dtype)) for f in outputs]
        pointers = [(ctypes.c_void_p * max(1, len(a)))(*(x.ctypes.data for x in a)) for a in (fed, made)]
        if without := self.library.judge(ctypes.c_size_t(rows), *pointers):
            raise ValueError(OUTSIDE.format(without))
        found = {f.spec.name: as_declared(f, a, rows) for f, a in zip(outputs, made, strict=True)}
        return {name: found[name] for name in fetch}

    def _drive(self, drive: Drive, feeds: Tensors, fetch: Sequence[str]) -> Tensors:
        header, size = self.header, (drive.repeat, AGENTS)
        fed = [fed_rows(f, feeds.get(f.spec.name), AGENTS, _C_DTYPES) for f in header.inputs]
        made = [np.zeros((*size, f.size), _C_DTYPES.get(f.spec.dtype, f.spec.dtype)) for f in fields_of_agent(header)]
        pointers = [(ctypes.c_void_p * max(1, len(a)))(*(x.ctypes.data for x in a)) for a in (fed, made)]
        classes = np.zeros((AGENTS, drive.choose, len(self.branches)), np.int32)
        sizes, counts = (
            np.zeros(len(fields_with_size(header)) + len(self.branches) + 1, np.int32),
            np.zeros(AGENTS, np.int32),
        )
        if drive.seed is not None:
            self.library.judge_begin(ctypes.c_uint64(drive.seed))
        if without := self.library.judge_act(drive.repeat, *pointers):
            raise ValueError(OUTSIDE.format(without))
        self.library.judge_choose(drive.choose, ctypes.c_void_p(classes.ctypes.data))
        count = self.library.judge_sizes(*(ctypes.c_void_p(a.ctypes.data) for a in (sizes, counts)))
        sizes[-1] = count if self.branches else 0
        return answers_of(header, fetch, made) | {CHOSEN: classes, SIZES: sizes, UNUSUAL: counts}


class _CompilerProcess:
    """The process that compiles: a source goes in, the path of a library or the compiler's words come out."""

    def __init__(self, folder: Path, asked: BinaryIO, answers: BinaryIO) -> None:
        self.folder, self.asked, self.answers, self.count = folder, asked, answers, 0

    def __call__(self, header: Header, code: CodeOptions, branches: Sequence[int], path: Path) -> Path:
        self.count += 1
        file = self.folder / str(self.count) / "judge.c"
        file.parent.mkdir()
        name = path.name if safe_name(path.name) == path.name else "policy.h"
        file.write_text(driver(name, header, code, branches), "ascii")
        shutil.copyfile(path, file.with_name(name))
        self.asked.write(f"{self.count}\n".encode())
        self.asked.flush()
        answer = json.loads(self.answers.readline())
        if answer["rc"]:
            raise CompileError(f"{REFUSED}:\n{answer['said'][:2000]}")
        return file.with_suffix(".so")


def _compile(program: str, folder: Path, asked: BinaryIO, answers: BinaryIO) -> None:
    """Compile what is asked for until nobody asks."""
    for line in asked:
        file = folder / str(int(line)) / "judge.c"  # what asks has loaded libraries: no path, and no option, of theirs
        # As the page says: its folder is one of those that the C library's headers are looked for in.
        command = [program, *FLAGS, f"-I{file.parent}", "-o", str(file.with_suffix(".so")), str(file), "-lm"]
        size = sum(each.stat().st_size for each in file.parent.glob("*.h"))
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
    build = _CompilerProcess(folder, os.fdopen(ask_in, "wb"), os.fdopen(answer_out, "rb"))
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
