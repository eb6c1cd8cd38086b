"""PyTorch in its own process, on the processor: ``python -m export_model.converters.runtimes.torch.child``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    import torch

    from export_model.converters.runtimes.torch.networks import NETWORKS, Network
    from export_model.converters.runtimes.torch.script import ScriptedModule

    torch.set_num_threads(1)
    torch.set_grad_enabled(False)

    class Answering:
        """A network that is given tensors by name."""

        network: Network

        def __init__(self, header: Mapping[str, Any]) -> None:
            if header["kind"] == "script":
                self.network = ScriptedModule(header["path"], header["inputs"], header["buffers"], header["states"])
                return
            with np.load(header["path"]) as arrays:  # no pickles
                state = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
            self.network = NETWORKS[header["kind"]](state, header)

        def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
            answers = self.network({name: torch.from_numpy(np.array(array)) for name, array in feeds.items()})
            return {name: answers[name].contiguous().numpy() for name in fetch}

    def load(header: Mapping[str, Any]) -> Model:
        return Answering(header)

    serve("torch", torch.__version__, load, (RuntimeError, AttributeError), out)


if __name__ == "__main__":
    main()
