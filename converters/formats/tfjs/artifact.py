"""An artefact that is a TensorFlow.js graph model.

What it takes and gives, by its signature, its inner tensors, and what of it a runtime may be given. Its loader reads
whatever path the manifest names: the copy for a runtime has its weights in files of our own names, control inputs left
out, and no op but those that compute.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from export_model.converters.files.fetch import MAX_BYTES, read_bytes
from export_model.converters.files.file_probe import json_in
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.format import Port, Ports
from export_model.converters.formats.intermediate_tensors import InnerTensors, Loaded, RunAll, own_names, samplers_of
from export_model.converters.formats.subgraph import COMPUTING
from export_model.converters.formats.tfjs.reader import MODEL, read_signature, shard
from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.table import CALLING, ORDERING, unsupported_error
from export_model.signatures.errors import DamagedFileError


def ports(path: Path) -> Ports:
    """The ports of a folder, or of its model.json. Raises DamagedFileError."""
    file = path / MODEL if path.is_dir() else path
    signature, nodes = read_signature(file)
    inputs, outputs = signature.ports()
    if not inputs:  # the official converter writes none for a frozen graph: placeholders are fed
        inputs = tuple(Port(name) for name, op in nodes.items() if op == "Placeholder")
    return Ports(file.parent, inputs, outputs)


def inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    """Those of a folder with a model.json; what was fused with its bias or activation is not there."""
    model = json_in((loaded.path / MODEL).read_bytes())
    nodes = model["modelTopology"]["node"]
    samplers = samplers_of({n["name"]: (n["op"], n.get("input", ())) for n in nodes}, "int32")

    @contextlib.contextmanager
    def open_copy(draws: Mapping[str, int], fetch: Sequence[str]) -> Iterator[RunAll]:
        """A copy with inputs in place of samplers: TensorFlow.js takes no classes for the output of one."""
        if not draws:
            yield loaded.run_all
            return
        kinds = {s.tensor: "DT_INT32" if s.scores is not None else "DT_FLOAT" for s in samplers if s.tensor in draws}
        given = {n: {"name": n, "op": "Placeholder", "attr": {"dtype": {"type": kind}}} for n, kind in kinds.items()}
        signature = {**(model.get("signature") or {})}
        taken = {n: {"name": f"{n}:0", "dtype": kind} for n, kind in kinds.items()}
        signature["inputs"] = {**signature.get("inputs", {}), **taken}
        graph = {**model["modelTopology"], "node": [given.get(n["name"], n) for n in nodes]}
        with scratch_folder() as folder:
            copy = shutil.copytree(loaded.path, Path(folder) / "model")
            (copy / MODEL).write_text(json.dumps({**model, "modelTopology": graph, "signature": signature}), "utf-8")
            with loaded.pool.process(loaded.runtime).load(str(copy), kind="graph", format="tfjs") as one:
                yield one.run_all

    view = own_names(n["name"] for n in nodes)
    return contextlib.nullcontext(InnerTensors(view, loaded.run, samplers=samplers, opened=open_copy))


#: What the official converter makes of other ops, and what TensorFlow 2 writes loops with: in memory, all of them.
_OWN = frozenset(
    (
        *("FusedDepthwiseConv2dNative", "Prelu"),
        *("TensorListConcat", "TensorListConcatV2", "TensorListResize", "EmptyTensorList"),
        *("TensorListPushBack", "TensorListPopBack", "TensorListGather", "TensorListScatter", "TensorListScatterV2"),
        *("TensorListSplit", "StatelessRandomNormal", "StatelessRandomUniform", "LinSpace"),
    )
)
#: What a loader reads of a model, and of its graph: not the graph of an initialiser, which it would run.
_PARTS = ("format", "generatedBy", "convertedBy", "signature", "userDefinedMetadata")
_GRAPH = ("node", "versions", "library")
_FIX = "convert the model again with the official converter, the policy's outputs only"


def safe_copy(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    """A copy in ``folder`` of the model in the folder ``path``.

    Raises UnsupportedOpError where an op does more than compute, SourceError where weights lie elsewhere,
    DamagedFileError.
    """
    try:
        model = json_in(read_bytes(path / MODEL))
        functions = (model["modelTopology"].get("library") or {}).get("function") or ()
        nodes = [*model["modelTopology"]["node"], *(n for f in functions for n in f.get("nodeDef") or ())]
        names = {str(f["signature"]["name"]) for f in functions}
        refused = [Node(str(n["name"]), str(n["op"])) for n in nodes if not _computes(str(n["op"]), names)]
        for node in nodes:
            node["input"] = [i for i in node.get("input") or () if not i.startswith("^")]
        manifest, files = _manifest(model.get("weightsManifest") or (), path)
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DamagedFileError(
            "model.json is not in TensorFlow.js's form", why=f"{type(error).__name__}: {error}"[:200], fix=_FIX
        ) from error
    if refused:
        raise unsupported_error(refused)
    copy = folder / (path.resolve().name or "model")
    copy.mkdir()
    graph = {key: model["modelTopology"][key] for key in _GRAPH if key in model["modelTopology"]}
    kept = {key: model[key] for key in _PARTS if key in model}
    content = {**kept, "modelTopology": graph, "weightsManifest": manifest}
    (copy / MODEL).write_text(json.dumps(content), encoding="utf-8")
    for name, source in files.items():
        (copy / name).write_bytes(read_bytes(source, empty=True))
    return copy


def _computes(op: str, functions: set[str]) -> bool:
    return op in COMPUTING or op in ORDERING or op in _OWN or op in CALLING or op in functions


def _manifest(given: Sequence[Mapping[str, Any]], folder: Path) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """(the groups of weights with our names for their files, name → the file it is a copy of)."""
    files: dict[str, Path] = {}
    groups = []
    for group in given:
        names = []
        for path in _shards(group["paths"], folder, files):
            name = f"shard-{len(files)}.bin"
            files[name] = path
            names.append(name)
        groups.append({"paths": names, "weights": group["weights"]})
    if sum(p.stat().st_size for p in files.values() if p.is_file()) > MAX_BYTES:
        raise DamagedFileError("its weights together are larger than 2 GiB", fix=_FIX)
    return groups, files


def _shards(names: Sequence[str], folder: Path, known: Mapping[str, Path]) -> Iterator[Path]:
    for name in names:
        path = shard(folder, name)
        if path in known.values():
            raise DamagedFileError(f"model.json names the weights {name[:120]!r} twice", fix=_FIX)
        yield path
