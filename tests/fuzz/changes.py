"""How files are damaged: each kind in the parts that its reader looks at."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import pickletools
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from random import Random
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.barracuda.format import _Parser
from export_model.converters.formats.checkpoint.table import read_table
from export_model.converters.formats.litert.flatbuffer import decode, encode
from export_model.signatures.digest import sha256_hex
from tests.checkpoint.writing import table
from tests.fuzz import mutation

Files = dict[str, bytes]


def one(change: Callable[[bytes, Random], bytes]) -> Callable[[Files, Random], Files]:
    """The model's own file changed, seldom another of the folder."""

    def changed(files: Files, random: Random) -> Files:
        name = max(files, key=lambda n: not n.endswith(".data"))
        other = random.choice(sorted(files))
        if other != name and random.random() < 0.1:
            return {**files, other: mutation.damaged(files[other], random)}
        return {**files, name: change(files[name], random)}

    return changed


def message(whole: Callable[[bytes], object]) -> Callable[[bytes, Random], bytes]:
    return lambda data, random: mutation.protobuf(data, random, whole)


def onnx_message(data: bytes) -> object:
    import onnx

    return onnx.ModelProto.FromString(data)


def _nn_parts(data: bytes) -> list[tuple[str, bytes]]:
    """A ``.nn`` cut where its fields begin, with what each is; a text and a list have their count with them."""

    class Cutting(_Parser):
        def __init__(self, given: bytes) -> None:
            super().__init__(given)
            self.found: list[tuple[str, bytes]] = []
            self._inside = False

        def _whole(self, kind: str, read: Callable[[], Any]) -> Any:
            begun, outer, self._inside = self._at, self._inside, True
            value = read()
            self._inside = outer
            if not outer:
                self.found.append((kind, given[begun : self._at]))
            return value

        def _take(self, count: int) -> bytes:
            return bytes(self._whole("bytes", lambda: super(Cutting, self)._take(count)))

        def _integer(self, *form: struct.Struct) -> int:
            kind = form[0].format if form else "<i"
            return int(self._whole(kind, lambda: super(Cutting, self)._integer(*form)))

        def _text(self) -> str:
            return str(self._whole("text", super()._text))

        def _ints(self) -> Any:
            return self._whole("list", super()._ints)

    given = data
    cutting = Cutting(data)
    cutting.model()
    assert b"".join(part for _, part in cutting.found) == data
    return cutting.found


def _nn_field(kind: str, part: bytes, random: Random, known: list[bytes]) -> bytes:
    if kind in ("<i", "<q"):
        near = int.from_bytes(part, "little", signed=True)
        return (mutation.number(random, near) & (1 << 8 * len(part)) - 1).to_bytes(len(part), "little")
    if kind == "list":
        numbers = list(struct.unpack(f"<{len(part) // 4 - 1}I", part[4:]))
        at = random.randrange(len(numbers) + 1)
        numbers[at : at + random.choice((0, 1, 1))] = [mutation.number(random) & 0xFFFFFFFF] * random.choice(
            (0, 1, 1, 4)
        )
        return struct.pack(f"<{len(numbers) + 1}I", len(numbers), *numbers)
    if kind == "text":
        words = mutation.text(random, known)
        return struct.pack("<i", len(words)) + words
    return mutation.damaged(part, random)[: len(part)].ljust(len(part), b"\x7f")


def nn(files: Files, random: Random) -> Files:
    (name,) = [n for n in files if n.endswith(".nn")]
    cut = _nn_parts(files[name])
    known = [part[4:] for kind, part in cut if kind == "text"]
    if random.random() < 0.2:
        return {name: mutation.parts([p for _, p in cut], random, mutation.damaged)}
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(cut))
        cut[at] = ("bytes", _nn_field(*cut[at], random, known))
    return {name: b"".join(part for _, part in cut)}


