"""An artefact that is a SavedModel: what it takes and gives, by the signature for the policy, and its inner tensors.

A signature gives its outputs only, so for the tensors inside its graph is run in a session.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.format import Ports
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.intermediate_tensors import Feeds, InnerTensors, Loaded, own_names, samplers_of
from export_model.converters.formats.saved_model.reader import read_saved_model
from export_model.converters.formats.saved_model.source import FILE, frozen_model, values_beside
from export_model.converters.formats.source import OriginalRun
from export_model.converters.formats.subgraph import subgraph
from export_model.converters.graph.nodes import Graph, normal_ref
from export_model.signatures.errors import NotAPolicyError


def ports(path: Path) -> Ports:
    """The ports of a folder, or of its saved_model.pb. Raises SourceError, NotAPolicyError, DamagedFileError."""
    file = path / "saved_model.pb" if path.is_dir() else path
    signature = read_saved_model(read_bytes(file)).signature
    if signature.key is None:
        raise NotAPolicyError(
            "the SavedModel has no signature",
            where=str(path),
            why="nobody can call it by name",
            fix="save it with signatures={'serving_default': …}",
        )
    options = {"kind": "saved_model", "signature": signature.key}
    return Ports(file.parent, *signature.ports(), options)


def graph(folder: Path) -> Graph:
    """The graph of a SavedModel of ours. Raises SourceError and its like where the file is damaged."""
    saved = read_saved_model((folder / FILE).read_bytes())
    values = values_beside(folder)
    return from_graph_def(saved.graph_def, saved.detached) if values is None else frozen_model(saved, values).graph


@contextmanager
def inner(loaded: Loaded) -> Iterator[InnerTensors]:
    """Those of the graph behind a signature, fed through the signature's own names."""
    saved = read_saved_model((loaded.path / FILE).read_bytes(), loaded.signature or "serving_default")
    fed = {name: normal_ref(tensor.name) for name, tensor in saved.signature.inputs.items()}
    outputs = [tensor.name for tensor in saved.signature.outputs.values()]
    values = values_beside(loaded.path)
    definition = saved.graph_def if values is None else frozen_model(saved, values).definition
    part = subgraph(definition, outputs, fed.values())
    inside = OriginalRun("tensorflow", loaded.path, definition=part, detached=saved.detached)
    with inside.loadable() as (path, options):
        model = loaded.pool.process("tensorflow").load(path, **options)

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        return model.run({fed[n]: a for n, a in feeds.items() if n in fed}, fetch)

    given = {name: normal_ref(tensor.name) for name, tensor in saved.signature.outputs.items()}

    def run_all(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        """Outputs go by the signature's names."""
        names = {given.get(n, n): n for n in fetch}
        fitting = [{fed.get(n, n): a for n, a in feeds.items()} for feeds in inputs]
        return [{names[n]: a for n, a in answer.items()} for answer in model.run_all(fitting, list(names))]

    samplers = samplers_of({n.name: (n.op, n.input) for n in definition.node})
    with model:
        view = own_names(n.name for n in definition.node)
        opened = replace(loaded, run_all=run_all).open_any
        yield InnerTensors(view, run, samplers=samplers, opened=opened)
