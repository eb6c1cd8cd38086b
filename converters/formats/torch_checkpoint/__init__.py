"""PyTorch checkpoints (``.pt``): of ML-Agents, rsl_rl, rl_games, skrl, Sample Factory, CleanRL, PPO-PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.torch_checkpoint import source as _source
else:
    (_source,) = defer_imports(__name__, "source")


def _sniff(file: Content) -> bool:
    """What torch.save writes: an archive with a pickle, or pickles in a row."""
    return file.is_torch_row or any(name.endswith("data.pkl") for name in file.entries)


FORMATS = (
    Format(
        key="torch_checkpoint",
        label="a PyTorch checkpoint (.pt)",
        sniff=_sniff,
        read=_source.read,
        takes=frozenset({"sensors", "activation", "script"}),
    ),
)
