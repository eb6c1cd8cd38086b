"""What a Keras configuration says: layers, and which call of which gives what to whom. Nothing is built for it.

Three spellings are one form here: Keras 2 and TensorFlow.js (``inbound_nodes: [[["x", 0, 0, {}]]]``), and Keras 3
(``[{"args": [{"class_name": "__keras_tensor__", …}], "kwargs": {}}]``). A sequential model is a chain of calls.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.passes.unroll import MAX_POLICY_NODES
from export_model.converters.graph.nodes import NameScope
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

#: Classes that are models themselves.
MODELS = frozenset(("Functional", "Model", "Sequential"))
#: Classes that a configuration calls by the name that Keras exports; weights lie under their own.
_EXPORTED = {"GroupQueryAttention": "GroupedQueryAttention"}


class CallResult(Struct, frozen=True):
    """The ``tensor``-th result of the ``call``-th call of a layer."""

    layer: str
    call: int
    tensor: int


class LayerCall(Struct, frozen=True):
    """One call of a layer: its arguments, ``CallResult`` where they are tensors."""

    args: tuple[Any, ...]
    kwargs: Mapping[str, Any] = field(default_factory=dict)


class KerasLayer(Struct, frozen=True):
    """A layer by its class and settings; ``model`` is what it holds where it is a model itself."""

    kind: str
    name: str
    config: Mapping[str, Any]
    calls: tuple[LayerCall, ...] = ()
    model: LayeredModel | None = None
    #: whether it is one of Keras 3's operations (``keras.ops``), which are no layers and hold no weights
    operation: bool = False


class LayeredModel(Struct, frozen=True):
    """Layers and their calls; ``outputs`` are keyed by what the model calls them."""

    name: str
    layers: tuple[KerasLayer, ...]
    inputs: tuple[CallResult, ...]
    outputs: Mapping[str, CallResult]


def model_of(config: Any) -> LayeredModel:
    """The model of a configuration. Raises DamagedFileError; KeyError and its like where it is not in Keras' form."""
    layer = layer_of(config)
    if layer.model is None:
        raise DamagedFileError(
            f"its configuration must be of a model; it is of a {layer.kind}", fix="save the whole model"
        )
    return layer.model


def layer_of(entry: Mapping[str, Any]) -> KerasLayer:
    """One layer of a configuration."""
    kind, config = _text(entry["class_name"]), entry["config"]
    kind = _EXPORTED.get(kind, kind)
    module = str(entry.get("module") or "")
    if kind in MODELS:
        name = _text(config["name"] if isinstance(config, Mapping) else entry.get("name", kind.lower()))
        model = _sequential(name, config) if kind == "Sequential" else _functional(name, config)
        return KerasLayer(kind, _text(entry.get("name", name)), {}, _calls(entry.get("inbound_nodes") or ()), model)
    name = _text(entry.get("name") or config.get("name") or kind.lower())
    nodes: Sequence[Any] = entry.get("inbound_nodes") or ()
    # An .h5 of Keras 3 does not say the module: Multiply may be either.
    bare = not module and bool(nodes) and isinstance(nodes[0], Mapping) and "trainable" not in config
    return KerasLayer(kind, name, config, _calls(nodes), operation=bare or ".ops." in f"{module}.")


def _few(entries: Any) -> Any:
    """The layers of a model, which are counted before one is looked at."""
    if len(entries) > MAX_POLICY_NODES:
        raise NotAPolicyError(
            f"it has {len(entries)} layers",
            why=f"no more than {MAX_POLICY_NODES} are read; a policy has some tens",
            fix="save the policy alone",
        )
    return entries


def _text(value: object) -> str:
    """A name; what else stands there may be a tree of any size, which no message should hold."""
    if not isinstance(value, str):
        raise TypeError(f"a name is a {type(value).__name__}")
    return value


def _functional(name: str, config: Mapping[str, Any]) -> LayeredModel:
    layers = tuple(layer_of(entry) for entry in _few(config["layers"]))
    scope = NameScope(())
    outputs = {scope.fresh(key or place.layer): place for key, place in _places(config["output_layers"])}
    return LayeredModel(name, layers, tuple(place for _, place in _places(config["input_layers"])), outputs)


