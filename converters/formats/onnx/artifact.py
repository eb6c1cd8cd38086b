"""An artefact that is an ONNX model: what it takes and gives, the contract that it holds, its inner tensors.

It gives its outputs only: for the tensors inside, a copy with further outputs is loaded beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.folders import scratch_folder
from export_model.converters.files.memory_mapped import Mapped
from export_model.converters.formats.format import Port, Ports
from export_model.converters.formats.intermediate_tensors import Feeds, InnerTensors, Loaded, RunAll, View
from export_model.converters.formats.onnx.edit import cut, lift_draws, samplers_of
from export_model.converters.formats.onnx.messages import files_of
from export_model.converters.formats.onnx.proto import array_of, decode_model, dtype_name, load_external
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY, loads
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.spec import PolicySignature


def ports(path: Path) -> Ports:
    """The ports of a file. Raises SourceError, DamagedFileError."""
    graph = decode_model(read_bytes(path), Detached()).graph
    stored = {t.name for t in graph.initializer}
    inputs = tuple(_port(v) for v in graph.input if v.name not in stored)
    return Ports(path, inputs, tuple(_port(v) for v in graph.output))


def _port(value: Any) -> Port:
    """A length of 0 or below, and a named one, is free (as the importer reads it)."""
    tensor = value.type.tensor_type
    dims = tuple(int(d.dim_value) if d.dim_value > 0 else None for d in tensor.shape.dim)
    return Port(value.name, dtype_name(tensor.elem_type), dims if tensor.HasField("shape") else None)


def embedded_contract(path: Path) -> str | None:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    model = decode_model(read_bytes(path), Detached())
    return next((str(p.value) for p in model.metadata_props if p.key == EMBEDDED), None)


def stated_metadata(signature: PolicySignature) -> Mapping[str, str]:
    """Return the source's own metadata; none where the graph computes its scales: they would be applied twice."""
    interface = signature.interface
    return {} if interface is None or interface.baked else interface.metadata


def misstatement(path: Path, signature: PolicySignature) -> str | None:
    """The key of a model's metadata that is not what the source stated; None where all are. Raises SourceError."""
    model = decode_model(read_bytes(path), Detached())
    found = {str(p.key): str(p.value) for p in model.metadata_props if p.key not in (EMBEDDED, TENSORS_KEY)}
    stated = stated_metadata(signature)
    other = sorted(key for key in found.keys() | stated.keys() if found.get(key) != stated.get(key))
    return f"its metadata has {other[0]!r} as {str(found.get(other[0], 'missing'))[:80]!r}" if other else None


def inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    """Those of a model, in the same runtime; its values are found by the map that the writer left in it."""
    return _inner(loaded)


@contextmanager
def _inner(loaded: Loaded) -> Iterator[InnerTensors]:
    detached, files = Detached(), Mapped()
    model = decode_model(files.read(loaded.path), detached)
    load_external([model.graph], loaded.path.parent, detached, files.read)
    graph = model.graph
    names = loads({p.key: p.value for p in model.metadata_props}.get(TENSORS_KEY, ""))
    constants = {t.name for t in graph.initializer}
    made = {name for node in graph.node for name in node.output}
    fed = frozenset(v.name for v in graph.input) - constants

    def view(tensor: str) -> View | None:
        found = names.view(tensor)
        return found if found is not None and found.name in made | constants | fed else None

    samplers = samplers_of(model)

    @contextmanager
    def open_copy(draws: Mapping[str, int], fetch: Sequence[str]) -> Iterator[RunAll]:
        open_model = type(model)()
        open_model.CopyFrom(model)
        if draws:
            open_model = cut(lift_draws(open_model, draws), fetch)
        known = {o.name for o in open_model.graph.output}
        for name in fetch:
            if name not in known:
                open_model.graph.output.add(name=name)
        taken = {v.name for v in open_model.graph.input} - constants
        with scratch_folder() as folder:
            file = folder / loaded.path.name
            for name, data in files_of(open_model, detached, file.name).items():
                data.write(file.with_name(name))
            one = loaded.pool.process(loaded.runtime).load(str(file), kind="graph")
        with one:
            yield lambda inputs, names: one.run_all([{n: a for n, a in i.items() if n in taken} for i in inputs], names)

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        files.let_go()  # what was fetched before, tensor for tensor
        values = {t.name: array_of(t, detached) for t in graph.initializer if t.name in fetch}
        values.update({name: feeds[name] for name in fetch if name in feeds})
        wanted = [name for name in fetch if name in made and name not in values]
        if wanted:
            draws = {s.tensor: feeds[s.tensor].ndim for s in samplers if s.tensor in feeds}
            with open_copy(draws, wanted) as run_all:
                values.update(run_all([feeds], wanted)[0])
        return values

    yield InnerTensors(view, run, samplers=samplers, opened=open_copy)


def origins(path: Path) -> Mapping[str, str]:
    """Tensor of the graph → tensor of the source, where they are called differently, as our .onnx notes it."""
    model = decode_model(read_bytes(path), Detached())
    return loads(next((p.value for p in model.metadata_props if p.key == TENSORS_KEY), "")).sources
