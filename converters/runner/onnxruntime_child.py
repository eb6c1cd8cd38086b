"""onnxruntime in its own process: ``python -m converters.runner.onnxruntime_child``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from converters.runner.child import claim_stdout, serve
from converters.runner.wire import Tensors


class _Model:
    def __init__(self, session: Any) -> None:
        self.session = session

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        values = self.session.run(list(fetch), feeds)
        return dict(zip(fetch, values, strict=True))


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    import onnxruntime  # noqa: TID251  this is the child process
    from onnxruntime.capi import onnxruntime_pybind11_state as state  # noqa: TID251

    def load(header: Mapping[str, Any]) -> _Model:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        return _Model(onnxruntime.InferenceSession(header["path"], options, providers=["CPUExecutionProvider"]))

    faults = tuple(kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception))
    serve("onnxruntime", onnxruntime.__version__, load, (*faults, RuntimeError), out)


if __name__ == "__main__":
    main()
