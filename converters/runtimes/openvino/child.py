"""OpenVINO in its own process, on the processor: ``python -m export_model.converters.runtimes.openvino.child``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    import openvino

    core = openvino.Core()
    # Without the first a processor that has bfloat16 computes in that.
    settings = {"INFERENCE_PRECISION_HINT": "f32", "EXECUTION_MODE_HINT": "ACCURACY", "INFERENCE_NUM_THREADS": 1}

    class Written:
        """A model that is run as it is."""

        def __init__(self, path: str) -> None:
            self.model = core.compile_model(path, "CPU", settings)
            self.request = self.model.create_infer_request()

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            results = self.request.infer(dict(feeds))
            return {name: np.array(results[self.model.output(name)]) for name in fetch}

    def load(header: Mapping[str, Any]) -> Model:
        return Written(header["path"])

    serve("openvino", openvino.__version__.partition("-")[0], load, (RuntimeError,), out)


if __name__ == "__main__":
    main()
