"""What the mutants of each reader start from: files that the project itself generates, small first.

A seed is a folder: relative path → content. ``READERS`` says for each reader which seeds it has and how one is changed.
"""

from __future__ import annotations

import io
import json
import pickletools
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from converters import schema
from converters.barracuda.format import _Parser
from converters.checkpoint.table import read_table
from converters.formats import WRITTEN
from exporter.export.pipeline import ExportOptions, export
from fixtures import FOLDER, path
from signatures.digest import sha256_hex
from signatures.errors import ExportModelError
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import literal, table
from tests.checkpoint.writing import policy as training_policy
from tests.fuzz import mutation
from tests.handmade import constant, continuous_policy, graph_bytes, graph_def, node, sampled_policy
from tests.hostile import test_keras_config, zoo

Files = dict[str, bytes]


@dataclass(frozen=True)
class Reader:
    """``main`` is what is given, "" for the folder; ``takes`` are the commands beside inspect and export."""

    seeds: Callable[[], list[Files]]
    change: Callable[[Files, Random], Files]
    main: str = ""
    takes: str = "source"


def files_of(folder: Path) -> Files:
    """What lies in a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _made(make: Callable[[Path], object]) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        return files_of(Path(folder))


@cache
def _bundles() -> list[Files]:
    """Bundles of policies of all kinds, in all formats."""
    found = []
    with tempfile.TemporaryDirectory() as top:
        sources = [Path(top, "tiny.bytes"), Path(top, "draws.bytes"), path("recurrent"), path("discrete")]
        sources[0].write_bytes(graph_bytes(continuous_policy()))
        sources[1].write_bytes(graph_bytes(sampled_policy()))
        for source in sources:
            for targets in (tuple(f for f in WRITTEN if f != "nn"), ("nn",)):
                try:
                    (done,) = export([source], ExportOptions(Path(top, targets[0]), targets, verify="none"))
                except ExportModelError:  # a draw has no .nn
                    continue
                found.append(files_of(done.folder))
    return found


def _artefacts(prefix: str, suffix: str) -> list[Files]:
    """The files of one format of every bundle, without what carries our contract along where that is a folder."""
    found = []
    for bundle in _bundles():
        part = {k.removeprefix(prefix): v for k, v in bundle.items() if k.startswith(prefix) and k.endswith(suffix)}
        if part:
            found.append(part)
    return found


def _single(name: str, contents: list[bytes]) -> list[Files]:
    return [{name: data} for data in contents]


# ------------------------------------------------------------------ seeds


def _loop() -> bytes:
    """A policy whose mean goes round a loop of old TensorFlow."""
    made = _made(lambda folder: zoo.CASES["frozen graph, a writer in a loop's body"].make(folder, folder / "marker"))
    graph = schema.GraphDef.FromString(made["policy.bytes"])
    kept = [n for n in graph.node if not n.name.startswith("write_file")]
    for each in kept:
        each.input[:] = [i for i in each.input if not i.startswith("^")]
    return schema.serialise(graph_def(kept))


def _frozen() -> list[Files]:
    nodes = continuous_policy()
    shaped = [
        *nodes[:-1],
        constant("size", [-1, 2, 1]),
        constant("axes", [2]),
        node("r", "Reshape", "mu", "size", T=np.float32, Tshape=np.int32),
        node("m", "Mean", "r", "axes", T=np.float32, Tidx=np.int32, keep_dims=False),
        node("c", "ConcatV2", "m", "mu", "one", N=2, T=np.float32, Tidx=np.int32),
        constant("one", 1),
        node("s", "StridedSlice", "c", "b", "e", "d", begin_mask=1, end_mask=1, T=np.float32, Index=np.int32),
        *(constant(n, v) for n, v in (("b", [0, 1]), ("e", [0, 3]), ("d", [1, 1]))),
        node("action", "Tanh", "s", T=np.float32),
    ]
    small = [graph_bytes(n, p) for n, p in ((nodes, 0), (sampled_policy(), 26), (shaped, 26))]
    large = [path(name).read_bytes() for name in ("recurrent", "discrete", "twobrains")]
    return _single("policy.bytes", [*small, *small, _loop(), *large])


def _onnx() -> list[Files]:
    files = sorted([*(FOLDER / "sb3").glob("*.onnx"), *(FOLDER / "torch_checkpoint").glob("*.onnx")])
    weights = (FOLDER / "sb3" / "torch_actor.onnx.data").read_bytes()
    found = _single("policy.onnx", [zoo.onnx_policy(), *(f.read_bytes() for f in files)])
    for each in found:
        if b"torch_actor.onnx.data" in each["policy.onnx"]:
            each["torch_actor.onnx.data"] = weights
    return [*found, *({"policy.onnx": data} for files_ in _artefacts("", ".onnx") for data in files_.values())]


def _saved_models() -> list[Files]:
    found = [{k.removeprefix("saved_model/"): v for k, v in f.items()} for f in _artefacts("saved_model/", "")]
    f32 = {"T": np.float32}

    def calling(folder: Path) -> None:
        while_ = node("loop", "While", "zero:output:0", "y:y:0", T=(np.int32, np.float32))
        while_.attr["cond"].func.name, while_.attr["body"].func.name = "cond", "turn"
        graph = zoo.calling([constant("zero", 0), while_], (), "loop:output:1")
        takes = [("i", 3), ("x", 1)]
        less = [constant("two", 2), node("less", "Less", "i", "two:output:0", T=np.int32)]
        zoo.function(graph, "cond", takes, [("r", 10, "less:z:0")], less)
        turn = [constant("one", 1), node("n", "Add", "i", "one:output:0", T=np.int32), node("t", "Tanh", "x", **f32)]
        zoo.function(graph, "turn", takes, [("a", 3, "n:z:0"), ("b", 1, "t:y:0")], turn)
        zoo.saved(folder, graph, "called:0")

    def variables(folder: Path) -> None:
        graph = training_policy()
        zoo.saved(folder, graph.message, "action:0", lambda meta: None)
        write_checkpoint(folder / "saved/variables/variables", graph.variables)

    made = [_made(make) for make in (calling, variables)]
    return [*({k.removeprefix("saved/"): v for k, v in f.items()} for f in (*made, *made)), *found]


def _checkpoints() -> list[Files]:
    def run(meta: bool, op: str, compress: Any) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            graph = training_policy(op=op)
            prefix = folder / "model-10.cptk"
            write_checkpoint(prefix, graph.variables, shards=2 if meta else 1, compress=compress)
            graph.write(folder / ("model-10.cptk.meta" if meta else "raw_graph_def.pb"), meta=meta)
            (folder / "checkpoint").write_text('model_checkpoint_path: "model-10.cptk"\n')

        return make

    ways = ((False, "VariableV2", None), (True, "VarHandleOp", literal), (False, "VarHandleOp", literal))
    return [*(_made(run(*way)) for way in ways), files_of(FOLDER / "trained" / "3DBall")]


def _torch() -> list[Files]:
    return _single("policy.pt", [f.read_bytes() for f in sorted((FOLDER / "torch_checkpoint").glob("*.pt"))])


def _keras() -> list[Files]:
    layers = [test_keras_config.DENSE, test_keras_config.layer("LSTM", "keras.src.layers.rnn.lstm")]
    config = json.dumps(test_keras_config.model(*layers)).encode()
    return [{"config.json": config, "metadata.json": b"{}", "model.weights.h5": b""}]


def _web_layers() -> list[Files]:
    """TensorFlow.js layers models: a chain, and a model of several inputs."""

    def layer(kind: str, **config: Any) -> dict[str, Any]:
        return {"class_name": kind, "config": {"name": kind.lower(), "trainable": True, "dtype": "float32", **config}}

    def weight(name: str, *shape: int) -> dict[str, Any]:
        return {"name": name, "shape": list(shape), "dtype": "float32"}

    def model(kind: str, config: dict[str, Any], weights: list[dict[str, Any]]) -> Files:
        count = sum(int(np.prod(w["shape"])) for w in weights)
        topology = {"keras_version": "tfjs-layers 4.22.0", "backend": "tensor_flow.js", "model_config": None}
        topology["model_config"] = {"class_name": kind, "config": config}  # type: ignore[assignment]
        manifest = [{"paths": ["weights.bin"], "weights": weights}]
        content = {"format": "layers-model", "modelTopology": topology, "weightsManifest": manifest}
        data = np.linspace(-1, 1, count, dtype=np.float32).tobytes()
        return {"model.json": json.dumps(content).encode(), "weights.bin": data}

    dense = layer("Dense", units=2, activation="tanh", use_bias=True)
    chain = [
        layer("Conv2D", filters=2, kernel_size=[2, 2], strides=[1, 1], padding="same", data_format="channels_last",
              activation="relu", use_bias=True, batch_input_shape=[None, 4, 4, 1]),
        layer("MaxPooling2D", pool_size=[2, 2], strides=[2, 2], padding="valid", data_format="channels_last"),
        layer("Flatten"),
        dense,
    ]  # fmt: skip
    steps = [
        layer("LSTM", units=2, activation="tanh", recurrent_activation="sigmoid", use_bias=True, return_sequences=False,
              batch_input_shape=[None, 3, 2]),
        dense,
    ]  # fmt: skip
    given = layer("InputLayer", batch_input_shape=[None, 3], sparse=False)
    add = layer("Add")
    nodes = [(given, []), (dense, [["inputlayer", 0, 0, {}]]), (add, [["dense", 0, 0, {}], ["dense", 0, 0, {}]])]
    layers = [{**x, "name": x["config"]["name"], "inbound_nodes": [i] if i else []} for x, i in nodes]
    ends = {"input_layers": [["inputlayer", 0, 0]], "output_layers": [["add", 0, 0]]}
    kernel = [weight("dense/kernel", 8, 2), weight("dense/bias", 2)]
    recurrent = [weight("lstm/kernel", 2, 8), weight("lstm/recurrent_kernel", 2, 8), weight("lstm/bias", 8)]
    return [
        model("Sequential", {"name": "s", "layers": chain},
              [weight("conv2d/kernel", 2, 2, 1, 2), weight("conv2d/bias", 2), *kernel]),
        model("Sequential", {"name": "s", "layers": steps},
              [*recurrent, weight("dense/kernel", 2, 2), weight("dense/bias", 2)]),
        model("Model", {"name": "m", "layers": layers, **ends}, [weight("dense/kernel", 3, 2), kernel[1]]),
    ]  # fmt: skip


def _saved_zips() -> list[Files]:
    return [{"policy.zip": f.read_bytes()} for f in sorted((FOLDER / "sb3_zip").glob("*.zip"))]


# ------------------------------------------------------------------ changes


def _one(change: Callable[[bytes, Random], bytes]) -> Callable[[Files, Random], Files]:
    """The model's own file changed, seldom another of the folder."""

    def changed(files: Files, random: Random) -> Files:
        name = max(files, key=lambda n: not n.endswith(".data"))
        other = random.choice(sorted(files))
        if other != name and random.random() < 0.1:
            return {**files, other: mutation.damaged(files[other], random)}
        return {**files, name: change(files[name], random)}

    return changed


