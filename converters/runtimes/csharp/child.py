"""C# in its own processes: ``python -m export_model.converters.runtimes.csharp.child``.

This one compiles classes and starts a Mono for each; none of them writes outside of a folder of their own, or reaches
a network. Memory, time and system calls of each are bounded.
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.children import confinement
from export_model.converters.files.children.bounded import bounds, run_bounded
from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.formats.programs.artifact import contract_held
from export_model.converters.formats.programs.members import Field, Header, header_of
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
from export_model.signatures.errors import ExportModelError

FLAGS = ("-langversion:7", "-warn:4", "-warnaserror", "-optimize+", "-nologo")
#: What the compiler and a policy may take: bytes of memory, seconds of processor time, more for each byte of text.
_BYTES, _SECONDS = 2 << 30, 60
_BYTES_PER_BYTE, _SECONDS_PER_BYTE = 200, 4e-6
_RUN_SECONDS = 3600
#: What the answers begin with, and how much Mono may say before.
_MARK, _MOST_SAID = b"answers:", 1 << 16


class McsError(Exception):
    """The compiler's own words."""


def _copies(header: Header, fields: Sequence[Field], into: bool) -> str:
    """Statements that feed an agent from a row of ``input``, or write what it has into ``output``."""
    lines, at = list[str](), 0
    for f in fields:
        size = f.size * np.dtype(f.spec.dtype).itemsize
        member = f"agent.{(header.state if f is header.next_state and header.state else f).name}"
        ends = f"input, row * {_bytes(fields)} + {at}, {member}, 0" if into else f"{member}, 0, output, {at}"
        lines.append(f"System.Buffer.BlockCopy({ends}, {size});")
        at += size
    return " ".join(lines)


def driver(header: Header, code: CodeOptions, branches: Sequence[int] = ()) -> str:
    """Return a program that feeds a class row by row: what it reads and writes lies one after the other, in bytes.

    A number of rows below 0 asks for a decision of each of ``AGENTS`` agents.
    """
    file = "using (var file = System.IO.File.OpenRead(words[1]))"
    load = f"{file} Policies.{header.class_name}.Load(file);\n        " if code.weights == "file" else ""
    return f"""
static class Driver
{{
    static int Main(string[] words)
    {{
        {load}var agent = new Policies.{header.class_name}(ulong.Parse(words[0]));
        int wrong = agent.SelfTest();
        agent.Reset(ulong.Parse(words[0]));
        var reader = new System.IO.BinaryReader(System.Console.OpenStandardInput());
        var writer = new System.IO.BinaryWriter(System.Console.OpenStandardOutput());
        foreach (char c in "{_MARK.decode()}") writer.Write((byte)c);
        writer.Write(wrong);
        writer.Flush();
        var output = new byte[{_bytes(header.answered)}];
        while (true) {{
            int rows;
            try {{ rows = reader.ReadInt32(); }} catch (System.IO.EndOfStreamException) {{ return 0; }}
            if (rows < 0) {{ Drive(reader, writer); continue; }}
            byte[] input = reader.ReadBytes(rows * {_bytes(header.fed)});
            for (int row = 0; row < rows; row++) {{
                {_copies(header, header.fed, True)}
                byte outside = 0;
                try {{ agent.Compute(); }} catch (System.IndexOutOfRangeException) {{ outside = 1; }}
                {_copies(header, header.answered, False)}
                writer.Write(outside);
                writer.Write(output);
            }}
            writer.Flush();
            System.GC.KeepAlive(input);
        }}
    }}
{_agents_driver(header, code, branches)}
}}
"""