def _index(data: bytes, random: Random) -> bytes:
    """A table with its entries changed, written anew with right checksums."""
    pairs = [list(pair) for pair in read_table(data)]
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(pairs))
        how = random.random()
        if how < 0.55:
            pairs[at][1] = mutation.protobuf(pairs[at][1], random) if pairs[at][1] else b""
        elif how < 0.7:
            pairs[at][0] = mutation.text(random, [bytes(k) for k, _ in pairs])
        elif how < 0.8:
            pairs[at][1] = pairs[random.randrange(len(pairs))][1]
        elif how < 0.9 and len(pairs) > 1:
            del pairs[at]
        else:
            pairs.append([pairs[at][0] + random.choice((b"", b"x", b"/Adam")), pairs[at][1]])
    if random.random() < 0.9:
        pairs.sort()

    made = [(bytes(k), bytes(v)) for k, v in pairs]
    size = {"per_block": random.choice((1, 2, 8)), "interval": random.choice((1, 4))}
    return table(made, **size)


def _tables(table: dict[str, Any]) -> list[dict[str, Any]]:
    """A table of a flatbuffer and all in it."""
    found = [table]
    for value in table.values():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, dict):
                found += _tables(each)
    return found


def _field(table: dict[str, Any], random: Random, known: list[dict[str, Any]]) -> None:
    if not table:
        return
    name = random.choice(sorted(table))
    value = table[name]
    if random.random() < 0.1:
        del table[name]
    elif isinstance(value, int):
        table[name] = random.choice((mutation.number(random, value), random.randrange(8)))
    elif isinstance(value, float):
        table[name] = random.choice(mutation.FLOATS)
    elif isinstance(value, str):
        table[name] = mutation.text(random, [str(t.get("name", "")).encode() for t in known]).decode("utf-8", "replace")
    elif isinstance(value, dict):
        table[name] = random.choice(known)
    elif isinstance(value, bytes) or getattr(value, "dtype", None) == np.uint8:
        table[name] = mutation.damaged(bytes(value), random)
    elif isinstance(value, np.ndarray) or (value and not isinstance(value[0], dict)):
        numbers = [*map(int, value)]
        at = random.randrange(len(numbers) + 1)
        new = random.choice((mutation.number(random), random.randrange(40), -1))
        numbers[at : at + random.choice((0, 1, 1))] = [new] * random.choice((0, 1, 1, 4))
        table[name] = numbers
    elif value:
        at = random.randrange(len(value))
        table[name] = value[:at] + random.choice(([], value[:at], [random.choice(value)])) + value[at + 1 :]


