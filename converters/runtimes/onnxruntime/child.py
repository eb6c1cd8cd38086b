"""onnxruntime in its own process: ``python -m export_model.converters.runtimes.onnxruntime.child``.

A model of ours is loaded as it lies there. A source is loaded with ``lift`` (the values of its samplers of normals,
which become inputs); any of its inner values can then be fetched.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.files.folders import scratch_folder


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    import onnxruntime  # noqa: TID251  this is the child process
    from onnxruntime.capi import onnxruntime_pybind11_state as state  # noqa: TID251

    def session(model: str | bytes) -> Any:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    def fitting(array: Any, shape: Sequence[Any], kind: str) -> Any:
        """A row as the model takes it: one without an axis for the agents, doubles, and integers of fewer bits."""
        dims = [d if isinstance(d, int) else 1 for d in shape]
        if array.ndim != len(dims) and dims and array.size == math.prod(dims):
            array = array.reshape(dims)
        stored = {f"tensor({name})": name for name in ("int8", "uint8", "int16", "uint16")} | {
            "tensor(double)": "float64"
        }
        return array.astype(stored[kind]) if kind in stored else array

    class Written:
        """A model that is run as it is."""

        def __init__(self, path: str) -> None:
            # All sessions of a process begin with one seed; here a start is a load, and what is fixed is the model's.
            onnxruntime.set_seed(secrets.randbits(31))
            self.session = session(path)

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            values = self.session.run(list(fetch), feeds)
            return dict(zip(fetch, values, strict=True))

    from export_model.converters.files.external_data import Detached
    from export_model.converters.formats.onnx.messages import files_of

    class Source:
        """A foreign model: a session for each set of values that is asked for."""

        def __init__(self, path: str, draws: Sequence[str]) -> None:
            from export_model.converters.formats.onnx import edit
            from export_model.converters.formats.onnx.half_precision import widen
            from export_model.converters.formats.onnx.vetted import self_contained_model

            self.cut = edit.cut
            self.detached = Detached()
            model = self_contained_model(Path(path), self.detached)
            widen(model, self.detached)
            self.model = edit.lift_draws(model, draws)
            self.sessions: dict[tuple[str, ...], Any] = {}

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            key = tuple(dict.fromkeys(fetch))
            if key not in self.sessions:
                files = files_of(self.cut(self.model, key), self.detached, "source.onnx")
                with scratch_folder() as folder:
                    for name, data in files.items():
                        data.write(Path(folder, name))
                    self.sessions[key] = session(str(Path(folder, "source.onnx")))
            chosen = self.sessions[key]
            wanted = {i.name: i for i in chosen.get_inputs()}
            given = {n: fitting(a, wanted[n].shape, wanted[n].type) for n, a in feeds.items() if n in wanted}
            values = chosen.run(list(key), given)
            return {n: v.astype(np.float32) if v.dtype == np.float64 else v for n, v in zip(key, values, strict=True)}

    def load(header: Mapping[str, Any]) -> Model:
        if "lift" in header:
            return Source(header["path"], header["lift"])
        return Written(header["path"])

    faults = tuple(kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception))
    serve("onnxruntime", onnxruntime.__version__, load, (*faults, RuntimeError), out)


if __name__ == "__main__":
    main()
