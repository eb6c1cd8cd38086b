"""A PyTorch checkpoint as a source: of ML-Agents, of rsl_rl, of CleanRL's scripts."""

from __future__ import annotations

from dataclasses import replace

from converters.files.fetch import Fetched
from converters.files.torch_archive import Archive
from converters.formats.source import ReadOptions, SourceModel
from converters.trainers import cleanrl, rsl_rl
from converters.trainers.mlagents.policy import to_graph
from converters.trainers.mlagents.state import State
from converters.trainers.pytorch.activations import activation_of
from signatures.errors import UsageError


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a checkpoint: ``<behavior>-<step>.pt``, ``model_<n>.pt``, ``<script>.cleanrl_model``.

    Raises NotAPolicyError for another file of PyTorch's, SourceError for a network that is not built or whose sensors
    or activation the weights do not tell, DamagedFileError, UsageError for options that do not fit.
    """
    archive = Archive(given.data)
    layout = rsl_rl.layout_of(archive.value)
    if layout is not None:
        activation, files, notes = activation_of(given, options.activation, rsl_rl.USUAL)
        graph, facts = rsl_rl.to_graph(archive, layout, activation)
    elif (found := cleanrl.state_of(archive.value)) is not None:
        activation, files, notes = activation_of(given, options.activation, cleanrl.USUAL, found[1].default)
        graph, facts = cleanrl.to_graph(archive, *found, activation, options.sensors)
    else:
        state = State(archive)
        if options.activation is not None:
            raise UsageError(
                "--activation says nothing about ML-Agents", why="its networks have Swish", fix="leave it out"
            )
        graph, facts = to_graph(state, options.sensors, options.goals)
        files, notes = (), ()
    return [SourceModel(graph, (given.path, *files), replace(facts, notes=(*facts.notes, *notes)))]
