"""What a reader knows of a source beside its graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct, field

from export_model.converters.policy.rules import RoleDecision
from export_model.signatures.interface import Interface
from export_model.signatures.memories import SeparateMemory
from export_model.signatures.roles import Constant, Role

#: The note of a source that has float64 numbers.
DOUBLES_NARROWED = "float64 numbers of the source are computed as float32"


class SourceFacts(Struct, frozen=True):
    """What a reader knows of a source beside its graph.

    - ``roles``: placeholders whose role the format says (it goes before names and structure).
    - ``family``, ``algorithm``: where the format tells; else (None) the graph is asked. An empty algorithm: none can be
      told.
    - ``image_layout``: NHWC, or NCHW for torch exports.
    - ``memory_layout``: the memory's parts in order; empty: found from the graph.
    - ``constants``: the ones that are no nodes of the graph.
    - ``distributions``: placeholder → what it is fed, where the format says it.
    - ``bounds``: placeholder → the lowest and highest integer of the source's own dtype, where it was widened.
    - ``from_end``: ids below 0 are counted from the end of their table, and those beyond it refused, as ONNX says; the
      reader looks up the remainder by the table's length.
    - ``outputs``: the nodes that the format declares as outputs, with their roles where it says them; empty: it
      declares none, and any node may be an output.
    - ``rows``: the only number of rows that the source takes, or gets right; None: any.
    - ``notes``: what the user should know of this source.
    - ``labels``: names of observations (by placeholder) and actions, where the source carries them.
    - ``interface``: what the source and the files beside it state of its numbers; observations by placeholder.
    - ``ours``: the source is an artefact of ours, which says all that is known of it.
    - ``model_name``, ``loss``: what the model is called, and what it was trained with, where the format says it.
    - ``memories``: inputs and outputs of their own that are one memory, in the order in which they are joined; None:
      names and shapes tell.
    - ``decisions``: tensor → why the reader gave it its role, for ``inspect --why``.
    """

    roles: Mapping[str, Role] = field(default_factory=dict)
    family: str | None = None
    algorithm: str | None = None
    image_layout: str = "NHWC"
    memory_layout: tuple[str, ...] = ()
    constants: Mapping[str, Constant] = field(default_factory=dict)
    distributions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    bounds: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    from_end: bool = False
    outputs: Mapping[str, Role | None] = field(default_factory=dict)
    rows: int | None = None
    notes: tuple[str, ...] = ()
    labels: Mapping[str, Any] = field(default_factory=dict)
    interface: Interface | None = None
    ours: bool = False
    model_name: str = ""
    loss: str = ""
    memories: tuple[SeparateMemory, ...] | None = None
    decisions: Mapping[str, RoleDecision] = field(default_factory=dict)
