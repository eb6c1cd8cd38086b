"""A PyTorch checkpoint of ML-Agents as a source: what is left where the export to ONNX failed."""

from __future__ import annotations

from converters.fetch import Fetched
from converters.source import ReadOptions, SourceModel
from converters.torch_checkpoint.archive import Archive
from converters.torch_checkpoint.policy import to_graph
from converters.torch_checkpoint.state import State


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a checkpoint (``checkpoint.pt``, ``<behavior>-<step>.pt``).

    Raises NotAPolicyError for another file of PyTorch's, SourceError for a network that is not built or whose sensors
    the weights do not tell, DamagedFileError, UsageError for sensors that do not fit.
    """
    graph, facts = to_graph(State(Archive(given.data)), options.sensors, options.goals)
    return [SourceModel(graph, (given.path,), facts)]