def flatbuffer(files: Files, random: Random) -> Files:
    """Fields of the tables changed, and written anew with right offsets; or its bytes."""
    ((name, data),) = files.items()
    for _ in range(8):
        model = copy.deepcopy(decode(data))
        for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
            known = _tables(model)
            _field(random.choice(known), random, known)
        with contextlib.suppress(struct.error, KeyError, OverflowError, TypeError, ValueError, RecursionError):
            data = encode(model).to_bytes()
            break
    for _ in range(random.choice((0, 0, 0, 0, 1, 2))):
        at = 4 * random.randrange(len(data) // 4)
        number = mutation.number(random) & 0xFFFFFFFF
        data = data[:at] + number.to_bytes(4, "little") + data[at + 4 :]
    return {name: data if random.random() < 0.9 else mutation.damaged(data, random)}


def checkpoint(files: Files, random: Random) -> Files:
    chosen = random.choice(sorted(files))
    data = files[chosen]
    if chosen.endswith(".index"):
        data = _index(data, random)
    elif chosen.endswith((".pb", ".meta")):
        kind = schema.GraphDef if chosen.endswith(".pb") else schema.MetaGraphDef
        data = mutation.protobuf(data, random, kind.FromString)
    else:
        data = mutation.damaged(data, random)
    made = {**files, chosen: data}
    if random.random() < 0.03:
        del made[random.choice(sorted(made))]
    return made or files


def saved_model(files: Files, random: Random) -> Files:
    if random.random() < 0.2 and len(files) > 1:
        return checkpoint(files, random)
    return {**files, "saved_model.pb": mutation.protobuf(files["saved_model.pb"], random, schema.SavedModel.FromString)}


def opcodes(pickle: bytes) -> list[bytes]:
    """A pickle cut into its opcodes."""
    starts = [at for _, _, at in pickletools.genops(pickle) if at is not None]
    return [pickle[a:b] for a, b in zip(starts, [*starts[1:], len(pickle)], strict=True)]


_CODES = (
    *(bytes([code]) for code in b"})](N0123RbQtldusea.\x88\x85\x86\x87\x8f\x93\x94"),
    *(b"K\x07", b"J\xff\xff\xff\xff", b"\x8a\x09" + b"\xff" * 8 + b"\x7f", b"G\x7f\xf0\0\0\0\0\0\0", b"\x80\x05"),
    *(b"h\x00", b"h\x01", b"q\x00", b"r\xff\xff\xff\x7f", b"X\x01\x00\x00\x00a", b"X\x02\x00\x00\x00\xff\xfe"),
    *(b"\x96" + b"\xff" * 8, b"\x8e" + b"\xff" * 8, b"B\x02\0\0\0ab", b"ctorch\nFloatStorage\n", b"ctorch\nSize\n"),
    *(b"ccollections\nOrderedDict\n", b"ctorch._utils\n_rebuild_tensor_v2\n", b"cos\nsystem\n"),
)


def opcode(part: bytes, random: Random) -> bytes:
    if len(part) > 1 and random.random() < 0.4:
        return part[:1] + mutation.damaged(part[1:], random)
    return random.choice(_CODES) + (part if random.random() < 0.5 else b"")


def pickled(files: Files, random: Random) -> Files:
    data = files["policy.pt"]
    if not data.startswith(b"PK") or random.random() < 0.05:
        if data.startswith(b"PK"):
            return {"policy.pt": mutation.damaged(data, random)}
        first = data[: pickled_end(data)]
        return {"policy.pt": mutation.parts(_opcodes_of_row(first), random, opcode) + data[len(first) :]}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    name = next(n for n in entries if n.endswith("data.pkl"))
    if random.random() < 0.9:
        entries[name] = mutation.parts(opcodes(entries[name]), random, opcode)
    else:
        other = random.choice(sorted(entries))
        content = entries.pop(other)
        if random.random() < 0.7:
            entries[other] = mutation.damaged(content, random)
    return {"policy.pt": zipped(entries)}


def pickled_end(data: bytes) -> int:
    """Where the pickles of the old form end and the storages begin."""
    stream = io.BytesIO(data)
    for _ in range(5):
        list(pickletools.genops(stream))
    return stream.tell()


def _opcodes_of_row(data: bytes) -> list[bytes]:
    stream, found = io.BytesIO(data), []
    while stream.tell() < len(data):
        begin = stream.tell()
        list(pickletools.genops(stream))
        found += opcodes(data[begin : stream.tell()])
    return found


def saved_zip(files: Files, random: Random) -> Files:
    with zipfile.ZipFile(io.BytesIO(files["policy.zip"])) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    if random.random() < 0.6:
        entries["data"] = _json(entries["data"], random)
    else:
        entries["policy.pth"] = pickled({"policy.pt": entries["policy.pth"]}, random)["policy.pt"]
    return {"policy.zip": zipped(entries)}


def script(files: Files, random: Random) -> Files:
    """The code of a TorchScript module changed, its attributes, or another part of the archive."""
    data = files["policy.pt"]
    if random.random() < 0.05:
        return {"policy.pt": mutation.damaged(data, random)}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        kept = [(e.filename, e.compress_type, archive.read(e)) for e in archive.infolist()]
    draw = random.random()
    chosen = [
        i for i, (n, _, _) in enumerate(kept) if n.endswith(".py" if draw < 0.65 else ".pkl" if draw < 0.9 else "")
    ]
    at = random.choice(chosen)
    name, method, content = kept[at]
    if draw < 0.65:
        content = _code(content.decode(), random).encode("utf-8", "surrogatepass")
    elif draw < 0.9:
        content = mutation.parts(opcodes(content), random, opcode)
    else:
        content = mutation.damaged(content, random)
    kept[at] = name, method, content
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, method, content in kept:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return {"policy.pt": made.getvalue()}


#: What stands in code where a word of it stood.
_WORDS = (
    "-1",
    "0",
    "1",
    "9223372036854775807",
    "1000000",
    "None",
    "True",
    "[]",
    "(1, 2)",
    "input",
    "self",
    "x",
    "1e999",
)
_LINES = (
    "    x = [x, x]", "    input = torch.cat([input, input], 0)", "    for i in range(100):", "    while True:",
    "    if torch.gt(input, 0):", "    return None", "    import os", "    self.training = 3",
    "    x = torch.mul(x, x)",
    "    input = torch.expand(input, [1000, 1000])", "    x = torch.copy_(torch.slice(x, 0, 1), x)",
)  # fmt: skip


def _code(text: str, random: Random) -> str:
    """A program with a word, a number or a line that is another's."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        lines = text.splitlines()
        words = [m.span() for m in re.finditer(r"[\w.]+", text)]
        how = random.randrange(5)
        if how < 3 and words:
            begin, end = random.choice(words)
            other = random.choice(words)
            text = text[:begin] + (text[slice(*other)] if how == 0 else random.choice(_WORDS)) + text[end:]
        elif lines:
            line = random.choice(lines) if how == 3 else random.choice(_LINES)
            place = random.randrange(len(lines) + 1)
            text = "\n".join([*lines[:place], line, *lines[place + random.randrange(2) :]])
    return text


def statistics(files: Files, random: Random) -> Files:
    """The pickle beside a saved model changed; the model itself stays."""
    data = files["vecnormalize.pkl"]
    changed = mutation.damaged(data, random) if random.random() < 0.1 else mutation.parts(opcodes(data), random, opcode)
    return {**files, "vecnormalize.pkl": changed}


def zipped(entries: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A ZIP archive, the same bytes for the same entries."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return made.getvalue()


def _json(data: bytes, random: Random) -> bytes:
    if random.random() < 0.05:
        return mutation.damaged(data, random)
    made = json.dumps(mutation.json_tree(json.loads(data), random))
    return made.encode("utf-8", "surrogatepass")


def tfjs(files: Files, random: Random) -> Files:
    shards = [n for n in files if n.endswith(".bin")]
    if shards and random.random() < 0.1:
        name = random.choice(shards)
        return {**files, name: mutation.damaged(files[name], random)}
    return {**files, "model.json": _json(files["model.json"], random)}


def bundle(files: Files, random: Random) -> Files:
    if random.random() < 0.8:
        return {**files, "policy.json": _json(files["policy.json"], random)}
    ways: dict[str, Callable[[bytes, Random], bytes]] = {
        ".bytes": message(schema.GraphDef.FromString),
        ".onnx": message(onnx_message),
        ".pb": message(schema.SavedModel.FromString),
        ".nn": lambda data, r: nn({"x.nn": data}, r)["x.nn"],
        "model.json": _json,
    }
    name, change = random.choice([(n, c) for end, c in ways.items() for n in sorted(files) if n.endswith(end)])
    data = change(files[name], random)
    content = json.loads(files["policy.json"])
    content["files"][name] = {"sha256": sha256_hex(data), "bytes": len(data)}
    return {**files, name: data, "policy.json": json.dumps(content).encode()}


def keras_config(files: Files, random: Random) -> Files:
    stored = {name: data for name, data in files.items() if name != "weights.npz"}
    stored["config.json"] = _json(files["config.json"], random)
    return {"policy.keras": zipped(stored), "weights.npz": files["weights.npz"]}


#: What the header of an array may say.
_HEADER = tuple(b"1|-1|99999999999999999999|'<U9'|'<f8'|'<M8'|True|None|(|)|'V8'|'O'".split(b"|"))


def recording(files: Files, random: Random) -> Files:
    data = files["recorded.npz"]
    if random.random() < 0.15:
        return {**files, "recorded.npz": mutation.damaged(data, random)}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    for _ in range(random.choice((1, 1, 2))):
        name = random.choice(sorted(entries))
        array = entries.pop(name)
        how = random.random()
        if how < 0.5 and len(array) > 10:  # it may have been damaged before
            head, rest = array[:10], array[10:]
            end = struct.unpack("<H", head[8:10])[0]
            pieces = rest[:end].replace(b"(", b" ( ").replace(b",", b" , ").split(b" ")
            text = mutation.parts([p + b" " for p in pieces], random, lambda _, r: r.choice(_HEADER)).ljust(end)[:end]
            array = head + text + rest[end:]
        elif how < 0.8:
            array = mutation.damaged(array, random)
        entries[name if how < 0.9 else random.choice(("action.npy", "../x.npy", "x", "a\\b.npy"))] = array
    return {**files, "recorded.npz": zipped(entries, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))}
