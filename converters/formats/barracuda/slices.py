"""The slices that ML-Agents' first converters for ``.nn`` (previews of 0.7) left out, put back.

A discrete action is cut into branches before its softmax, and so are the masks. Those converters bypassed StridedSlice,
so every branch works on the numbers of all branches, and the action is as many times too wide. Unity reads its first
columns, which are the trained distribution but for a factor per branch: drawing and choosing give the same. The
branches' widths are those of the dense layers that were joined; the file has the slices' own bounds, too.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.formats.barracuda.format import Layer, NnModel
from export_model.converters.graph.nodes import reachable
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType
from export_model.signatures.roles import ACTION_SHAPE

_MASKS = "action_masks"


def with_slices(model: NnModel) -> tuple[NnModel, tuple[str, ...]]:
    """Return (the model with its slices, what the user should know).

    The model stays as it is where nothing is missing, or where it cannot be told where the slices belong.
    """
    layers = {layer.name: layer for layer in model.layers}
    total, parts = model.number(ACTION_SHAPE), _parts(layers)
    if not model.from_python or total is None or len(parts) < 2:
        return model, ()
    above = [upstream([part], layers) for part in parts]
    shared = set.intersection(*above)
    own = [names - shared for names in above]
    logits = {name for name in shared if name in layers and len(layers[name].inputs) == len(parts)}
    joined = [name for name in logits if layers[name].type == LayerType.CONCAT]
    widths = _widths(layers, joined, int(total))
    if not widths or not _has_no_slice(own, layers):
        return model, ()
    readers, cuts = _cut(layers, own, widths, (*joined, _MASKS))
    if not readers or set(cuts) & set(layers):
        return model, ()
    note = (
        "the converter of a preview of ML-Agents 0.7 left out the slices that cut the action into branches; they are "
        f"put back ({', '.join(map(str, widths))}). Unity reads the first {int(total)} columns of the file's action: "
        "the same up to a constant per branch, so that it draws and chooses the same"
    )
    return replace(model, layers=tuple(_place_slices(model.layers, readers, cuts))), (note,)


def _has_no_slice(own: Sequence[set[str]], layers: Mapping[str, Layer]) -> bool:
    """Whether no layer is of two branches, and none of a branch is a slice."""
    every = [name for names in own for name in names]
    sliced = any(layers[name].type == LayerType.STRIDED_SLICE for name in every if name in layers)
    return len(every) == len(set(every)) and not sliced


def _cut(
    layers: Mapping[str, Layer], own: Sequence[set[str]], widths: Sequence[int], whole: Sequence[str]
) -> tuple[dict[str, Layer], dict[str, Layer]]:
    """(the layers of each branch that read a tensor of ``whole``, reading their slice of it; these slices), by name."""
    cuts: dict[str, Layer] = {}
    readers: dict[str, Layer] = {}
    for names, begin, width in zip(own, itertools.accumulate(widths, initial=0), widths, strict=False):
        for name in names & set(layers):
            parts = {given: _slice(given, begin, width) for given in layers[name].inputs if given in whole}
            cuts.update({cut.name: cut for cut in parts.values()})
            if parts:
                inputs = tuple(parts[i].name if i in parts else i for i in layers[name].inputs)
                readers[name] = replace(layers[name], inputs=inputs)
    return readers, cuts


def _parts(layers: Mapping[str, Layer]) -> Sequence[str]:
    """The branches that the action is joined from."""
    layer = layers.get("action")
    while layer is not None and layer.type == LayerType.ACTIVATION and layer.activation == Activation.NONE:
        layer = layers.get(layer.inputs[0]) if len(layer.inputs) == 1 else None
    return layer.inputs if layer is not None and layer.type == LayerType.CONCAT else ()


def upstream(names: Iterable[str], layers: Mapping[str, Layer]) -> set[str]:
    """Tensors and all that they are computed from."""
    return reachable(names, lambda name: layers[name].inputs if name in layers else ())


def _widths(layers: Mapping[str, Layer], joined: Sequence[str], total: int) -> tuple[int, ...]:
    """How wide the dense layers are that the one layer of ``joined`` joins; empty where that is not ``total``."""
    if len(joined) != 1:
        return ()
    dense = [layers.get(name) for name in layers[joined[0]].inputs]
    found = tuple(d.datasets[0].shape[-1] for d in dense if d is not None and d.type == LayerType.DENSE and d.datasets)
    return found if len(found) == len(dense) and sum(found) == total and min(found) > 0 else ()


def _slice(given: str, begin: int, width: int) -> Layer:
    return Layer(
        f"{given}/branch_{begin}",
        LayerType.STRIDED_SLICE,
        pad=(0, 0, 0, begin),
        stride=(1, 1, 1, 1),
        pool=(0, 0, 0, begin + width),
        inputs=(given,),
    )


def _place_slices(layers: Sequence[Layer], readers: Mapping[str, Layer], cuts: Mapping[str, Layer]) -> Iterator[Layer]:
    """The layers in the order in which they run, each slice in front of the first that reads it."""
    left = dict(cuts)
    for layer in layers:
        changed = readers.get(layer.name, layer)
        yield from (left.pop(i) for i in changed.inputs if i in left)
        yield changed
