"""Modules of RLlib (``rl_module/<name>/``), and the checkpoints of algorithms that hold them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.rllib import source as _source
else:
    (_source,) = defer_imports(__name__, "source")

FORMATS = (
    Format(
        key="rllib",
        label="a module of RLlib (module_state.pkl)",
        marker="module_state.pkl",
        read=_source.read,
    ),
    Format(
        key="rllib_checkpoint",
        label="a checkpoint of RLlib",
        at=_source.is_checkpoint,
        members=_source.members,
    ),
)
