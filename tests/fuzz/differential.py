"""``python -m tests.fuzz.differential``: mutants as our messages read them, and as Google's own do: they must agree.

``converters/formats/onnx/messages.py`` and ``converters/files/tensorflow_messages.py`` know the fields that are
needed, by their numbers. Whatever they read of a damaged file has to be what onnx and TensorFlow read of it, or a
runtime would run another model than was looked at. Both refuse, or all fields that ours know have the same values.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import PurePath
from typing import Any

from google.protobuf.message import DecodeError

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.onnx.messages import ModelProto
from tests.fuzz.seeds import READERS, mutant

_MESSAGE = 11
#: Known: a SavedModel's output that is said to be sparse or composed, too, after it was named. protobuf keeps the last
#: of a oneof; ours know the name alone, and take it. What is written anew for a runtime has only the name.
#: And a number that is none of an attribute's kinds, which protobuf leaves out; ours take it, and then the value that
#: is there, as they do where no kind is given.
KNOWN = {("TensorInfo", "name"), ("AttributeProto", "type, no kind")}


def _onnx() -> Any:
    import onnx

    return onnx.ModelProto


def _graph() -> Any:
    from tensorflow.core.framework.graph_pb2 import GraphDef

    return GraphDef


def _saved() -> Any:
    from tensorflow.core.protobuf.saved_model_pb2 import SavedModel

    return SavedModel


#: reader → how its file ends, our message, Google's
CODECS: dict[str, tuple[str, Any, Callable[[], Any]]] = {
    "ONNX": (".onnx", ModelProto, _onnx),
    "frozen graph": (".bytes", schema.GraphDef, _graph),
    "SavedModel": (".pb", schema.SavedModel, _saved),
}


def differences(ours: Any, theirs: Any, place: str = "") -> list[tuple[str, str, str]]:
    """(message, field, where) of each field of ours that has another value in theirs."""
    found = []
    for field in ours.DESCRIPTOR.fields:
        other = theirs.DESCRIPTOR.fields_by_number[field.number]
        at = f"{place}.{field.name}"
        a, b = getattr(ours, field.name), getattr(theirs, other.name)
        if field.type != _MESSAGE:
            if other.enum_type is not None and isinstance(a, int) and a not in other.enum_type.values_by_number:
                if a != b:
                    found.append((ours.DESCRIPTOR.name, f"{field.name}, no kind", at))
            elif not _same(a, b):
                found.append((ours.DESCRIPTOR.name, field.name, at))
        elif hasattr(a, "items"):  # a map
            if set(a) != set(b):
                found.append((ours.DESCRIPTOR.name, field.name, at))
            for key in set(a) & set(b):
                if hasattr(a[key], "DESCRIPTOR"):
                    found += differences(a[key], b[key], f"{at}[{key}]")
                elif a[key] != b[key]:
                    found.append((ours.DESCRIPTOR.name, field.name, at))
        elif hasattr(a, "add"):
            if len(a) != len(b):
                found.append((ours.DESCRIPTOR.name, field.name, at))
            for number, (one, two) in enumerate(zip(a, b, strict=False)):
                found += differences(one, two, f"{at}[{number}]")
        elif ours.HasField(field.name) != theirs.HasField(other.name):
            found.append((ours.DESCRIPTOR.name, field.name, at))
        elif ours.HasField(field.name):
            found += differences(a, b, at)
    return found


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, str | bytes | int | float):
        return bool(a == b) or (isinstance(a, float) and math.isnan(a) and math.isnan(b))
    return len(a) == len(b) and all(map(_same, a, b))


def compared(reader: str, data: bytes, theirs: Any) -> tuple[str, list[tuple[str, str, str]]]:
    """What came of a file: ``both refuse``, ``agree``, ``known``, ``Google's refuse`` (the damage is in a part ours
    do not know), or ``differ``, and in what.
    """
    ours = CODECS[reader][1]
    read = []
    for kind in (ours, theirs):
        try:
            read.append(kind.FromString(data))
        except DecodeError:
            read.append(None)
    if None in read:
        if read[0] is not None:
            return "Google's refuse", []
        return ("both refuse", []) if read[1] is None else ("differ", [(ours.DESCRIPTOR.name, "", "ours refuse")])
    found = differences(*read)
    kinds = {entry[:2] for entry in found}
    return "agree" if not found else "known" if kinds <= KNOWN else "differ", found


def run(reader: str, first: int, count: int) -> tuple[Counter[str], list[tuple[int, str, list[tuple[str, str, str]]]]]:
    """How often what, and each mutant that is read otherwise."""
    end, _, official = CODECS[reader]
    theirs = official()
    counts: Counter[str] = Counter()
    differing = []
    for number in range(first, first + count):
        for name, data in mutant(reader, number).items():
            if PurePath(name).suffix == end:
                what, found = compared(reader, data, theirs)
                counts[what] += 1
                if what == "differ":
                    differing.append((number, name, found))
    return counts, differing


def main() -> int:
    """1 where anything is read otherwise."""
    arguments = argparse.ArgumentParser(prog="python -m tests.fuzz.differential", description=__doc__)
    arguments.add_argument("--count", type=int, default=2_000, help="mutants of each reader")
    arguments.add_argument("--first", type=int, default=0, help="the number of the first")
    arguments.add_argument("--reader", action="append", choices=sorted(CODECS), help="only this one")
    given = arguments.parse_args()
    failed = 0
    for reader in given.reader or CODECS:
        assert reader in READERS
        counts, differing = run(reader, given.first, given.count)
        failed += len(differing)
        print(f"{reader}: {', '.join(f'{n} {what}' for what, n in sorted(counts.items()))}", flush=True)
        for number, name, found in differing[:20]:
            print(f"    {number} {name}: {found[:3]}", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
