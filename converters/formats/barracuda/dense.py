"""Matrix products, scales, and the layers that draw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue, Shape
from export_model.converters.graph.nn import linear
from export_model.converters.graph.nn.activations import scale_and_shift
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.types import FLOAT32, INT32, INT64


def dense(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """X flattened to [N, H·W·C], times K [in, 1, 1, out], plus a bias [1, 1, 1, out]."""
    x, kernel, bias = args
    rows, columns = kernel.n, kernel.size
    if rows is None or x.size != rows or bias.size != columns:
        raise b.damaged_error(
            f"a row of {x.size} numbers, a kernel of shape {list(kernel.shape)}, a bias of {bias.size}",
            "the kernel's rows must be the input's numbers, its columns the bias's",
        )
    product = b.add("MatMul", [b.as_matrix(x), b.as_matrix(kernel)])
    return b.rows(add_bias(b, product, bias), x.n, columns)


def add_bias(b: LayerBuilder, product: str, bias: NnValue) -> str:
    """``product`` plus a bias along its last axis; the zeros that ML-Agents' converter makes up are left out."""
    if _all(bias, 0):
        return product
    return b.add("BiasAdd", [product, b.as_vector(bias)])


def _all(value: NnValue, number: float) -> bool:
    """Whether a tensor is known to hold nothing but ``number``."""
    with np.errstate(invalid="ignore"):
        return value.constant is not None and bool(np.all(value.constant == number))


