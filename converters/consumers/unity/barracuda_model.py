"""What Barracuda 3.0.0 holds after importing an ONNX or loading a ``.nn``: shapes in N, H, W, C, everything float.

An ONNX input of rank 2, 3, 4 is [N,C], [N,C,W], [N,C,H,W]; a free length is 0. It is kept as [N,W,C], [N,H,W,C] where
the importer takes it for channels last (``channel_order``). The state of an LSTM becomes a memory that the runtime
manages; where it is cut from an input directly, that input is gone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.consumers.mlagents.names import ACTION, CONTINUOUS, DISCRETE
from export_model.converters.consumers.unity.channel_order import keeps_last
from export_model.converters.consumers.unity.consumers import Consumer
from export_model.converters.consumers.unity.findings import Thrown, UnityThrows, null_reference
from export_model.converters.consumers.unity.model import CheckedModel, InputView, truncate
from export_model.converters.consumers.unity.onnx_file import Dims, OnnxFile, attributes
from export_model.converters.formats.barracuda.format import NnModel, four_axes
from export_model.signatures.roles import DISCRETE_SHAPE, MEMORY_SIZE, VERSION_NUMBER

_TO_NCHW = (0, 3, 1, 2)
_INITIAL_H = 5


class BarracudaModel(CheckedModel, Struct, frozen=True):
    """A model in Barracuda; ``constants`` are those that can be found by name."""

    inputs: tuple[InputView, ...]
    outputs: tuple[str, ...]
    memories: tuple[str, ...]
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)

    def constant(self, name: str) -> np.ndarray | None:
        """A constant by its whole name, whatever its type was."""
        return self.constants.get(name)

    def _first(self, name: str) -> int:
        """The first number of a constant that is read without a look whether it is there."""
        found = self.constants.get(name)
        if found is None:
            raise UnityThrows(null_reference(f"constant {name}", f"give the file a constant {name}"))
        if not found.size:
            raise UnityThrows(
                Thrown(
                    "IndexOutOfRangeException",
                    "Index was outside the bounds of the array.",
                    f"constant {name}",
                    f"give {name} a value; it is empty",
                )
            )
        return truncate(found[0])

    _deprecated_number = _first_of_shape = _first
    _shape = constant

    @property
    def version(self) -> int:
        """The API version; a NullReferenceException where the file has none."""
        return self._first(VERSION_NUMBER)

    @property
    def memory_size(self) -> int:
        """The memory's size; a NullReferenceException where the file has none."""
        return self._first(MEMORY_SIZE)

    def fetched_outputs(self, deterministic: bool) -> tuple[str, ...]:
        """The outputs that a player fetches; finding them reads the version too."""
        self._first(VERSION_NUMBER)
        return super().fetched_outputs(deterministic)


class EarlierModel(BarracudaModel, frozen=True):
    """A model in ML-Agents 1.x: a missing shape of actions is not expected, and memories are outputs of their own.

    ``action_alone``: no other output has actions. ``kept`` are the outputs that the memories are made of.
    """

    kept: tuple[str, ...] = ()
    action_alone: bool = False

    def has_discrete(self, deterministic: bool) -> bool:
        """As for continuous actions, the first number of the shape is read without a look whether it is there."""
        if self.names_kinds and self.has_output(DISCRETE):
            self._first(DISCRETE_SHAPE)
        return super().has_discrete(deterministic)

    @property
    def names_kinds(self) -> bool:
        """Whether actions come under names of their kind, which the first releases do not know."""
        return not self.action_alone and super().names_kinds

    def fetched_outputs(self, deterministic: bool) -> tuple[str, ...]:
        """``action``, or the actions by their kinds, and the memories."""
        memory = self.kept if self.memory_size > 0 else ()
        if self.action_alone:
            return (ACTION, *memory)
        kinds = ((CONTINUOUS, self.has_continuous(False)), (DISCRETE, self.has_discrete(False)))
        names = [name for name, there in kinds if there]
        return (*(names if self.names_kinds else [ACTION] if names else []), *memory)


