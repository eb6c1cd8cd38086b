"""What a format, loaded in a runtime, has of the graph's tensors, and how to ask for them.

``.bytes``, SavedModel and TensorFlow.js call their nodes as the graph does, and any can be fetched; what a format has
not (a product that was fused with its bias) is hidden. A SavedModel's signature gives its outputs only, so its graph is
run in a session, fed through the signature's own names. An ONNX model gives its outputs only, too: a copy of it with
further outputs is written to a temporary file and loaded in the same runtime; its values are found by the map that the
writer left in it.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np

from converters import schema
from converters.detached import Detached
from converters.folders import scratch_folder
from converters.frozen_graph.reader import from_graph_def
from converters.frozen_graph.subgraph import subgraph
from converters.graph.nodes import Graph, normal_ref, ref, split_ref
from converters.onnx.files import files_of
from converters.onnx.proto import array_of, decoded, load_external
from converters.onnx.tensor_map import TENSORS_KEY, TensorMap, View, loads
from converters.runtimes.pool import RuntimePool
from converters.runtimes.process import LoadedModel, RunFailedError
from converters.saved_model.reader import read_saved_model
from converters.saved_model.source import FILE, frozen_model, values_beside
from converters.source import OriginalRun
from exporter.verify.participants import Feeds, Participant, Run
from signatures.records import dataclass


@dataclass(frozen=True)
class InnerTensors:
    """``view`` says how the format has a tensor of the graph (None: not at all), ``run`` fetches what it calls so."""

    view: Callable[[str], View | None]
    run: Run
    #: Another tool may have made it: what has a tensor's name may be another tensor.
    foreign: bool = False

    def fetch(self, feeds: Feeds, tensors: Sequence[str]) -> dict[str, np.ndarray]:
        """Tensors of the graph by name, its own axes; raises RunFailedError."""
        views = {tensor: view for tensor in tensors if (view := self.view(tensor)) is not None}
        values = self.run(feeds, list(dict.fromkeys(v.name for v in views.values()))) if views else {}
        return {tensor: view.restored(values[view.name]) for tensor, view in views.items()}


@contextmanager
def inner_tensors(
    participant: Participant, path: Path, pool: RuntimePool, origins: Mapping[str, str] | None = None
) -> Iterator[InnerTensors]:
    """Those of ``participant``, whose file is ``path``. To enter it raises RunFailedError where it is not loaded.

    What any tool may have made is fed by its own names, and its tensors may be called as the source's (``origins``).
    """
    with _of_format(participant, path, pool) as found:
        if participant.fed is None:
            yield found
            return
        own, run, view, origins = participant.fed, found.run, found.view, origins or {}

        def known(tensor: str) -> View | None:
            source = origins.get(tensor, tensor)
            names = (tensor, source, source.removesuffix(":0"), f"{source.removesuffix(':0')}:0")
            return next((v for name in names if (v := view(name)) is not None), None)

        yield InnerTensors(known, lambda feeds, fetch: run(own(feeds), fetch), foreign=True)


def _of_format(participant: Participant, path: Path, pool: RuntimePool) -> AbstractContextManager[InnerTensors]:
    kind, _, key = participant.format.partition(":")
    if kind == "saved_model":
        return _saved_model(path, key or "serving_default", pool)
    if kind == "onnx":
        return _onnx(participant.runtime, path, pool)
    if kind == "nn":  # layers are called otherwise, and several ops are one
        return contextlib.nullcontext(InnerTensors(lambda tensor: None, participant.model.run))
    if kind == "tfjs":
        return contextlib.nullcontext(InnerTensors(_own_name(_tfjs_nodes(path)), participant.model.run))
    return contextlib.nullcontext(InnerTensors(_own_name(_graph_nodes(path)), _not_what_is_fed(participant.model.run)))


def _not_what_is_fed(run: Run) -> Run:
    """TensorFlow 1.x refuses to fetch what it is fed, by the same name: it is what was fed."""

    def only_others(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        others = [name for name in fetch if name not in feeds]
        values = {name: feeds[name] for name in fetch if name in feeds}
        return {**values, **run(feeds, others)} if others else values

    return only_others


def _own_name(nodes: frozenset[str]) -> Callable[[str], View | None]:
    return lambda tensor: View(tensor) if split_ref(tensor)[0] in nodes else None


def _graph_nodes(path: Path) -> frozenset[str]:
    return frozenset(n.name for n in schema.parse(schema.GraphDef, path.read_bytes(), "GraphDef").node)


def _tfjs_nodes(folder: Path) -> frozenset[str]:
    model = json.loads((folder / "model.json").read_bytes())
    return frozenset(n["name"] for n in model["modelTopology"]["node"])


@contextmanager
def _saved_model(folder: Path, key: str, pool: RuntimePool) -> Iterator[InnerTensors]:
    saved = read_saved_model((folder / FILE).read_bytes(), key)
    fed = {name: normal_ref(tensor.name) for name, tensor in saved.signature.inputs.items()}
    outputs = [tensor.name for tensor in saved.signature.outputs.values()]
    values = values_beside(folder)
    definition = saved.graph_def if values is None else frozen_model(saved, values).definition
    part = subgraph(definition, outputs, fed.values())
    inside = OriginalRun("tensorflow", folder, definition=part, detached=saved.detached)
    with inside.loadable() as (path, options):
        model = pool.process("tensorflow").load(path, **options)

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        return model.run({fed[n]: a for n, a in feeds.items() if n in fed}, fetch)

    with _unloading(model):
        yield InnerTensors(_own_name(frozenset(n.name for n in definition.node)), run)


@contextmanager
def _onnx(runtime: str, path: Path, pool: RuntimePool) -> Iterator[InnerTensors]:
    import onnx

    detached = Detached()
    model = decoded(path.read_bytes(), detached)
    load_external([model.graph], path.parent, detached)
    graph = model.graph
    notes = {p.key: p.value for p in model.metadata_props}
    names: TensorMap = loads(notes.get(TENSORS_KEY, ""))
    constants = {t.name for t in graph.initializer}
    made = {name for node in graph.node for name in node.output}
    fed = frozenset(v.name for v in graph.input) - constants

    def view(tensor: str) -> View | None:
        found = names.view(tensor)
        return found if found is not None and found.name in made | constants | fed else None

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        values = {t.name: array_of(t, detached) for t in graph.initializer if t.name in fetch}
        values.update({name: feeds[name] for name in fetch if name in fed})
        wanted = [name for name in fetch if name in made]
        if wanted:
            open_model = onnx.ModelProto()
            open_model.CopyFrom(model)
            known = {o.name for o in graph.output}
            open_model.graph.output.extend(onnx.ValueInfoProto(name=n) for n in wanted if n not in known)
            for name, data in files_of(open_model, detached, file.name).items():
                data.write(file.with_name(name))
            opened = pool.process(runtime).load(str(file), kind="graph")
            with _unloading(opened):
                values.update(opened.run({n: a for n, a in feeds.items() if n in fed}, wanted))
        return values

    with scratch_folder() as folder:
        file = folder / path.name
        yield InnerTensors(view, run)


@contextmanager
def _unloading(model: LoadedModel) -> Iterator[None]:
    try:
        yield
    finally:
        with contextlib.suppress(RunFailedError):  # a runtime that has died has freed it already
            model.unload()


def onnx_sources(path: Path) -> Mapping[str, str]:
    """Tensor of the graph → tensor of the source, where they are called differently, as our .onnx notes it."""
    import onnx

    model = onnx.ModelProto.FromString(path.read_bytes())
    return loads(next((p.value for p in model.metadata_props if p.key == TENSORS_KEY), "")).sources


def saved_graph(folder: Path) -> Graph:
    """The graph of a SavedModel of ours. Raises SourceError and its like where the file is damaged."""
    saved = read_saved_model((folder / FILE).read_bytes())
    values = values_beside(folder)
    return from_graph_def(saved.graph_def, saved.detached) if values is None else frozen_model(saved, values).graph


def outputs_read(nodes: Sequence[str], reads: Sequence[str]) -> dict[str, list[str]]:
    """Node → its tensors that something reads, output 0 where nothing does, in order."""
    found: dict[str, set[int]] = {name: set() for name in nodes}
    for reference in reads:
        name, index = split_ref(reference)
        if name in found:
            found[name].add(index)
    return {name: [ref(name, i) for i in sorted(indices or {0})] for name, indices in found.items()}