def matmul(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """X·Y of two tensors. ``pool`` are their ranks in ONNX; empty in the old versions, which know rank 2 alone.

    A tensor of rank 2 is [N, C], of rank 3 (ONNX: N, C, W) is [N, 1, W, C], of rank 4 (ONNX: NCHW) is NHWC.
    """
    x, y = args
    ranks = tuple(b.layer.pool) or (2, 2)
    if len(ranks) != 2 or any(r not in (2, 3, 4) for r in ranks) or (ranks[1] != 2 and ranks[0] != ranks[1]):
        raise b.unsupported_error(
            f"the ranks {list(ranks)}", "products that broadcast over further axes are not translated"
        )
    if ranks[1] == 2 and y.n is None:
        raise b.unsupported_error("its second input has a row per agent", "the batch cannot be summed over")
    return _times(b, x, y, ranks[0], ranks[1])


def dense3(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The product of a rank-3 X [N, 1, W, C] with K [W, 1, 1, M], over W, plus a bias of M: [N, 1, M, C]."""
    x, kernel, bias = args
    if kernel.n is None or bias.constant is None:
        raise b.unsupported_error("its kernel or bias is computed", "they are constants in every model known")
    if bias.size != kernel.size:
        raise b.damaged_error(f"a kernel of {kernel.size} columns, a bias of {bias.size}", "they must be equal")
    product = _times(b, x, kernel, 3, 2)
    column = b.floats(bias.constant.reshape(1, 1, -1, 1), "bias")
    return b.as_shape(b.add("Add", [b.as_image(product), column]), product.shape)


def _times(b: LayerBuilder, x: NnValue, y: NnValue, left: int, right: int) -> NnValue:
    """The product of tensors that have these ranks in ONNX: [N, C], [N, C, W] or [N, C, H, W]."""
    inner = x.size if left == 2 else x.w
    rows, columns = {2: (y.n, y.size), 3: (y.c, y.w), 4: (y.h, y.w)}[right]
    if inner != rows:
        raise b.damaged_error(f"{list(x.shape)} times {list(y.shape)}", f"{inner} numbers meet {rows}")
    product = linear.matmul(b, _onnx_order(b, x, left), _onnx_order(b, y, right))
    if left == 2:
        return b.rows(product, x.n, columns)
    n = x.n if right == 2 or y.n == 1 else y.n
    image = product if left == 4 else b.expand_dims(product, 2)
    turned = b.transpose(image, (0, 2, 3, 1))
    return b.as_shape(turned, (n, x.h, columns, x.c))


def _onnx_order(b: LayerBuilder, x: NnValue, rank: int) -> str:
    """A tensor [N, H, W, C] as ONNX has it."""
    if rank == 2:
        return b.as_matrix(x)
    if rank == 3 and x.h != 1:
        raise b.damaged_error(f"{list(x.shape)} as a tensor of rank 3", "its height is not 1")
    turned = b.transpose(b.as_image(x), (0, 3, 1, 2))
    return turned if rank == 4 else b.squeeze(turned, [2])


def scale_bias(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """x·S + B along the channels; S of ones is what ML-Agents' converter makes of a bias alone."""
    x, scale, bias = args
    if scale.size != x.c or bias.size != x.c:
        raise b.damaged_error(f"{x.c} channels, {scale.size} scales, {bias.size} biases", "they must be equal")
    result = x.reference
    if not _all(scale, 1):
        result = b.add("Mul", [result, b.as_vector(scale)])
    if x.rank == 1:
        return NnValue(b.add("Add", [result, b.as_vector(bias)]), x.shape)
    return NnValue(add_bias(b, result, bias), x.shape)


# ------------------------------------------------------------------ chance


def random(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """alpha·N(0, 1) + beta, or alpha·U(0, 1) + beta, of the shape of the input, or of ``pool``."""
    if b.layer.pool:
        shape: Shape = b.four(b.layer.pool)
        n, h, w, c = shape
        if n in (None, 0, -1) or min(h, w, c) < 1:
            raise b.damaged_error(f"it draws a tensor of shape {list(b.layer.pool)}", "the shape must be plain numbers")
        b.check_size(n or 1, h, w, c)
        lengths = [c] if shape[:3] == (1, 1, 1) else [n, c] if (h, w) == (1, 1) else [n, h, w, c]
        if n == 1 and (h, w) == (1, 1):
            b.note(f"the noise of {b.layer.name} is one row for all agents, as in the .nn")
        size = b.ints([int(v or 0) for v in lengths], "size")
    elif args:
        shape = args[0].shape
        size = b.add("Shape", [args[0].reference], out_type=INT32)
    else:
        raise b.damaged_error("it has neither a shape nor an input", "the shape of what it draws is not known")
    if b.layer.type == LayerType.RANDOM_NORMAL:
        drawn = b.add("RandomStandardNormal", [size], origin=b.layer.name, dtype=FLOAT32)
    else:
        drawn = b.add("RandomUniform", [size], dtype=FLOAT32)
    return NnValue(scale_and_shift(b, drawn, b.layer.alpha, b.layer.beta), shape)


def multinomial(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """``pool[0]`` classes per row, drawn from the row's log-probabilities; a ``.nn`` holds them as floats."""
    (x,) = args
    if len(b.layer.pool) != 1 or b.layer.pool[0] < 1:
        raise b.damaged_error(f"it draws {list(b.layer.pool)} times", "the number of draws is one number above 0")
    count = b.layer.pool[0]
    drawn = b.add("Multinomial", [b.as_matrix(x), b.ints(count, "count")], output_dtype=INT64)
    return b.rows(b.add("Cast", [drawn], DstT=FLOAT32), x.n, count, drawn)


def one_hot(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """A row of ``pool[0]`` numbers per index: alpha at the index, beta elsewhere.

    Up to version 16 [N, 1, 1, n] becomes [N, 1, n, depth]; later, ``axis`` is the rank of the indices in ONNX, and the
    depth comes before the channels from rank 2 on.
    """
    (x,) = args
    if len(b.layer.pool) != 1 or b.layer.pool[0] < 1:
        raise b.damaged_error(f"its depth is {list(b.layer.pool)}", "it must be one number above 0")
    depth, count, n = b.layer.pool[0], x.size, x.n
    b.check_size(count, depth)
    index = x.integer
    if index is None:
        index = b.add("Cast", [b.as_matrix(x)], DstT=INT32)
    hot = b.add(
        "OneHot",
        [index, b.ints(depth, "depth"), b.floats(b.layer.alpha, "on"), b.floats(b.layer.beta, "off")],
        axis=-1,
    )
    if count == 1 and (b.version <= 16 or b.layer.axis < 2):
        return b.as_shape(hot, (n, 1, 1, depth))
    if b.version <= 16:
        return b.as_shape(hot, (n, 1, count, depth))
    if b.layer.axis == 2 and x.rank != 4:
        turned = b.add("Transpose", [hot, b.ints([0, 2, 1], "before")])
        return b.as_shape(turned, (n, 1, depth, count))
    raise b.unsupported_error(
        f"indices of shape {list(x.shape)}, rank {b.layer.axis}",
        "versions of Barracuda put the new axis in different places; only ranks 1 and 2 are certain",
    )
