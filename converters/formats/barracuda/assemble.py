"""The layers that a policy became as a file: only what is needed, under the names that the consumer looks up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.barracuda.format import Dataset, Layer, NnInput, NnMemory, NnModel
from export_model.converters.graph.ops.barracuda.builder import Draft, NnBuilder
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType
from export_model.signatures.errors import UnsupportedOpError

#: Every Barracuda from 1.0 to 3.0 reads it, and none of the later ones is read by all.
VERSION = 16


def assemble(
    b: NnBuilder,
    inputs: Sequence[NnInput],
    outputs: Sequence[str],
    constants: Mapping[str, np.ndarray],
    memories: Sequence[NnMemory] = (),
) -> NnModel:
    """The model of the layers so far; ``constants`` are what ML-Agents reads before it runs the model."""
    for name, numbers in constants.items():
        b.constant(np.asarray(numbers, np.float32).reshape(1, 1, 1, -1), name)
    ends = {*outputs, *(m.output for m in memories)}
    drafts = _needed_layers(b.drafts, ends | set(constants))
    drafts = _reshape_flattened(b, drafts)
    _check_memories(drafts, memories)
    drafts = _rename_ends(drafts, ends)
    drafts.sort(key=lambda d: d.type != LayerType.LOAD)  # constants first; sorting keeps the order otherwise
    layers, weights, offset = [], [], 0
    for draft in drafts:
        datasets = []
        for name, array in draft.data:
            datasets.append(Dataset(name, tuple(array.shape), offset, 4, array.size))
            weights.append(array.reshape(-1))
            offset += array.size
        layers.append(
            Layer(
                name=draft.name,
                type=int(draft.type),
                activation=int(draft.activation),
                pad=draft.pad,
                stride=draft.stride,
                pool=draft.pool,
                axis=draft.axis,
                alpha=draft.alpha,
                beta=draft.beta,
                inputs=draft.inputs,
                datasets=tuple(datasets),
            )
        )
    return NnModel(
        VERSION,
        tuple(inputs),  # those too that no layer reads (of a policy with a single action): Unity looks for them
        tuple(outputs),
        tuple(memories),
        tuple(layers),
        np.concatenate(weights) if weights else np.zeros(0, np.float32),
    )


def _needed_layers(drafts: Sequence[Draft], roots: set[str]) -> list[Draft]:
    """The layers that something in ``roots`` depends on, in their order."""
    needed = set(roots)
    kept = []
    for draft in reversed(drafts):
        if draft.name in needed:
            needed.update(draft.inputs)
            kept.append(draft)
    return kept[::-1]


#: What reads a Flatten rightly in every Barracuda, because it flattens by itself or counts the elements alone.
FLATTENS_ITSELF = (LayerType.DENSE, LayerType.RESHAPE)


def _reshape_flattened(b: NnBuilder, drafts: Sequence[Draft]) -> list[Draft]:
    """Each Flatten that another layer reads, or that is a result, as a Reshape.

    Up to 2.0.0 Barracuda leaves a tensor as it is in a Flatten of a ``.nn``: slices, sums and joins behind one throw
    (../shared/unity/r3/played.jsonl, 52 files), a Dense flattens by itself (52 files right), and so does a Reshape (1).
    """
    readers: dict[str, set[LayerType]] = {}
    for draft in drafts:
        for name in draft.inputs:
            readers.setdefault(name, set()).add(draft.type)
    return [
        replace(d, type=LayerType.RESHAPE, pool=b.dims_of(d.name))
        if d.type == LayerType.FLATTEN and not readers.get(d.name, {None}) <= {*FLATTENS_ITSELF}
        else d
        for d in drafts
    ]


def _check_memories(drafts: Sequence[Draft], memories: Sequence[NnMemory]) -> None:
    """Raise UnsupportedOpError where a memory that Barracuda keeps is reshaped.

    Its length is not known where 1.0.4 to 1.3.2 plan their tensors: "Cannot reshape array of size 1"
    (../shared/unity/r3/cases/other_nn_barracuda-1.0).
    """
    kept = {m.input for m in memories}
    for draft in drafts:
        if draft.type == LayerType.RESHAPE and kept.intersection(draft.inputs):
            raise UnsupportedOpError(
                f"node {draft.name!r} (Reshape) cannot be written to a .nn: it reshapes the memory {draft.inputs[0]}",
                issues=[(draft.name, "Reshape")],
                why="Barracuda 1.0 to 1.3 does not know a memory's length where it plans its tensors",
                fix="use a project of release 17 or later (--for barracuda-1.4, barracuda-3, unity6)",
            )


def _rename_ends(drafts: Sequence[Draft], ends: set[str]) -> list[Draft]:
    """Linear activations at the end give their name to the layer before them, where nothing else reads that."""
    readers: dict[str, int] = {}
    for draft in drafts:
        for name in draft.inputs:
            readers[name] = readers.get(name, 0) + 1
    made = {d.name: d for d in drafts}
    names: dict[str, str] = {}
    for draft in drafts:
        if draft.name not in ends or draft.type != LayerType.ACTIVATION or draft.activation != Activation.NONE:
            continue
        before = made.get(draft.inputs[0])
        if (
            before is not None
            and before.type != LayerType.LOAD
            and before.name not in ends
            and before.name not in names
        ):
            names[before.name] = draft.name
    swallowed = set(names.values())
    return [
        replace(d, name=names.get(d.name, d.name), inputs=tuple(names.get(i, i) for i in d.inputs))
        for d in drafts
        if d.name not in swallowed
    ]
