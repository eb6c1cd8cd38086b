"""What a player meets: a model's inputs and outputs with the lengths that it declares, beside an agent's sensors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from msgspec import Struct

from export_model.converters.consumers.mlagents.names import VECTOR, VISUAL
from export_model.converters.consumers.unity.consumers import Consumer
from export_model.converters.consumers.unity.model import FIRST_VERSION, CheckedModel, InputView
from export_model.converters.consumers.unity.onnx_file import Dims, OnnxFile
from export_model.converters.consumers.unity.rules import observation
from export_model.converters.consumers.unity.settings import Brain
from export_model.converters.formats.barracuda.format import NnModel

_INTEGERS = frozenset({2, 3, 4, 5, 6, 7, 9, 12, 13})  # TensorProto.DataType


class ScenePort(Struct, frozen=True):
    """An input or an output.

    ``dims`` has the batch first and None for a free length; it is None where nobody says it (outputs of a ``.nn``).
    ``view`` is there for inputs. ``sensor`` is the shape that is written into an observation.
    """

    name: str
    index: int
    dims: Dims | None
    whole: bool = False
    view: InputView | None = None
    sensor: tuple[int, ...] = ()

    @property
    def lengths(self) -> tuple[int, ...]:
        """The lengths of one agent; free ones are 1."""
        if self.dims is not None:
            return tuple(max(d or 1, 1) for d in self.dims[1:])
        assert self.view is not None
        return tuple(max(d, 1) for d in (self.view.height, self.view.width, self.view.channels))

    @property
    def size(self) -> int:
        """The numbers of one agent."""
        return math.prod(self.lengths)


class Scene(Struct, frozen=True):
    """A model, imported by a consumer, and the agent that it is to act for, in one mode of inference.

    ``fetched`` are the outputs that the player fetches. Of ``file`` and ``nn`` one is there.
    """

    consumer: Consumer
    model: CheckedModel
    brain: Brain
    fetched: tuple[str, ...]
    file: OnnxFile | None = None
    nn: NnModel | None = None

    def inputs(self) -> Iterator[ScenePort]:
        """The inputs that the player fills."""
        sensed = self.sensor_shapes
        declared = {} if self.file is None else {self.imported_name(i.name): i for i in self.file.inputs}
        for index, view in enumerate(self.model.inputs):
            given = declared.get(view.name)
            dims, whole = (None, False) if given is None else (given.dims or (), not given.is_float)
            yield ScenePort(view.name, index, dims, whole, view, sensed.get(view.name, ()))

    def outputs(self) -> Iterator[ScenePort]:
        """The outputs that the player fetches and the file has."""
        if self.file is None:
            yield from (ScenePort(name, 0, None) for name in self.fetched if name in self.model.outputs)
            return
        shapes = {self.imported_name(name): shape for name, shape in self.file.shapes.items()}
        for value in self.file.model.graph.output:
            name = self.imported_name(value.name)
            if name in self.fetched:
                yield ScenePort(name, 0, shapes.get(name), value.type.tensor_type.elem_type in _INTEGERS)

    def imported_name(self, name: str) -> str:
        """A name as the importer keeps it."""
        return name.removesuffix(":0") if self.consumer.strips_zero else name

    @property
    def old_names(self) -> bool:
        """Whether observations go by the names of API version 2."""
        return not self.consumer.reads_version or self.model.version == FIRST_VERSION

    @property
    def sensor_shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Name of each observation that the agent has → the shape of its sensor; vectors go together in version 2."""
        sensors = [sensor.shape for sensor in self.brain.sensors]
        if not self.old_names:
            return {observation(i): shape for i, shape in enumerate(sensors)}
        cameras = (shape for shape in sensors if len(shape) == 3)
        names: dict[str, tuple[int, ...]] = {f"{VISUAL}{i}": shape for i, shape in enumerate(cameras)}
        if self.consumer.feeds_entities:
            names.update({observation(i): shape for i, shape in enumerate(sensors) if len(shape) == 2})
        vectors = sum(shape[0] for shape in sensors if len(shape) == 1)
        return {**names, VECTOR: (vectors,)} if vectors else names
