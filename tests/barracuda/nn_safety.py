"""What every file that we write avoids, since a real Barracuda between 1.0 and 3.0 trips over it."""

from __future__ import annotations

from export_model.converters.formats.barracuda.format import NnModel
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType

#: Layers that Barracuda 1.0 has and no later version computes otherwise.
SAFE = {
    LayerType.DENSE, LayerType.CONV2D, LayerType.DEPTHWISE_CONV2D, LayerType.MAX_POOL2D, LayerType.AVG_POOL2D,
    LayerType.GLOBAL_MAX_POOL2D, LayerType.GLOBAL_AVG_POOL2D, LayerType.BORDER2D, LayerType.ACTIVATION,
    LayerType.RANDOM_NORMAL, LayerType.RANDOM_UNIFORM, LayerType.ADD, LayerType.SUB, LayerType.MUL, LayerType.DIV,
    LayerType.POW, LayerType.MIN, LayerType.MAX, LayerType.REDUCE_MAX, LayerType.REDUCE_MIN, LayerType.REDUCE_PROD,
    LayerType.GREATER, LayerType.GREATER_EQUAL, LayerType.LESS, LayerType.LESS_EQUAL, LayerType.EQUAL,
    LayerType.FLATTEN, LayerType.RESHAPE, LayerType.TRANSPOSE, LayerType.CONCAT, LayerType.STRIDED_SLICE,
    LayerType.LOAD,
}  # fmt: skip
#: Activations that Barracuda 1.0 has; an old worker copies what it does not know.
SAFE_ACTIVATIONS = {
    Activation.NONE, Activation.RELU, Activation.SOFTMAX, Activation.TANH, Activation.SIGMOID, Activation.ELU,
    Activation.RELU6, Activation.LEAKY_RELU, Activation.SELU, Activation.SWISH, Activation.LOG_SOFTMAX, Activation.ABS,
    Activation.NEG, Activation.CEIL, Activation.FLOOR, Activation.RECIPROCAL, Activation.SQRT, Activation.EXP,
    Activation.LOG,
}  # fmt: skip
_TWO = {*range(LayerType.ADD, LayerType.POW + 1), LayerType.MIN, LayerType.MAX, *range(140, 145)}


def assert_safe(model: NnModel) -> None:
    """Every layer is one that all versions run, and is fed as they run it."""
    assert model.version == 16
    known: dict[str, tuple[int, ...]] = {i.name: i.shape for i in model.inputs}
    known |= {m.input: (-1, *m.shape[1:]) for m in model.memories}
    for name, shape in known.items():
        assert len(shape) == 4, name
        assert shape[0] == -1, name
    names = [layer.name for layer in model.layers]
    assert len(set(names)) == len(names)
    safe = SAFE | ({LayerType.MULTINOMIAL} if model.number("version_number") == 3 else set())
    for layer in model.layers:
        assert layer.type in safe, layer
        assert layer.activation in SAFE_ACTIVATIONS, layer
        assert layer.activation == Activation.NONE or layer.type == LayerType.ACTIVATION, layer
        assert all(len(d.shape) == 4 for d in layer.datasets)
        if layer.type == LayerType.LOAD:
            # Barracuda 1.0 counts the weights of a Load of several constants twice and reads on behind them.
            (dataset,) = layer.datasets
            assert dataset.name == layer.name
            known[layer.name] = dataset.shape
            continue
        shapes = [known[name] for name in layer.inputs]
        known[layer.name] = _result(layer.type, layer, shapes)
    for name in model.outputs:
        assert known[name][0] == -1, name
    for memory in model.memories:
        assert known[memory.output] == (-1, *memory.shape[1:]), memory
    ends = sum(d.length for layer in model.layers for d in layer.datasets)
    assert model.weights.size == ends


