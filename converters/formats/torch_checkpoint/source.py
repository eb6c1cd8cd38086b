"""A PyTorch checkpoint as a source, whichever trainer wrote it."""

from __future__ import annotations

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.torch_archive import Archive
from export_model.converters.formats.source import ReadOptions, SourceModel, run_of
from export_model.converters.trainers.registry import rebuild
from export_model.converters.trainers.trainer import Saved


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a checkpoint: ``<behavior>-<step>.pt``, ``model_<n>.pt``, ``<script>.cleanrl_model``.

    Raises NotAPolicyError for another file of PyTorch's, SourceError for a network that is not built or whose sensors,
    activation or script the weights do not tell, DamagedFileError, UsageError for options that do not fit.
    """
    saved = Saved(
        given, Archive(given.data), None, options.sensors, options.goals, options.activation, script=options.script
    )
    made = rebuild(saved)
    return [SourceModel(made.graph, (given.path, *made.files), made.facts, original=run_of(given.path, made.modules))]
