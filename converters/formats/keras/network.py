"""Layers put together as a graph: each call of each layer, in the order in which they depend on one another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.compiler.passes.unroll import MAX_POLICY_NODES
from export_model.converters.formats.keras.layers.resizing import UNTRAINED
from export_model.converters.formats.keras.layers.step import Step
from export_model.converters.formats.keras.layers.table import LAYERS, OPERATIONS
from export_model.converters.formats.keras.model import CallResult, KerasLayer, LayeredModel, input_shape, tensors_in
from export_model.converters.formats.keras.weights import KerasWeights
from export_model.converters.formats.saved_model.signature import ModelSignature, TensorInfo
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import MAX_NAME, NameScope, Node, TensorShape
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, UnsupportedOpError
from export_model.signatures.memories import SeparateMemory
from export_model.signatures.spec import DTYPES

Results = dict[tuple[str, int], list[str]]
_RECURRENT = frozenset(("LSTM", "GRU", "SimpleRNN", "RNN"))
_MAX_DEPTH = 32
#: Calls of models in models: one that is called twice at each level is called 2^levels times.
_MAX_MODELS = 1 << 12
#: What a layer may be told in a call, beside its tensors.
_ARGUMENTS = frozenset(
    (
        *("initial_state", "states", "query", "value", "key", "attention_mask", "mask"),
        *("use_causal_mask", "return_attention_scores"),
    )
)


class UnknownLayerError(NotAPolicyError):
    """A layer that is not read as data; Keras itself may know it."""


class KerasNetwork(Builder):
    """The graph of a model in the making."""

    def __init__(self, version: str) -> None:
        super().__init__(NameScope(()))
        #: ``3.15.1``, ``2.11.0``, ``tfjs-layers 4.22.0``: which defaults and formulas hold
        self.version = version
        self.notes: list[str] = []
        self.models = 0
        #: a state's placeholder → the tensor that holds it after the last step
        self.states: dict[str, str] = {}
        #: what those of stateful layers are called, which are no outputs of the model
        self.kept: dict[str, str] = {}
        #: the outputs' names → their tensors
        self.results: dict[str, str] = {}
        self._single_step = False

    def whole(self, model: LayeredModel, weights: KerasWeights) -> ModelSignature:
        """Build a model; returns its signature on the graph. Raises UnknownLayerError, UnsupportedOpError and more."""
        self._single_step = _carries_state(model)
        places: dict[str, TensorInfo] = {}
        given: dict[CallResult, str] = {}
        layers = {layer.name: layer for layer in model.layers}
        for place in model.inputs:
            given[place] = self._input(layers[place.layer], places)
        self.results = dict(zip(model.outputs, self.model(model, weights, given, "", 0), strict=True))
        for placeholder, name in self.kept.items():
            self.results[name] = self.states[placeholder]
            places[placeholder] = TensorInfo(
                placeholder, FLOAT32, self.nodes[self.position[placeholder]].attrs["shape"]
            )
        self.prefix = ""
        keys = {key: self._output(key, reference) for key, reference in self.results.items()}
        return ModelSignature(places, keys)

    def _output(self, key: str, reference: str) -> TensorInfo:
        return TensorInfo(self.append(Node(self._fresh(key), "Identity", (reference,), origin=key)))

    def _input(self, layer: KerasLayer, places: dict[str, TensorInfo]) -> str:
        """A placeholder for an input, its batch free."""
        if layer.config.get("sparse") or layer.config.get("ragged"):
            raise UnknownLayerError(f"its input {layer.name!r} is sparse or ragged")
        batch, *rest = input_shape(layer)
        if batch is not None:
            self.notes.append(f"the input {layer.name} was saved for {batch} rows; any number is taken")
        if rest and rest[0] is None and len(rest) > 1 and self._single_step:
            rest[0] = 1
            self.notes.append(f"the input {layer.name} takes sequences of any length; one step at a time is exported")
        if None in rest:
            raise NotAPolicyError(
                f"the input {layer.name!r} has the shape {[batch, *rest]}",
                why="only the batch may be free: a game gives the same observation at every step",
                fix="save the model with an Input of a fixed shape, the length of a history included",
            )
        dtype = layer.config.get("dtype") or "float32"
        named = str(dtype["config"]["name"] if isinstance(dtype, Mapping) else dtype)
        if named not in DTYPES:  # np.dtype reads whatever looks like Python in a text
            raise NotAPolicyError(
                f"the input {layer.name!r} has the dtype {named[:80]!r}",
                why=f"a policy is fed numbers: {', '.join(DTYPES)}",
                fix="save the model with an Input of one of these",
            )
        kind = FLOAT32 if named.startswith("float") else np.dtype(named)
        dims = (None, *(int(n) for n in rest if n is not None))
        self.prefix = ""
        made = self.named_input(self._fresh(layer.name), kind, dims, layer.name)
        places[layer.name] = TensorInfo(made, kind, TensorShape(dims))
        return made

    # ------------------------------------------------------------------ calls in their order

    def model(
        self, model: LayeredModel, weights: KerasWeights, given: Mapping[CallResult, str], prefix: str, depth: int
    ) -> list[str]:
        """The outputs of a model whose inputs are ``given``."""
        self.models += 1
        if depth > _MAX_DEPTH or self.models > _MAX_MODELS:
            raise DamagedFileError(
                "its models are nested too deep, or call one another too often", fix="save the model again"
            )
        arrays = weights.among(model.layers)
        results: Results = {(place.layer, place.call): [reference] for place, reference in given.items()}
        first = _first_calls(model)
        for layer, number in _order_calls(model, results, first):
            made = self._call_layer(layer, number, results, arrays, prefix, depth)
            results[layer.name, number + first.get(layer.name, 0)] = made
        return [results[p.layer, p.call][p.tensor] for p in model.outputs.values()]

    def _call_layer(
        self,
        layer: KerasLayer,
        number: int,
        results: Results,
        arrays: Mapping[str, KerasWeights],
        prefix: str,
        depth: int,
    ) -> list[str]:
        call = layer.calls[number]
        args, kwargs = _resolve(list(call.args), results), _resolve(dict(call.kwargs), results)
        path = f"{prefix}{layer.name}"[:MAX_NAME]
        weights = arrays.get(layer.name)
        if layer.model is not None:
            assert weights is not None
            self._check(layer, path, args, kwargs)
            if said := [k for k, v in kwargs.items() if v not in (None, False)]:
                raise UnknownLayerError(f"its model {path!r} is called with {', '.join(said)}")
            tensors = [t for a in args for t in (a if isinstance(a, list) else [a])]
            inputs = dict(zip(layer.model.inputs, tensors, strict=True))
            return self.model(layer.model, weights, inputs, f"{path}/", depth + 1)
        self.prefix = path
        self._check(layer, path, args, kwargs)
        table = OPERATIONS if layer.operation else LAYERS
        if layer.kind not in table:
            raise unknown_layer_error(layer, path)
        step = Step(self, layer, () if weights is None else weights.arrays(layer), args, kwargs, path)
        try:
            made = table[layer.kind](step)
        except UnsupportedOpError as error:
            raise UnknownLayerError(
                f"its layer {path!r} ({layer.kind}) is not read: {error.what}", why=error.why, fix=error.fix
            ) from error
        if layer.operation and (unread := step.unread_settings()):
            raise UnknownLayerError(f"its operation {path!r} ({layer.kind}) has {', '.join(unread)}")
        if step.left:
            raise DamagedFileError(
                f"its layer {path!r} ({layer.kind}) has {len(step.left)} weights more than such a layer",
                fix="save the model again",
            )
        return [made] if isinstance(made, str) else list(made)

    def _check(self, layer: KerasLayer, path: str, args: Any, kwargs: Mapping[str, Any]) -> None:
        """Raise UnknownLayerError where a layer is called or computes in a way that would be left out in silence."""
        flat = [v for a in args for v in (a if isinstance(a, list) else [a])]
        odd = [str(v)[:60] for v in flat if not isinstance(v, str | None)]
        known = {*_ARGUMENTS, "training"} if layer.kind in UNTRAINED else _ARGUMENTS
        odd += [f"{k}={str(v)[:60]}" for k, v in kwargs.items() if v not in (None, False) and k not in known]
        if odd and not layer.operation:  # an operation's are looked at when it is read
            raise UnknownLayerError(f"its layer {path!r} ({layer.kind}) is called with {', '.join(odd)}")
        policy = layer.config.get("dtype")
        if isinstance(policy, Mapping):
            if policy.get("class_name") not in ("DTypePolicy", "Policy"):
                raise UnknownLayerError(f"its layer {path!r} ({layer.kind}) computes in {policy.get('class_name')}")
            policy = policy["config"]["name"]
        for word, bits in (("float16", 16), ("float64", 64)):
            note = f"it was saved to compute in {bits} bits; here it computes in 32"
            if word in str(policy) and note not in self.notes:
                self.notes.append(note)

    # ------------------------------------------------------------------ states

    def state(self, width: int) -> str:
        """A state that a stateful layer keeps from call to call: an input of its own, zeros at first."""
        name = self._fresh("state_in").replace("/", "_")
        made = self.named_input(name, FLOAT32, (None, width), name)
        self.kept[made] = made.replace("state_in", "state_out")
        return made

    def memories(self, names: Mapping[str, str]) -> tuple[SeparateMemory, ...]:
        """The states that are inputs and outputs of the model; ``names`` are the outputs' nodes by their keys."""
        keys = {reference: key for key, reference in self.results.items()}
        found = []
        for taken, given in self.states.items():
            if given in keys:
                shape = (None, self.length(taken, -1))
                found.append(SeparateMemory(taken, names[keys[given]], shape, shape))
        return tuple(found)