def _message(whole: Callable[[bytes], object]) -> Callable[[bytes, Random], bytes]:
    return lambda data, random: mutation.protobuf(data, random, whole)


def _onnx_message(data: bytes) -> object:
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


def _nn(files: Files, random: Random) -> Files:
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

    def compress(content: bytes) -> bytes:
        packed = literal(content)
        return mutation.damaged(packed, random) if random.random() < 0.2 else packed

    made = [(bytes(k), bytes(v)) for k, v in pairs]
    size = {"per_block": random.choice((1, 2, 8)), "interval": random.choice((1, 4))}
    return table(made, **size, compress=compress if random.random() < 0.4 else None)  # type: ignore[arg-type]


def _checkpoint(files: Files, random: Random) -> Files:
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


def _saved_model(files: Files, random: Random) -> Files:
    if random.random() < 0.2 and len(files) > 1:
        return _checkpoint(files, random)
    return {**files, "saved_model.pb": mutation.protobuf(files["saved_model.pb"], random, schema.SavedModel.FromString)}


def _opcodes(pickle: bytes) -> list[bytes]:
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


def _opcode(part: bytes, random: Random) -> bytes:
    if len(part) > 1 and random.random() < 0.4:
        return part[:1] + mutation.damaged(part[1:], random)
    return random.choice(_CODES) + (part if random.random() < 0.5 else b"")


