"""Which function translates which layer, and how many tensors it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from export_model.converters.formats.barracuda import activations, arithmetic, convolution, dense, shaping
from export_model.converters.formats.barracuda.format import Layer
from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType, layer_label
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError

#: Takes (builder, the layer's inputs and then its datasets).
Translate = Callable[[LayerBuilder, Sequence[NnValue]], NnValue]
_ANY = 1 << 16


def _same(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    return args[0]


def _activation(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    if b.layer.activation == Activation.PRELU:
        if len(args) != 2:
            raise b.damaged_error(f"it has {len(args)} inputs", "a PRelu takes a tensor and its slopes")
        return activations.prelu(b, args[0], args[1])
    if len(args) != 1:
        raise b.damaged_error(f"it has {len(args)} inputs", "an activation takes one")
    return activations.activate(b, b.layer.activation, args[0], axis=b.layer.axis)


#: Type → (fewest tensors, most, translation). A reduction may have a second input that is ignored.
_LAYERS: Mapping[int, tuple[int, int, Translate]] = {
    LayerType.NOP: (1, 1, _same),
    LayerType.DROPOUT: (1, 1, _same),
    LayerType.DENSE: (3, 3, dense.dense),
    LayerType.MATMUL: (2, 2, dense.matmul),
    LayerType.DENSE3: (3, 3, dense.dense3),
    LayerType.SCALE_BIAS: (3, 3, dense.scale_bias),
    **dict.fromkeys((LayerType.RANDOM_NORMAL, LayerType.RANDOM_UNIFORM), (0, 1, dense.random)),
    LayerType.MULTINOMIAL: (1, 1, dense.multinomial),
    LayerType.ONE_HOT: (1, 1, dense.one_hot),
    LayerType.CONV2D: (3, 3, convolution.conv2d),
    LayerType.DEPTHWISE_CONV2D: (3, 3, convolution.depthwise),
    LayerType.CONV2D_TRANS: (3, 3, convolution.conv2d_trans),
    LayerType.UPSAMPLE2D: (1, 2, convolution.upsample),
    LayerType.NORMALIZATION: (3, 3, convolution.normalization),
    LayerType.ACTIVATION: (1, 2, _activation),
    LayerType.WHERE: (3, 3, arithmetic.where),
    LayerType.SIGN: (1, 1, arithmetic.sign),
    LayerType.LOGICAL_NOT: (1, 1, arithmetic.logical),
    LayerType.FLATTEN: (1, 1, shaping.flatten),
    LayerType.RESHAPE: (1, 2, shaping.reshape),
    LayerType.TRANSPOSE: (1, 1, shaping.transpose),
    LayerType.SQUEEZE: (1, 1, shaping.squeeze),
    LayerType.UNSQUEEZE: (1, 1, shaping.squeeze),
    LayerType.GATHER: (2, 2, shaping.gather),
    LayerType.CONCAT: (1, _ANY, shaping.concat),
    LayerType.STRIDED_SLICE: (1, 1, shaping.strided_slice),
    LayerType.TILE: (1, 1, shaping.tile),
    LayerType.EXPAND: (1, 1, shaping.expand),
    LayerType.DEPTH_TO_SPACE: (1, 1, shaping.depth_to_space),
    LayerType.SPACE_TO_DEPTH: (1, 1, shaping.space_to_depth),
    **dict.fromkeys((LayerType.MAX_POOL2D, LayerType.AVG_POOL2D), (1, 1, convolution.pool)),
    **dict.fromkeys((LayerType.GLOBAL_MAX_POOL2D, LayerType.GLOBAL_AVG_POOL2D), (1, 1, convolution.global_pool)),
    **dict.fromkeys(
        (LayerType.BORDER2D, LayerType.PAD2D_REFLECT, LayerType.PAD2D_SYMMETRIC, LayerType.PAD2D_EDGE),
        (1, 1, convolution.border),
    ),
    **dict.fromkeys(range(LayerType.ADD, LayerType.POW + 1), (1, _ANY, arithmetic.fold_inputs)),
    **dict.fromkeys(range(LayerType.MIN, LayerType.MEAN + 1), (1, _ANY, arithmetic.fold_inputs)),
    **dict.fromkeys(range(LayerType.GREATER, LayerType.EQUAL + 1), (2, 2, arithmetic.compare_operands)),
    **dict.fromkeys((LayerType.LOGICAL_OR, LayerType.LOGICAL_AND, LayerType.LOGICAL_XOR), (2, 2, arithmetic.logical)),
    **dict.fromkeys(range(LayerType.REDUCE_L1, LayerType.REDUCE_SUM_SQUARE + 1), (1, 2, arithmetic.reduce_axis)),
    **dict.fromkeys((LayerType.ARG_MAX, LayerType.ARG_MIN), (1, 2, arithmetic.reduce_axis)),
}

_WHY: Mapping[LayerType, str] = {
    LayerType.LRN: "local response normalisation is not in the op table, and no model of ML-Agents has it",
    LayerType.LSTM: "it takes and gives its state beside the graph; the converters of ML-Agents never wrote it",
    LayerType.RESAMPLE2D: "which pixel is nearest is rounded differently by Unity's backends",
}


def translate(b: LayerBuilder, layer: Layer, args: Sequence[NnValue]) -> NnValue:
    """What a layer computes, activation included; ``args`` are its inputs and then its datasets.

    Raises UnsupportedOpError that names the layer, GraphError where it contradicts itself.
    """
    entry = _LAYERS.get(layer.type)
    if entry is None:
        why = "no translation of it is known"
        if layer.type in LayerType._value2member_map_:
            why = _WHY.get(LayerType(layer.type), "no model of ML-Agents has it, and no translation of it is known")
        raise b.unsupported_error("it cannot be converted", why)
    fewest, most, function = entry
    if not fewest <= len(args) <= most:
        wanted = fewest if fewest == most else f"{fewest} to {most}" if most < _ANY else f"{fewest} or more"
        raise b.damaged_error(f"it has {len(args)} inputs and datasets", f"it takes {wanted}")
    try:
        result = function(b, args)
    except UnsupportedOpError as error:
        if error.issues:
            raise
        raise b.unsupported_error(error.what, error.why or "a policy's tensors have another form") from error
    b.check_size(*result.shape[1:])
    if layer.type != LayerType.ACTIVATION and layer.activation != Activation.NONE:
        result = activations.activate(b, layer.activation, result, fused=True)
    return result


def check_bypassed(layer: Layer) -> None:
    """Raise DamagedFileError where ML-Agents' converter left out an op that it did not know.

    It let the op's inputs through to whatever read its result. All layers that it writes take a fixed number of inputs
    (datasets apart), arithmetic two, but for Concat; so one input too many tells. Only for files that it wrote.
    """
    if layer.type not in _LAYERS or layer.type == LayerType.CONCAT:
        return
    fewest, most, _ = _LAYERS[layer.type]
    allowed = {2} if most == _ANY else set(range(fewest, most + 1))
    allowed = {n - len(layer.datasets) for n in allowed}
    if layer.type == LayerType.ACTIVATION and layer.activation != Activation.PRELU:
        allowed = {1}
    if len(layer.inputs) in allowed or (len(layer.inputs) < min(allowed) and most != _ANY):
        return
    names = ", ".join(layer.inputs) or "none"
    raise DamagedFileError(
        f"layer {layer.name!r} ({layer_label(layer.type)}) reads {len(layer.inputs)} tensors: {names}",
        why="ML-Agents' converter did not know an op before it (AddV2, in 0.10 under TensorFlow 1.15 or later) and let "
        "its inputs through, so this .nn computes something else than was trained, in Unity too",
        fix="export the frozen_graph_def.pb from the same run; to get a good .nn, train with ML-Agents 0.11 or later",
    )