def _sequential(name: str, config: Any) -> LayeredModel:
    """A chain; where the first layer is no input, it says the shape of one."""
    entries = _few(config if isinstance(config, list) else config["layers"])
    layers = [layer_of(entry) for entry in entries]
    if layers and layers[0].kind != "InputLayer":
        first = layers[0]
        shape = first.config.get("batch_input_shape") or (
            config.get("build_input_shape") if isinstance(config, Mapping) else None
        )
        if shape is None and first.model is not None:
            inputs = [x for x in first.model.layers if x.kind == "InputLayer"]
            shape = input_shape(inputs[0]) if len(inputs) == 1 else None
        if shape is None:
            raise DamagedFileError(
                f"the model {name!r} does not say the shape of its input",
                why="it was saved before it was built",
                fix="give it an Input, or call it once, and save it again",
            )
        given = {"batch_shape": shape, "dtype": "float32"}
        if first.kind == "Embedding":
            given["dtype"] = "int32"
        layers.insert(0, KerasLayer("InputLayer", f"{first.name}_input", given))
    if not layers:
        raise DamagedFileError(f"the model {name!r} has no layers", fix="save the model again")
    fed = [LayerCall((CallResult(before.name, 0, 0),)) for before in layers]
    chained = (layers[0], *(replace(layer, calls=(call,)) for layer, call in zip(layers[1:], fed, strict=False)))
    first_place, last = CallResult(chained[0].name, 0, 0), CallResult(chained[-1].name, 0, 0)
    return LayeredModel(name, chained, (first_place,), {last.layer: last})


def input_shape(layer: KerasLayer) -> Sequence[int | None]:
    """The shape of an InputLayer, its batch first."""
    config = layer.config
    shape = config.get("batch_shape", config.get("batch_input_shape"))
    if shape is None:
        shape = (None, *config["input_shape"])
    return tuple(shape)


def cells_of(layer: KerasLayer) -> list[KerasLayer]:
    """The cells of an ``RNN``, which run one after the other at each step; TensorFlow.js lists them."""
    said = layer.config.get("cell") if layer.kind == "RNN" else None
    if isinstance(said, Mapping) and said["class_name"] == "StackedRNNCells":
        said = said["config"]["cells"]
    return [layer_of(entry) for entry in (said if isinstance(said, list) else [said] if said else [])]


# ------------------------------------------------------------------ which call reads what


def _calls(nodes: Sequence[Any]) -> tuple[LayerCall, ...]:
    return tuple(_call_of_keras_3(n) if isinstance(n, Mapping) else _call_of_keras_2(n) for n in nodes)


def _call_of_keras_3(node: Mapping[str, Any]) -> LayerCall:
    return LayerCall(tuple(map(_value, node["args"])), {k: _value(v) for k, v in node["kwargs"].items()})


def _value(value: Any) -> Any:
    """An argument as Keras 3 writes it."""
    if isinstance(value, Mapping):
        kind = value.get("class_name")
        if kind == "__keras_tensor__":
            return _place(value["config"]["keras_history"])
        if kind == "__slice__":
            return slice(*(value["config"][k] for k in ("start", "stop", "step")))
        if kind == "__ellipsis__":
            return Ellipsis
        if kind in ("__tuple__", "__numpy__", "__tensor__"):
            content = value["config"]
            return _value(content["value"] if isinstance(content, Mapping) else content)
        return value
    return [_value(v) for v in value] if isinstance(value, list) else value


def _call_of_keras_2(node: Sequence[Any]) -> LayerCall:
    """``[["x", 0, 0, {}], …]``: one tensor, or a list of them; the first has the keyword arguments."""
    given = node[0][3] if node and len(node[0]) > 3 else {}
    kwargs = {k: _older_value(v) for k, v in (given or {}).items()}
    places = [_place(entry) for entry in node]
    return LayerCall((places[0] if len(places) == 1 else places,), kwargs)


def _older_value(value: Any) -> Any:
    """A keyword argument: ``["x", 0, 0]`` is a tensor."""
    if isinstance(value, list):
        if len(value) >= 3 and isinstance(value[0], str) and all(isinstance(n, int) for n in value[1:3]):
            return _place(value)
        return [_older_value(v) for v in value]
    return value


def _place(entry: Sequence[Any]) -> CallResult:
    return CallResult(str(entry[0]), int(entry[1]), int(entry[2]))


def _places(value: Any) -> Iterator[tuple[str, CallResult]]:
    """(key or an empty name, tensor) of ``input_layers`` and ``output_layers``: one, several, or a dictionary."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from ((name or str(key), place) for name, place in _places(inner))
    elif value and isinstance(value[0], str):
        yield "", _place(value)
    else:
        for inner in value:
            yield from _places(inner)


def tensors_in(value: Any) -> Iterator[CallResult]:
    """The tensors among the arguments of a call."""
    if isinstance(value, CallResult):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from tensors_in(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from tensors_in(inner)
