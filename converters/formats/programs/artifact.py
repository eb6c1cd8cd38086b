"""An artefact that is source code: the contract that it holds, and where an untrusted one is run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from export_model.converters.files.children.confinement import in_force
from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.file_probe import Content
from export_model.converters.formats.format import Port, Ports
from export_model.converters.formats.programs.comment import LINE, interface_lines
from export_model.converters.formats.programs.members import answers
from export_model.converters.formats.programs.weights import weights_name
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import EMBEDDED, Contract, json_of, parse
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError
from export_model.signatures.spec import PolicySignature

#: What a file's ending says of its format.
WRITTEN_AS = {".h": "c", ".cs": "csharp", ".mjs": "js"}
_MARK = f"   {EMBEDDED}: ".encode()


def is_program(suffix: str, file: Content) -> bool:
    """Whether a file is source code that export-model wrote: its contract says so, its ending in which language."""
    return file.text is not None and file.name.endswith(suffix) and _MARK in file.data


def held(path: Path) -> str | None:
    """Return the contract that a file of ours has as a comment. Raises SourceError."""
    _, found, rest = read_bytes(path).partition(_MARK)
    return rest.partition(b"\n*/")[0].decode("ascii", "replace") if found else None


def misstatement(path: Path, signature: PolicySignature) -> str | None:
    """The line of a file's comment on its numbers that a signature does not say; None where there is none."""
    comment = read_bytes(path).partition(_MARK)[0].decode("ascii", "replace")
    found = [line for line in comment.splitlines() if line.startswith(LINE)]
    stated = interface_lines(signature).splitlines()
    if found == stated:
        return None
    other = next((line for line in (*found, *stated) if (line in found) != (line in stated)), "in another order")
    return f"its comment on the numbers differs: {other.removeprefix(LINE)[:120]}"


def contract_held(path: Path) -> Contract:
    """The contract of a file of ours. Raises SourceError, DamagedFileError, FieldError."""
    text = held(path)
    if text is None:
        raise DamagedFileError(
            f"{path.name} has no contract", why="export-model did not write it", fix="export it again"
        )
    return parse(json_of(text))


def ports(path: Path) -> Ports:
    """What it takes and gives, as its contract says. Raises SourceError, DamagedFileError."""
    contract = contract_held(path)
    signature, wanted = contract.signature, answers(contract.signature, CodeOptions.of(contract.tool))
    return Ports(
        path,
        tuple(Port(s.name, s.dtype, s.shape) for s in signature.inputs),
        tuple(Port(s.name, s.dtype, s.shape) for s in signature.outputs if s.name in wanted),
        {"kind": "graph", "format": WRITTEN_AS[path.suffix]},
        left_out=tuple(s.name for s in signature.outputs if s.name not in wanted),
    )


def vetted(path: Path, names: Sequence[str], folder: Path) -> Path:
    """Return a copy, where its process is confined: it may be any program.

    Raises UnsupportedOpError, DamagedFileError.
    """
    if not can_confine():
        raise UnsupportedOpError(
            f"{path.name} is not compiled",
            issues=[],
            why="a file that was not made just now may hold any program, and nothing confines one here",
            fix="verify it on Linux 5.13 or later, or export the policy again, which verifies it",
        )
    ports(path)
    contract = contract_held(path)
    if CodeOptions.of(contract.tool).weights == "file":
        weights = path.with_name(weights_name(contract.name))
        if not weights.is_file():
            raise DamagedFileError(
                f"{weights.name} is missing", why=f"{path.name} loads it", fix="keep both in one folder"
            )
        shutil.copyfile(weights, folder / weights.name)
    return Path(shutil.copyfile(path, folder / path.name))


def can_confine() -> bool:
    """Whether a program that anyone may have made is run here: in a process that only reads, computes and answers."""
    return all(in_force().values())
