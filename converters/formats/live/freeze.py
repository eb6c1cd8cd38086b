"""What only TensorFlow can freeze: SavedModels of TensorFlow 2, Keras models, functions.

For processes that have imported it: the children, and a training script that gives its model.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from msgspec import Struct

from export_model.converters.graph.ops.table import FUNCTIONAL

TypedTensor = tuple[str, str, list[int | None] | None]


class FrozenFunction(Struct, frozen=True):
    """A flat GraphDef, and which of its tensors are the function's arguments and results, by their names.

    A tensor is its name, its dtype's, and its shape (None: unknown) with None for a free axis.
    """

    graph_def: Any
    inputs: dict[str, TypedTensor]
    outputs: dict[str, TypedTensor]
    signature: str


def frozen_function(path: str, form: str, signature: str | None = None) -> FrozenFunction:
    """The signature of a SavedModel (``form`` "saved_model"), or the call of a Keras model ("keras"), frozen.

    Control flow is lowered to Switch and Merge, functions are inlined, variables become constants.
    """
    import tensorflow as tf  # noqa: TID251  in a child process only
    from tensorflow.python.framework.convert_to_constants import convert_variables_to_constants_v2  # noqa: TID251

    if form == "keras":
        model = tf.keras.models.load_model(path, compile=False)
        call, specs, names = keras_call(model)
        function = tf.function(call).get_concrete_function(*specs)
        keys = keras_outputs(model, len(tf.nest.flatten(function.structured_outputs)))
        used = "call"
    else:
        loaded = tf.saved_model.load(path)
        available = list(loaded.signatures)
        if not available:
            raise ValueError("the SavedModel has no signatures; save it with signatures=…")
        used = signature or ("serving_default" if "serving_default" in available else available[0])
        if used not in available:
            raise ValueError(f"unknown signature {used!r}; there are {', '.join(available)}")
        function = loaded.signatures[used]
        keys = sorted(function.structured_outputs)  # results are flattened in the order of their keys
        names = [t.name.split(":")[0] for t in function.inputs if t.dtype != tf.resource]
        if set(names) != set(function.structured_input_signature[1]):
            names = list(function._arg_keywords)
    frozen = convert_variables_to_constants_v2(function, lower_control_flow=True)
    return FrozenFunction(
        _order_nodes(frozen.graph.as_graph_def(), [t.op.name for t in frozen.inputs]),
        dict(zip(names, map(_typed_tensor, frozen.inputs), strict=True)),
        dict(zip(keys, map(_typed_tensor, frozen.outputs), strict=True)),
        used,
    )


def _typed_tensor(tensor: Any) -> TypedTensor:
    return tensor.name, tensor.dtype.name, None if tensor.shape.rank is None else tensor.shape.as_list()


def _order_nodes(graph_def: Any, first: Sequence[str]) -> Any:
    """The nodes ``first``, then the others by name: the order that TensorFlow gives them differs from run to run."""
    places = {name: i for i, name in enumerate(first)}
    nodes = sorted(graph_def.node, key=lambda n: (places.get(n.name, len(places)), n.name))
    ordered = type(graph_def)()
    ordered.CopyFrom(graph_def)
    del ordered.node[:]
    ordered.node.extend(nodes)
    return ordered


def flatten_graph(graph: Any) -> bytes:
    """The GraphDef of a ``tf.Graph``, deterministic; function calls and functional control flow are inlined.

    The graph is not changed. Control flow becomes Switch and Merge, as in TensorFlow 1.
    """
    graph_def = graph.as_graph_def()
    calls = FUNCTIONAL | {f.signature.name for f in graph_def.library.function}
    if any(node.op in calls for node in graph_def.node):
        places = [node.name for node in graph_def.node if node.op == "Placeholder"]
        graph_def = _order_nodes(_inline_functions(graph_def, calls), places)
    data: bytes = graph_def.SerializeToString(deterministic=True)
    return data


def _inline_functions(graph_def: Any, calls: Collection[str]) -> Any:
    """As ``convert_variables_to_constants_v2`` does it: Grappler, with nothing but its function optimizer."""
    from tensorflow.core.protobuf import config_pb2, meta_graph_pb2  # noqa: TID251  the graph proves that it is loaded
    from tensorflow.python.grappler import tf_optimizer  # noqa: TID251

    meta = meta_graph_pb2.MetaGraphDef()
    meta.graph_def.CopyFrom(graph_def)
    for function in meta.graph_def.library.function:
        function.attr.pop("api_implements", None)  # another implementation for GPUs, which is not inlined
    read = {i.lstrip("^").split(":")[0] for node in graph_def.node for i in node.input}
    kept = [n.name for n in graph_def.node if n.op not in calls and (n.op == "Placeholder" or n.name not in read)]
    meta.collection_def["train_op"].node_list.value.extend(kept)
    config = config_pb2.ConfigProto()
    config.graph_options.rewrite_options.min_graph_nodes = -1
    config.graph_options.rewrite_options.optimizers.append("function")
    return tf_optimizer.OptimizeGraph(config, meta)


def keras_call(model: Any) -> tuple[Callable[..., Any], list[Any], list[str]]:
    """(what a Keras model computes at inference, its arguments' TensorSpecs with a free batch, their names)."""
    import tensorflow as tf  # noqa: TID251  the model proves that it is loaded

    # A layer's name as an argument's: what comes after the last slash, without the output's number.
    names = [t.name.split(":")[0].rsplit("/", 1)[-1] or f"input_{i}" for i, t in enumerate(model.inputs)]
    specs = [
        tf.TensorSpec([None, *t.shape[1:]], t.dtype, name=name) for name, t in zip(names, model.inputs, strict=True)
    ]
    structure = model._inputs_struct if hasattr(model, "_inputs_struct") else list(model.inputs)

    def call(*tensors: Any) -> Any:
        return model(tf.nest.pack_sequence_as(structure, tensors), training=False)

    return call, specs, names


def keras_outputs(model: Any, count: int) -> list[str]:
    """What a Keras model calls its outputs, each its own name: several of one layer are called alike."""
    found: list[str] = []
    structure = getattr(model, "_outputs_struct", None)
    if isinstance(structure, dict) and not any(isinstance(v, list | tuple | dict) for v in structure.values()):
        return sorted(structure)  # results are flattened in the order of their keys
    for wish in getattr(model, "output_names", None) or [f"output_{i}" for i in range(count)]:
        name = wish
        while name in found:  # as converters/formats/keras/model.py calls them
            name = f"{wish}_{len(found)}"
        found.append(name)
    return found


def saved_function(function: Any, folder: str) -> FrozenFunction:
    """A ConcreteFunction written to ``folder`` as a SavedModel, and frozen from there as a child would.

    Its graph then has the names that the child's has. Raises what ``tf.saved_model.save`` raises.
    """
    import tensorflow as tf  # noqa: TID251  the function proves that it is loaded

    module = tf.Module()
    module.variables_of_the_function = list(function.graph.variables)
    log = tf.get_logger()
    level = log.level
    log.setLevel("ERROR")  # it says where it writes
    try:
        tf.saved_model.save(module, folder, signatures=function)
    finally:
        log.setLevel(level)
    return frozen_function(folder, "saved_model", "serving_default")


def named_function(call: Callable[..., Any], specs: Sequence[Any], keys: Callable[[int], Sequence[str]]) -> Any:
    """The ConcreteFunction of ``call`` whose results are a dictionary; ``keys`` gives their names by their number."""
    import tensorflow as tf  # noqa: TID251  the model proves that it is loaded

    def call_by_name(*tensors: Any) -> dict[str, Any]:
        results = tf.nest.flatten(call(*tensors))
        return dict(zip(keys(len(results)), results, strict=True))

    return tf.function(call_by_name).get_concrete_function(*specs)