def _agents_driver(header: Header, code: CodeOptions, branches: Sequence[int]) -> str:
    """The method that lets agents act in turn, each of them as an object; all are looked at when all have acted."""
    kind, state = f"Policies.{header.class_name}", header.state
    size = _bytes([state]) if state else 0
    keep, restore = (
        f"System.Buffer.BlockCopy({ends}, {size});" if state else ""
        for ends in (
            (f"agent.{state.name}, 0, kept[row], 0", f"kept[row], 0, agent.{state.name}, 0") if state else ("", "")
        )
    )
    sizes = "".join(f" writer.Write({kind}.Sizes.{f.name});" for f in fields_with_size(header))
    agent, each = f"{kind} agent = agents[row];", f"for (int row = 0; row < {AGENTS}; row++)"
    choose = (
        f"""var classes = new int[{len(branches)}];
        foreach (var agent in agents)
            for (int turn = 0; turn < choose; turn++) {{
                agent.Choose(classes);
                foreach (int one in classes) writer.Write(one);
            }}"""
        if header.choice_field(branches)
        else ""
    )
    return f"""
    static {kind}[] agents;
    static void Drive(System.IO.BinaryReader reader, System.IO.BinaryWriter writer)
    {{
        bool begins = reader.ReadBoolean();
        ulong seed = reader.ReadUInt64();
        int repeat = reader.ReadInt32(), choose = reader.ReadInt32(), outside = 0 * choose;
        byte[] input = reader.ReadBytes({AGENTS * _bytes(header.inputs)});
        bool made = agents == null;
        if (made) agents = new {kind}[{AGENTS}];
        var kept = new byte[{AGENTS}][];
        {each} {{
            if (made) agents[row] = new {kind}(seed + (ulong)row);
            else if (begins) agents[row].Reset(seed + (ulong)row);
        }}
        {each} {{
            {agent}
            {_copies(header, header.inputs, True)}
            System.GC.KeepAlive(agent);
            kept[row] = new byte[{size}];
            {keep}
        }}
        var output = new byte[{_bytes(fields_of_agent(header))}];
        for (int turn = 0; turn < repeat; turn++) {{
            {each} {{
                {agent}
                {restore}
                try {{ agent.Act(); }} catch (System.IndexOutOfRangeException) {{ outside++; }}
            }}
            {each} {{
                {agent}
                {_copies(header, fields_of_agent(header), False)}
                writer.Write(output);
            }}
        }}
        writer.Write(outside);
        {choose}
        {sizes}
        for (int i = 0; i < {len(branches)}; i++) writer.Write(i < {kind}.Branches.Length ? {kind}.Branches[i] : 0);
        writer.Write({kind}.Branches.Length);
        {each} writer.Write({"agents[row].Unusual()" if code.guard is not None else "0"});
        writer.Flush();
        System.GC.KeepAlive(input);
    }}"""


def _bytes(fields: Sequence[Field]) -> int:
    return sum(f.size * np.dtype(f.spec.dtype).itemsize for f in fields)