def of_onnx(file: OnnxFile, consumer: Consumer) -> BarracudaModel:
    """The model that the ONNX importer makes; ``importing.refusal`` has said before that it takes the file."""
    memories, taken = _memories(file)
    kept = _kept_inputs(file, consumer)
    inputs = [_input(i.name, i.dims or (), i.name in kept) for i in file.inputs if i.name not in taken]
    found = {name: file.value(name) for name in file.outputs}
    constants = {trim_index(n): v.astype(np.float64).ravel() for n, v in found.items() if v is not None}
    outputs = tuple(trim_index(n) for n in file.outputs)
    if consumer.reads_version:
        return BarracudaModel(tuple(inputs), outputs, memories, constants)
    return EarlierModel(tuple(inputs), outputs, memories, constants, (), consumer.fetches_action_alone)


def of_nn(model: NnModel, consumer: Consumer) -> BarracudaModel:
    """The model that a ``.nn`` holds: constants are datasets of that name, wherever they lie."""
    inputs = []
    for given in model.inputs:
        _, height, width, channels = four_axes(given.shape, f"input {given.name!r}")
        inputs.append(InputView(given.name, height, width, channels, channels))
    constants: dict[str, np.ndarray] = {}
    for layer in model.layers:
        for dataset in layer.datasets:
            end = dataset.offset + dataset.length
            constants.setdefault(dataset.name, model.weights[dataset.offset : end].astype(np.float64))
    memories, kept = tuple(m.input for m in model.memories), tuple(m.output for m in model.memories)
    if consumer.reads_version:
        return BarracudaModel(tuple(inputs), model.outputs, memories, constants)
    # what a memory becomes is fetched by its name, whether or not the file lists it
    outputs = (*model.outputs, *kept)
    return EarlierModel(tuple(inputs), outputs, memories, constants, kept, consumer.fetches_action_alone)


def trim_index(name: str) -> str:
    """A name without the ``:0`` that TensorFlow's exporters leave."""
    return name.removesuffix(":0")


def _kept_inputs(file: OnnxFile, consumer: Consumer) -> Collection[str]:
    """The inputs that are kept as they are declared, channels last."""
    if consumer.reads_version:
        return keeps_last(file) or ()
    return [i.name for i in file.inputs if len(i.dims or ()) == 4] if _keeps_all_nhwc(file) else ()


def _input(name: str, dims: Dims, keeps_nhwc: bool) -> InputView:
    lengths = [d or 0 for d in dims]
    height = width = channels = 1
    if keeps_nhwc and 2 <= len(lengths) <= 4:
        height, width, channels = (*(1,) * (4 - len(lengths)), *lengths[1:])
    elif len(lengths) >= 2:
        channels = lengths[1]
        width = lengths[-1] if len(lengths) > 2 else 1
        height = lengths[-2] if len(lengths) > 3 else 1
    return InputView(trim_index(name), height, width, channels, channels, keeps_nhwc)


def _keeps_all_nhwc(file: OnnxFile) -> bool:
    """Whether Barracuda 1.3 takes a file for TensorFlow's.

    It does where a Transpose to NCHW stands between an input, reshaped or not, and a Conv
    (cases/gray_camera_barracuda-1.0, where two cameras are NCHW and both are taken for NHWC).
    """
    declared = {i.name for i in file.inputs}
    for node in file.model.graph.node:
        perm = attributes(node).get("perm")
        if node.op_type != "Transpose" or perm is None or tuple(perm.ints) != _TO_NCHW:
            continue
        maker: Any = file.producers.get(node.input[0])
        source = maker.input[0] if maker is not None and maker.op_type == "Reshape" else node.input[0]
        readers = file.readers(node.output[0])
        if source in declared and any(r.op_type == "Conv" and r.input[0] == node.output[0] for r in readers):
            return True
    return False


def _memories(file: OnnxFile) -> tuple[tuple[str, ...], set[str]]:
    """(memories, inputs that became one of them): an LSTM's state that is cut from an input directly takes its name."""
    found: list[str] = []
    taken: set[str] = set()
    declared = {i.name for i in file.inputs}
    for node in file.model.graph.node:
        if node.op_type != "LSTM" or len(node.input) <= _INITIAL_H or not node.input[_INITIAL_H]:
            continue
        source = _cut_from(file, node.input[_INITIAL_H])
        if source in declared:
            taken.add(source)
            base = trim_index(source)
            found += [f"{base}_c", f"{base}_h"]
        else:
            found += [f"{node.output[0]}_wm_h", f"{node.output[0]}_wm_c"]
    return tuple(found), taken


def _cut_from(file: OnnxFile, name: str) -> str:
    producer: Any = file.producers.get(name)
    return str(producer.input[0]) if producer is not None and producer.op_type == "Slice" and producer.input else ""