def _first_calls(model: LayeredModel) -> dict[str, int]:
    """The number of a layer's first call, where it is not 0: a model was called once while it was made (Keras 2)."""
    counts = {layer.name: len(layer.calls) for layer in model.layers if layer.model is not None}
    calls = [call for layer in model.layers for call in layer.calls]
    places = [*model.outputs.values(), *tensors_in([[c.args, c.kwargs] for c in calls])]
    return {p.layer: 1 for p in places if p.layer in counts and p.call == counts[p.layer]}


def _order_calls(model: LayeredModel, given: Results, first: Mapping[str, int]) -> list[tuple[KerasLayer, int]]:
    """The calls of a model, each behind those that it reads; layers are gone through again and again, as Keras does.

    Raises DamagedFileError where one waits for what no layer gives.
    """
    calls = [(layer, number) for layer in model.layers for number in range(len(layer.calls))]
    if len(calls) > MAX_POLICY_NODES:
        raise NotAPolicyError(
            f"its layers are called {len(calls)} times",
            why=f"no more than {MAX_POLICY_NODES} calls are read; a policy has some tens",
            fix="save the policy alone",
        )
    maker = {(layer.name, number + first.get(layer.name, 0)): at for at, (layer, number) in enumerate(calls)}
    readers: list[list[int]] = [[] for _ in calls]
    missing, turn = [0] * len(calls), [0] * len(calls)
    for at, (layer, number) in enumerate(calls):
        call = layer.calls[number]
        needs = {(p.layer, p.call) for p in (*tensors_in(call.args), *tensors_in(call.kwargs))} - given.keys()
        missing[at] = len(needs)
        for need in needs & maker.keys():
            readers[maker[need]].append(at)
    ready = [at for at, count in enumerate(missing) if not count]
    for at in ready:
        for reader in readers[at]:
            turn[reader] = max(turn[reader], turn[at] + (reader < at))
            missing[reader] -= 1
            if not missing[reader]:
                ready.append(reader)
    if len(ready) < len(calls):
        stuck = next(layer for (layer, _), count in zip(calls, missing, strict=True) if count)
        raise DamagedFileError(f"the layer {stuck.name!r} reads what no layer gives", fix="save the model again")
    return [calls[at] for at in sorted(ready, key=lambda at: (turn[at], at))]


def unknown_layer_error(layer: KerasLayer, path: str) -> UnknownLayerError:
    """A layer that the table does not have."""
    kind = layer.kind if layer.kind.isprintable() else repr(layer.kind)
    return UnknownLayerError(f"its layer {path[:200]!r} is {kind[:200]}, which is not read as data")


def _carries_state(model: LayeredModel) -> bool:
    """Whether a recurrent layer is given its state, or keeps it: then one step is what a policy takes."""
    for layer in model.layers:
        if layer.model is not None and _carries_state(layer.model):
            return True
        if layer.kind in _RECURRENT and (
            layer.config.get("stateful")
            or any(c.kwargs.get("initial_state") is not None or len([*tensors_in(c.args)]) > 1 for c in layer.calls)
        ):
            return True
    return False


def _resolve(value: Any, results: Results) -> Any:
    """Arguments with references in place of their tensors."""
    if isinstance(value, CallResult):
        return results[value.layer, value.call][value.tensor]
    if isinstance(value, dict):
        return {k: _resolve(v, results) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_resolve(v, results) for v in value]
    return value
