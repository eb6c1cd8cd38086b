"""An artefact that is a LiteRT model: the contract that it holds, its inner tensors, and what of it may be run."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.format import Port, Ports
from export_model.converters.formats.intermediate_tensors import Feeds, InnerTensors, Loaded, RunAll, Sampler, View
from export_model.converters.formats.litert.flatbuffer import Table, decode, encode
from export_model.converters.formats.litert.schema import BUILTINS, OPERATOR_NAMES
from export_model.converters.formats.litert.tensors import dims_of, dtype_of, entry_of, needed_operators
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY, loads
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import UnsupportedOpError


def ports(path: Path) -> Ports:
    """The ports of a file: those of its first signature, or its tensors' own where it has none.

    Raises SourceError, DamagedFileError.
    """
    model = decode(read_bytes(path))
    signatures = {str(s.get("signature_key", "")): s for s in model.get("signature_defs", ())}
    key = next((k for k in ("serving_default", *signatures) if k in signatures), "")
    signature = signatures.get(key, {})
    subgraph = entry_of(model, "subgraphs", signature.get("subgraph_index", 0))

    def side(name: str) -> tuple[Port, ...]:
        named = [(e.get("name", ""), e.get("tensor_index", 0)) for e in signature.get(name, ())]
        return tuple(_port(n, subgraph, i) for n, i in named or [("", int(i)) for i in subgraph.get(name, ())])

    return Ports(path, side("inputs"), side("outputs"), {"kind": "litert", "signature": key})


def _port(name: str, subgraph: Table, number: int) -> Port:
    tensor = entry_of(subgraph, "tensors", number)
    dtype = dtype_of(tensor)
    return Port(name or str(tensor.get("name", "")), None if dtype is None else dtype.name, dims_of(tensor))


def held(path: Path) -> str | None:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    return note(decode(read_bytes(path)), EMBEDDED)


def note(model: Table, name: str) -> str | None:
    """A text of the metadata."""
    for entry in model.get("metadata", ()):
        if entry.get("name") == name:
            return _buffer(model, entry.get("buffer", 0)).decode("utf-8", "replace")
    return None


def _buffer(model: Table, number: int) -> bytes:
    return bytes(entry_of(model, "buffers", number).get("data", b""))


def operator_of(code: Table) -> str:
    """The name of an operator of the list; of one that is not written here its number, or what it calls itself."""
    number = max(code.get("deprecated_builtin_code", 0), code.get("builtin_code", 0))
    return str(code.get("custom_code") or OPERATOR_NAMES.get(number) or f"operator {number}")


def vetted(path: Path, signatures: Sequence[str], folder: Path) -> Path:
    """A copy that has no operators but those that are written here: they compute.

    Raises UnsupportedOpError, DamagedFileError.
    """
    model = decode(read_bytes(path))
    others = [name for name in map(operator_of, model.get("operator_codes", ())) if name not in BUILTINS]
    if others:
        raise UnsupportedOpError(
            f"the .tflite file has {others[0]}",
            issues=[("", name) for name in others],
            why="it is none of the operators that policies are written with here, and may do more than compute",
            fix="convert the policy with builtin operators alone",
        )
    copy = folder / path.name
    encode(model).write(copy)
    return copy


def function_alone(path: Path, function: int, ports: Collection[int]) -> bytes:
    """A copy with one function, that makes nothing but some tensors. Raises SourceError, DamagedFileError."""
    model = decode(read_bytes(path))
    subgraph = entry_of(model, "subgraphs", function)
    operators = needed_operators(subgraph, ports, (int(i) for i in subgraph.get("inputs", ())))
    kept = {"version", "operator_codes", "buffers"}
    alone = {**subgraph, "operators": operators, "outputs": [*ports]}
    return encode({**{k: v for k, v in model.items() if k in kept}, "subgraphs": [alone]}).to_bytes()


#: Operators that draw.
_DRAWS = {"RANDOM_STANDARD_NORMAL": "normal", "RANDOM_UNIFORM": "uniform", "MULTINOMIAL": "categorical"}


@contextmanager
def inner(loaded: Loaded) -> Iterator[InnerTensors]:
    """Those of a signature, in the same runtime: a copy gives them as further outputs."""
    key = loaded.signature or "serving_default"
    model = decode(loaded.path.read_bytes())
    signature = next(s for s in model["signature_defs"] if s["signature_key"] == key)
    subgraph = model["subgraphs"][signature.get("subgraph_index", 0)]
    tensors = subgraph["tensors"]
    numbers = {t["name"]: i for i, t in enumerate(tensors) if t.get("name")}
    kept = _narrow_weights(model, subgraph)
    made = {int(i) for operator in subgraph["operators"] for i in operator["outputs"]} - kept.keys()
    fed = {entry["name"]: entry.get("tensor_index", 0) for entry in signature["inputs"]}

    names = loads(note(model, TENSORS_KEY) or "")

    def view(tensor: str) -> View | None:
        found = names.view(tensor)
        return found if found is not None and found.name in numbers else None

    samplers, turns = _samplers(model, subgraph), itertools.count()

    @contextmanager
    def open_copy(draws: Mapping[str, int], fetch: Sequence[str]) -> Iterator[RunAll]:
        drawn = {numbers[name] for name in draws}
        wider = {
            **subgraph,
            "inputs": [*subgraph["inputs"], *sorted(drawn)],
            "outputs": list(dict.fromkeys([*subgraph["outputs"], *(numbers[n] for n in fetch)])),
            "operators": [o for o in subgraph["operators"] if drawn.isdisjoint(map(int, o["outputs"]))],
        }
        entries = {"inputs": [*signature["inputs"]], "outputs": [*signature["outputs"]]}
        own = {entry["name"] for entry in signature["outputs"]}
        for side, names in (("inputs", draws), ("outputs", [n for n in fetch if n not in own])):
            entries[side] += [{"name": name, "tensor_index": numbers[name]} for name in names]
        copy = {
            **model,
            "subgraphs": [wider if s is subgraph else s for s in model["subgraphs"]],
            "signature_defs": [{**signature, **entries} if s is signature else s for s in model["signature_defs"]],
        }
        file = Path(folder) / f"{next(turns)} {loaded.path.name}"
        encode(copy).write(file)
        with loaded.pool.process(loaded.runtime).load(str(file), kind="litert", signature=key) as one:
            taken = fed.keys() | set(draws)
            yield lambda inputs, names: one.run_all([{n: a for n, a in i.items() if n in taken} for i in inputs], names)

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        values = {n: feeds[n] for n in fetch if n in feeds}
        wanted = [name for name in fetch if numbers[name] in made and name not in values]
        others = [n for n in fetch if n not in values and n not in wanted]
        values |= {n: _constant(model, tensors[kept.get(numbers[n], numbers[n])]) for n in others}
        if wanted:
            with open_copy({s.tensor: feeds[s.tensor].ndim for s in samplers if s.tensor in feeds}, wanted) as run_all:
                values.update(run_all([feeds], wanted)[0])
        return values

    with scratch_folder() as folder:
        yield InnerTensors(view, run, samplers=samplers, opened=open_copy)


def _samplers(model: Table, subgraph: Table) -> tuple[Sampler, ...]:
    """The operators of a function that draw."""
    found, tensors = [], subgraph["tensors"]
    for operator in subgraph["operators"]:
        kind = _DRAWS.get(operator_of(model["operator_codes"][operator.get("opcode_index", 0)]))
        if kind is not None:
            scores = tensors[int(operator["inputs"][0])]["name"] if kind == "categorical" else None
            found.append(Sampler(tensors[int(operator["outputs"][0])]["name"], kind, scores))
    return tuple(found)


def _narrow_weights(model: Table, subgraph: Table) -> dict[int, int]:
    """Weights that the file keeps in fewer bytes: the tensor that is widened → the one that is kept.

    XNNPACK does so before it runs anything, and does not say what came of it.
    """
    code = next((i for i, c in enumerate(model["operator_codes"]) if operator_of(c) == "DEQUANTIZE"), None)
    return {
        int(operator["outputs"][0]): int(operator["inputs"][0])
        for operator in subgraph["operators"]
        if operator.get("opcode_index", 0) == code
    }


def _constant(model: Table, tensor: Table) -> np.ndarray:
    """The numbers of a constant, widened where they are kept in fewer bytes."""
    shape = [int(n) for n in tensor.get("shape", ())]
    array = np.frombuffer(_buffer(model, tensor.get("buffer", 0)), dtype_of(tensor)).reshape(shape)
    kept = tensor.get("quantization")
    if kept is not None:
        sizes = [-1 if axis == kept.get("quantized_dimension", 0) else 1 for axis in range(array.ndim)]
        return np.asarray(array * np.asarray(kept["scale"], np.float32).reshape(sizes))
    return array.astype(np.float32) if array.dtype == np.float16 else array
