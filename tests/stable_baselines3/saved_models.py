"""Saved models of ``fixtures/sb3_zip``, put together from their data and shapes where only these are kept."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from fixtures.sb3_zip import FOLDER, ROWS, WHOLE, weight
from fixtures.torch_checkpoint.cases import waves
from tests.torch_checkpoint.pt_files import Writer, zipped


def saved(name: str, folder: Path) -> Path:
    """The model's ZIP: as the library wrote it, or put together from its data and shapes."""
    if name in WHOLE:
        return FOLDER / f"{name}.zip"
    about = json.loads((FOLDER / f"{name}.json").read_text())
    writer = Writer()
    state = {}
    for key, entry in about["tensors"].items():
        state[key] = weight(key, waves(entry["waves"], entry["shape"]))
    path = folder / f"{name}.zip"
    path.write_bytes(
        zipped({"data": json.dumps(about["data"]).encode(), "policy.pth": writer.zip(writer.state(state))})
    )
    return path


def answered(policy: Policy, golden: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What a policy gives of the inputs that were recorded with a model (``in/…``); without noise where none was."""
    given = {k.removeprefix("in/").replace(" ", "_"): v for k, v in golden.items() if k.startswith("in/")}
    feeds = {}
    for spec in policy.signature.inputs:
        key = spec.source if spec.source in given else spec.name
        rows = tuple(ROWS if n is None else n for n in spec.shape)
        known = given.get(str(key), np.zeros(rows)) if key == "epsilon" else given[str(key)]
        feeds[spec.name] = known.astype(spec.dtype)
    return run_graph(policy.graph, feeds, [s.name for s in policy.signature.outputs])