def _result(kind: int, layer: object, shapes: list[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape of a layer's result; asserts what the versions ask of its inputs."""
    from export_model.converters.formats.barracuda.format import Layer

    assert isinstance(layer, Layer)
    x = shapes[0]
    if kind in _TWO:
        assert len(shapes) == 2, f"{layer.name}: several operands are folded wrongly up to 1.0"
        longest = tuple(a if b in (1, a) else b for a, b in zip(*shapes, strict=True))
        assert x == longest, f"{layer.name}: {shapes}: the first operand has the lengths of the result"
        column = x[1] == x[2] == 1 < x[3] and shapes[1] == (-1, 1, 1, 1)
        assert not column, f"{layer.name}: {shapes}: before 1.0 a column is repeated along the batch"
        return x
    if kind == LayerType.DENSE:
        kernel, bias = layer.datasets
        assert kernel.shape[0] == x[1] * x[2] * x[3], layer
        assert kernel.shape[1:3] == (1, 1)
        assert bias.shape == (1, 1, 1, kernel.shape[3])
        assert x[1] == x[2] == 1, f"{layer.name}: an image is flattened by a layer of its own"
        return x[0], 1, 1, kernel.shape[3]
    if kind in (LayerType.ACTIVATION, LayerType.RANDOM_NORMAL, LayerType.RANDOM_UNIFORM):
        if layer.activation in (Activation.SOFTMAX, Activation.LOG_SOFTMAX):
            assert x[1] == x[2] == 1, layer
        return x
    if kind == LayerType.MULTINOMIAL:
        assert x[1] == x[2] == 1, layer
        return x[0], 1, 1, *layer.pool
    if kind in (LayerType.REDUCE_MAX, LayerType.REDUCE_MIN, LayerType.REDUCE_PROD):
        assert x[3] > 1, f"{layer.name}: 1.1 leaves the model at a reduction over one number"
        assert layer.axis == -1
        return (*x[:3], 1)
    if kind == LayerType.CONCAT:
        assert layer.axis in (1, 2, 3), layer
        rest = [tuple(d for i, d in enumerate(s) if i != layer.axis) for s in shapes]
        assert set(rest) == {rest[0]}, f"{layer.name}: {shapes}"
        total = sum(s[layer.axis] for s in shapes)
        return tuple(total if i == layer.axis else d for i, d in enumerate(x))
    if kind == LayerType.STRIDED_SLICE:
        lengths = []
        for axis, (start, end, step, length) in enumerate(zip(layer.pad, layer.pool, layer.stride, x, strict=True)):
            assert step == 1, layer
            if (start, end) == (0, 0):
                lengths.append(length)
                continue
            assert axis > 0, layer
            assert 0 <= start < end <= length, f"{layer.name}: {start}:{end} of {length} (up to 2.0 an assertion)"
            lengths.append(end - start)
        return tuple(lengths)
    if kind == LayerType.FLATTEN:
        return x[0], 1, 1, x[1] * x[2] * x[3]
    if kind == LayerType.RESHAPE:
        assert layer.pool[0] == -1
        assert x[1] * x[2] * x[3] == layer.pool[1] * layer.pool[2] * layer.pool[3]
        return layer.pool
    if kind == LayerType.TRANSPOSE:
        assert layer.pool[0] == 0
        return tuple(x[i] for i in layer.pool)
    if kind in (LayerType.GLOBAL_AVG_POOL2D, LayerType.GLOBAL_MAX_POOL2D):
        return x[0], 1, 1, x[3]
    if kind == LayerType.BORDER2D:
        left, top, right, bottom = layer.pad
        return x[0], x[1] + top + bottom, x[2] + left + right, x[3]
    return _window(layer, x)


def _window(layer: object, x: tuple[int, ...]) -> tuple[int, ...]:
    from export_model.converters.formats.barracuda.format import Layer

    assert isinstance(layer, Layer)
    across, down = layer.stride
    if layer.datasets:
        height, width, _, channels = layer.datasets[0].shape
        assert layer.datasets[1].shape == (1, 1, 1, channels)
    else:
        (width, height), channels = layer.pool, x[3]
    if layer.pad == (-1,):
        return x[0], -(-x[1] // down), -(-x[2] // across), channels
    assert layer.pad == (0, 0, 0, 0)
    return x[0], (x[1] - height) // down + 1, (x[2] - width) // across + 1, channels