class _Program:
    def __init__(self, path: Path, seed: int, folder: Path, compiler: str, mono: str) -> None:
        contract = contract_held(path)
        code = CodeOptions.of(contract.tool)
        self.header, self.branches = header_of(contract.name, contract.signature, code), contract.signature.branches
        own = Path(tempfile.mkdtemp(dir=folder))
        if code.weights == "file":
            shutil.copyfile(path.with_name(weights_name(contract.name)), own / "weights.bin")
        shutil.copyfile(path, own / "policy.cs")
        (own / "driver.cs").write_text(driver(self.header, code, self.branches), "ascii")
        size = path.stat().st_size
        done = run_bounded(
            [compiler, *FLAGS, "-out:policy.exe", "policy.cs", "driver.cs"],
            own,
            _BYTES + size * _BYTES_PER_BYTE,
            _SECONDS + int(size * _SECONDS_PER_BYTE),
        )
        if done.returncode:
            raise McsError(f"{REFUSED}:\n{(done.stdout + done.stderr)[:2000]}")
        self.process = subprocess.Popen(  # one thread, so nothing can hold a lock across the fork
            [mono, str(own / "policy.exe"), str(seed), str(own / "weights.bin")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            preexec_fn=bounds(own, _BYTES + size * _BYTES_PER_BYTE, _RUN_SECONDS, starts=False),
        )
        self._skip()
        if wrong := int(np.frombuffer(self._read(4), "<i4")[0]):
            raise ValueError(f"its self test finds {wrong} wrong numbers")

    def _skip(self) -> None:
        """What Mono itself has to say, such as that it may not change the priority of its threads."""
        said = b""
        while not said.endswith(_MARK):
            said += self._read(1)
            if len(said) > _MOST_SAID:
                raise ValueError(f"Mono says {said[:200]!r}")

    def _read(self, count: int) -> bytes:
        assert self.process.stdout is not None
        found = self.process.stdout.read(count)
        if len(found) < count:
            raise ValueError(f"Mono ended with status {self.process.wait()}")
        return found

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        if (drive := Drive.of(request)) is not None:
            return self._drive(drive, feeds, fetch)
        header, rows = self.header, row_count(self.header, feeds)
        fed = [fed_rows(f, feeds.get(f.spec.name), rows) for f in header.fed]
        parts = [a.view(np.uint8).reshape(rows, -1) for a in fed]
        body = np.concatenate(parts, axis=1) if parts else np.zeros((rows, 0), np.uint8)
        pipe = self.process.stdin
        assert pipe is not None
        kept = []
        for row in body:  # one at a time: both pipes would fill up
            pipe.write(np.array([1], "<i4").tobytes() + row.tobytes())
            pipe.flush()
            kept.append(self._read(1 + _bytes(header.answered)))
        if without := sum(answer[0] for answer in kept):
            raise ValueError(OUTSIDE.format(without))
        made = np.frombuffer(b"".join(kept), np.uint8).reshape(rows, -1)[:, 1:]
        found = {f.spec.name: as_declared(f, a, rows) for f, a in _cut(header.answered, made)}
        return {name: found[name] for name in fetch}

    def _drive(self, drive: Drive, feeds: Tensors, fetch: Sequence[str]) -> Tensors:
        header, pipe, count = self.header, self.process.stdin, drive.repeat * AGENTS
        assert pipe is not None
        fed = [fed_rows(f, feeds.get(f.spec.name), AGENTS).view(np.uint8).reshape(AGENTS, -1) for f in header.inputs]
        pipe.write(struct.pack("<i?Qii", -1, drive.seed is not None, drive.seed or 0, drive.repeat, drive.choose))
        pipe.write(np.concatenate(fed, axis=1).tobytes() if fed else b"")
        pipe.flush()
        made = np.frombuffer(self._read(count * _bytes(fields_of_agent(header))), np.uint8).reshape(count, -1)
        if without := self._integers(1)[0]:
            raise ValueError(OUTSIDE.format(without))
        every = [a.reshape(drive.repeat, AGENTS, -1) for _, a in _cut(fields_of_agent(header), made)]
        branches = len(self.branches)
        classes = self._integers(AGENTS * drive.choose * branches).reshape(AGENTS, drive.choose, branches)
        sizes, unusual = self._integers(len(fields_with_size(header)) + branches + 1), self._integers(AGENTS)
        return answers_of(header, fetch, every) | {CHOSEN: classes, SIZES: sizes, UNUSUAL: unusual}

    def _integers(self, count: int) -> np.ndarray:
        return np.frombuffer(self._read(4 * count), "<i4")

    def __del__(self) -> None:
        process = getattr(self, "process", None)
        if process is not None:
            process.kill()
            process.wait()


def _cut(fields: Sequence[Field], rows: np.ndarray) -> Iterator[tuple[Field, np.ndarray]]:
    """Bytes [rows, bytes] as the fields that lie in them one after the other, [rows, size] each."""
    at = 0
    for f in fields:
        size = _bytes([f])
        yield f, np.ascontiguousarray(rows[:, at : at + size]).view(f.spec.dtype)
        at += size


def main() -> None:
    """Entry of the child process."""
    compiler, mono = sys.argv[1:]
    folder = Path(os.environ["TMPDIR"])
    os.environ["MONO_DISABLE_SHARED_AREA"] = "1"
    confinement.confine(str(folder), starts=True)
    out = claim_stdout()

    def load(header: Mapping[str, Any]) -> Model:
        seed = header.get("seed")
        seed = int.from_bytes(os.urandom(8), "little") if seed is None else seed
        return _Program(Path(header["path"]), seed, folder, compiler, mono)

    serve("csharp", "mono", load, (McsError, ExportModelError), out)


if __name__ == "__main__":
    main()
    sys.exit()