def _pickled(files: Files, random: Random) -> Files:
    data = files["policy.pt"]
    if not data.startswith(b"PK") or random.random() < 0.05:
        if data.startswith(b"PK"):
            return {"policy.pt": mutation.damaged(data, random)}
        first = data[: pickled_end(data)]
        return {"policy.pt": mutation.parts(_opcodes_of_row(first), random, _opcode) + data[len(first) :]}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    name = next(n for n in entries if n.endswith("data.pkl"))
    if random.random() < 0.9:
        entries[name] = mutation.parts(_opcodes(entries[name]), random, _opcode)
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
        found += _opcodes(data[begin : stream.tell()])
    return found


def _saved_zip(files: Files, random: Random) -> Files:
    with zipfile.ZipFile(io.BytesIO(files["policy.zip"])) as archive:
        entries = {e.filename: archive.read(e) for e in archive.infolist()}
    if random.random() < 0.6:
        entries["data"] = _json(entries["data"], random)
    else:
        entries["policy.pth"] = _pickled({"policy.pt": entries["policy.pth"]}, random)["policy.pt"]
    return {"policy.zip": zipped(entries)}


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


def _tfjs(files: Files, random: Random) -> Files:
    shards = [n for n in files if n.endswith(".bin")]
    if shards and random.random() < 0.1:
        name = random.choice(shards)
        return {**files, name: mutation.damaged(files[name], random)}
    return {**files, "model.json": _json(files["model.json"], random)}


