"""What an entry of the op table says of the layers that its op becomes in a ``.nn``, and what it may use."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgspec import Struct

from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.values import Value
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType

#: The values of an op's data as the value of its result, or of each.
Lower = Callable[[NnBuilder, Sequence[Value]], "Value | tuple[Value, ...]"]


class Nn(Struct, frozen=True):
    """An op in layers that every Barracuda has; an op of constants alone needs none."""

    #: None: no layer computes it.
    lower: Lower | None
    #: The operands that are data, from and to; the others are read as constants. None: those that it moves, or all.
    data: tuple[int | None, int | None] | None = None
    #: What is said where it has no layer.
    why: str = ""
    #: An image that is to be flattened is taken as it lies.
    takes_images: bool = False
    #: The one layer or activation that is the op: who reads it makes the op.
    kind: LayerType | Activation | None = None


#: The first operand alone is data; none is.
FIRST, NONE = (0, 1), (0, 0)
