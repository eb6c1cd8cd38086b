"""The inner tensors of a TensorFlow.js graph model: any node can be fetched, by the graph's own name."""

from __future__ import annotations

import contextlib
import json
from contextlib import AbstractContextManager

from converters.inner import InnerTensors, Loaded, own_names


def inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    """Those of a folder with a model.json; what was fused with its bias or activation is not there."""
    model = json.loads((loaded.path / "model.json").read_bytes())
    return contextlib.nullcontext(
        InnerTensors(own_names(n["name"] for n in model["modelTopology"]["node"]), loaded.run)
    )