def _bundle(files: Files, random: Random) -> Files:
    if random.random() < 0.8:
        return {**files, "policy.json": _json(files["policy.json"], random)}
    ways: dict[str, Callable[[bytes, Random], bytes]] = {
        ".bytes": _message(schema.GraphDef.FromString),
        ".onnx": _message(_onnx_message),
        ".pb": _message(schema.SavedModel.FromString),
        ".nn": lambda data, r: _nn({"x.nn": data}, r)["x.nn"],
        "model.json": _json,
    }
    name, change = random.choice([(n, c) for end, c in ways.items() for n in sorted(files) if n.endswith(end)])
    data = change(files[name], random)
    content = json.loads(files["policy.json"])
    content["files"][name] = {"sha256": sha256_hex(data), "bytes": len(data)}
    return {**files, name: data, "policy.json": json.dumps(content).encode()}


def _keras_config(files: Files, random: Random) -> Files:
    return {"policy.keras": zipped({**files, "config.json": _json(files["config.json"], random)})}


def _recordings() -> list[Files]:
    """Three rows of each policy, under the names that its contract has."""
    return [
        {"policy.bytes": path(n).read_bytes(), "recorded.npz": _three(n)}
        for n in ("continuous", "recurrent", "discrete")
    ]


def _three(name: str) -> bytes:
    made = io.BytesIO()
    with np.load(path(f"{name}.npz")) as arrays:
        rows = {k.rpartition("/")[2]: a for k, a in arrays.items() if k.startswith("b3/") and a.ndim}
    np.savez(made, **rows)
    return made.getvalue()


#: What the header of an array may say.
_HEADER = tuple(b"1|-1|99999999999999999999|'<U9'|'<f8'|'<M8'|True|None|(|)|'V8'|'O'".split(b"|"))


def _recording(files: Files, random: Random) -> Files:
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


def _tables() -> Iterator[tuple[str, Reader]]:
    yield "frozen graph", Reader(_frozen, _one(_message(schema.GraphDef.FromString)), "policy.bytes")
    yield "SavedModel", Reader(_saved_models, _saved_model)
    yield "ONNX", Reader(_onnx, _one(_message(_onnx_message)), "policy.onnx")
    yield "Barracuda .nn", Reader(lambda: _single_nn(), _nn, "policy.nn")
    yield "checkpoint", Reader(_checkpoints, _checkpoint)
    yield "PyTorch", Reader(_torch, _pickled, "policy.pt")
    yield "TensorFlow.js", Reader(lambda: _artefacts("tfjs/", ""), _tfjs)
    yield "layers model", Reader(_web_layers, _tfjs)
    yield "Stable-Baselines3", Reader(_saved_zips, _saved_zip, "policy.zip")
    yield "bundle", Reader(_bundles, _bundle, takes="bundle")
    yield "Keras", Reader(_keras, _keras_config, "policy.keras", takes="configuration")
    yield "recording", Reader(_recordings, _recording, takes="recording")


def _single_nn() -> list[Files]:
    return [{"policy.nn": data} for files in _artefacts("", ".nn") for data in files.values()]


READERS: dict[str, Reader] = dict(_tables())


def mutant(reader: str, number: int) -> Files:
    """The files of the mutant with this number; the same every time."""
    random = Random(f"{reader} {number}")
    seeds = _seeds(reader)
    (seed,) = random.choices(seeds, [1 / sum(map(len, files.values())) for files in seeds])
    try:
        return READERS[reader].change(seed, random)
    except RecursionError:  # JSON that was nested again and again
        return READERS[reader].change(seed, Random(f"{reader} {number} again"))


@cache
def _seeds(reader: str) -> list[Files]:
    return READERS[reader].seeds()
