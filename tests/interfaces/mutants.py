"""Damaged files beside a source and damaged metadata: each is read, or left out with a note; nothing else is raised.

``python -m tests.interfaces.mutants 20000`` tries so many of them.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from random import Random

from export_model.converters.formats.source import ReadOptions
from export_model.converters.interfaces.metadata import read_metadata
from export_model.converters.interfaces.registry import FILES as KINDS
from export_model.converters.interfaces.registry import read_interface
from export_model.exporter.export.sources import read_source
from export_model.signatures.contract import parse_signature
from export_model.signatures.errors import ExportModelError
from tests.interfaces.made import DONE, FILES, MJLAB, SEEN, write_onnx

_WORDS = (
    *("&a", "*a", "!!python/tuple", "!!python/object/apply:os.system", "~", "[", "]", "{", "}", ": ", "- ", "\n", "  "),
    *(
        "1e999",
        "-.inf",
        ".nan",
        "99999999999999999999",
        "-1",
        "0",
        "''",
        "true",
        "null",
        "\u202e",
        "\x00",
        "é",
        "<<: *a",
    ),
    *(",", ";", "[[[[[[", '{"a":', "1_000", "inf", "0x7f", "scale: ", "size: ", "shape: [-1]", "\ud7ff", "\t"),
)


def mutate(text: str, random: Random) -> str:
    """A few pieces of a text left out, said twice, exchanged or replaced."""
    for _ in range(random.choice((1, 1, 2, 3, 8))):
        lines = text.split("\n")
        kind, at = random.randrange(6), random.randrange(max(len(text), 1))
        if kind == 0:
            text = text[:at] + random.choice(_WORDS) + text[at:]
        elif kind == 1:
            text = text[:at] + text[at + random.randrange(1, 20) :]
        elif kind == 2:
            text = text[:at] + chr(random.randrange(1, 0x3000)) + text[at + 1 :]
        elif kind == 3:
            row = random.randrange(len(lines))
            lines[row : row + 1] = [lines[row]] * random.choice((0, 2, 40))
            text = "\n".join(lines)
        elif kind == 4:
            i, j = random.randrange(len(lines)), random.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
            text = "\n".join(lines)
        else:
            words = text.split(" ")
            words[random.randrange(len(words))] = random.choice(_WORDS)
            text = " ".join(words)
    return text


def try_mutant(number: int, folder: Path) -> str:
    """What became of a mutant; whatever is not an error of ours comes through."""
    random = Random(f"interface {number}")
    names = [p.name for p in sorted(FILES.glob("*.yaml"))]
    name = random.choice([*names, "metadata"])
    beside = folder / "params"
    beside.mkdir(exist_ok=True)
    for old in beside.iterdir():
        old.unlink()
    metadata: dict[str, str] = {}
    if name == "metadata":
        known = random.choice([*MJLAB.values()])["metadata"]
        metadata = {k: mutate(v, random) if random.random() < 0.3 else v for k, v in known.items()}
        read_metadata(metadata)
        metadata = {k: v for k, v in metadata.items() if not any("\ud800" <= c <= "\udfff" for c in v)}
    else:
        text = mutate((FILES / name).read_text(), random)
        (beside / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        with contextlib.suppress(ExportModelError):
            read_interface(beside / name, "policy.onnx", "policy")
    source = write_onnx(folder / "exported" / "policy.onnx", SEEN, DONE, metadata)
    (policy,) = read_source(source, ReadOptions()).policies()
    parse_signature(policy.signature.to_dict())  # what is written can be read back
    left_out = any("is left out" in note for note in policy.signature.notes)
    return "left out" if left_out else "read" if policy.signature.interface else "states nothing"


def main(count: int) -> None:
    """Try mutants, and say what became of them."""
    assert len(KINDS) == 6
    found: Counter[str] = Counter()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            begun = time.monotonic()
            try:
                found[try_mutant(number, Path(folder))] += 1
            except Exception as error:  # noqa: BLE001 - counted and shown
                found["failed"] += 1
                print(number, repr(error)[:300], flush=True)
            slowest = max(slowest, time.monotonic() - begun)
    print(f"{count} mutants: {dict(found)}; slowest {slowest:.2f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]))
