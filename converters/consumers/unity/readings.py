"""What Unity's importers make of a construct: read rightly, read wrongly, refused, or failing when it runs.

Each rule was measured with Unity's own code outside the Editor, on the CPU: 352 small models, one construct each, in
five versions of Barracuda, in Sentis 2.1.3 and in the Inference Engine 2.2.2 and 2.4.0. ``evidence`` names one that a
rule comes from; tests/targets holds every rule against all of them. Barracuda does not look at the opset: it reads the
forms of later ones too, and some of them wrongly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum

import numpy as np
from msgspec import Struct

from export_model.converters.consumers.unity.constructs import (
    INPUT,
    MOST_AXES,
    OUTPUT,
    Construct,
    ConstructModel,
    Operand,
    OperandSource,
)
from export_model.converters.consumers.unity.importers import (
    BARRACUDA,
    BEFORE_2_3,
    BEFORE_2_4,
    EVERY,
    FIRST,
    FROM_1_4_TO_2_0,
    FROM_1_4_TO_2_3,
    FROM_2_3,
    FROM_2_4,
    LATER,
    SENTIS,
)


class Reading(StrEnum):
    """What comes of a construct."""

    WRONG = "wrong"  # imports, runs, gives other numbers or another shape; no error
    REFUSED = "refused"  # the import ends with an exception
    FAILS = "fails"  # throws when it runs, at batch 1 or above
    LOST = "lost"  # an output of it cannot be fetched


class Form(Struct, frozen=True):
    """A form of some operators and what it comes to in some importers."""

    ops: tuple[str, ...]
    reading: Reading
    importers: tuple[str, ...]
    says: str
    evidence: str
    when: Callable[[Construct], bool] = lambda construct: True


class Misreading(Struct, frozen=True):
    """A construct of a model that an importer does not read rightly."""

    importer: str
    construct: Construct
    rule: Form


def misreadings(model: ConstructModel, importers: Sequence[str] = EVERY) -> Iterator[Misreading]:
    """All that ``importers`` do not read rightly, in the order of the model's nodes."""
    for construct in model:
        for rule in _BY_OP.get(construct.op, ()):
            concerned = [i for i in importers if i in rule.importers]
            if concerned and rule.when(construct):
                yield from (Misreading(importer, construct, rule) for importer in concerned)


def misread_ops(importers: Sequence[str]) -> frozenset[str]:
    """Return the operators that any of ``importers`` lacks or misreads in some form."""
    return frozenset(op for rule in RULES if set(rule.importers).intersection(importers) for op in rule.ops)


# ------------------------------------------------------------------ forms


def _is_computed(index: int) -> Callable[[Construct], bool]:
    """There is an operand at ``index``, and it is no constant."""
    return lambda c: c.operand(index).source in (OperandSource.COMPUTED, OperandSource.INPUT, OperandSource.COPIED)


def _is_given(index: int) -> Callable[[Construct], bool]:
    return lambda c: c.operand(index).source is not OperandSource.ABSENT


def _missing(index: int) -> Callable[[Construct], bool]:
    return lambda c: c.operand(index).source is OperandSource.ABSENT


def _all(*conditions: Callable[[Construct], bool]) -> Callable[[Construct], bool]:
    return lambda c: all(condition(c) for condition in conditions)


def _rank(operand: Operand) -> int:
    return operand.rank if operand.rank is not None else 0


def _axes(c: Construct) -> list[int]:
    """The axes of a reduction or slice, counted from the front."""
    given = c.attribute("axes")
    if given is None and c.op == "Slice":
        value = c.operand(3).value
        starts = c.operand(1).value
        given = range(0 if starts is None else starts.size) if value is None else value.reshape(-1).tolist()
    return [int(a) % max(_rank(c.operand(0)), 1) for a in given or ()]


def _without_axes(c: Construct) -> bool:
    return c.attribute("axes") is None and c.operand(1).source is OperandSource.ABSENT


def _deep_last_axis(c: Construct) -> bool:
    """Reduced or cut along the last of more than two axes, or along several."""
    rank = _rank(c.operand(0))
    return rank > 2 and rank - 1 in _axes(c) and not _over_image(c)


def _over_image(c: Construct) -> bool:
    return c.op.startswith("Reduce") and c.operand(0).source is OperandSource.INPUT and _axes(c) == [1, 2]


def _bias_is_row(c: Construct) -> bool:
    shape = c.operand(2).shape
    return c.operand(2).source is OperandSource.CONSTANT and shape is not None and len(shape) > 1


def _bias_of_one(c: Construct) -> bool:
    shape, weights = c.operand(2).shape, c.operand(1).shape
    if shape != (1,) or weights is None or len(weights) != 2:
        return False
    return weights[0 if c.attribute("transB", 0) else 1] != 1


def _is_scaled(c: Construct) -> bool:
    return float(c.attribute("alpha", 1.0)) != 1.0 or float(c.attribute("beta", 1.0)) != 1.0


_WHOLE = {"Floor", "Ceil", "Round", "Sign", "ArgMax", "ArgMin", "Shape", "Size", "Multinomial", "NonZero", "OneHot"}
_WHOLE_OF_WHOLE = {"Mul", "Add", "Sub", "Neg", "Abs", "Min", "Max", "Reshape", "Slice", "Gather", "Concat", "Squeeze"}


def _fraction(operand: Operand, c: Construct, depth: int = 8) -> bool:
    """Whether a float operand may hold anything but whole numbers, by what makes it."""
    if operand.value is not None:
        return bool(np.any(operand.value != np.trunc(operand.value)))
    if operand.dtype is not None and operand.dtype.kind != "f":
        return False
    maker = c.model.makers.get(operand.name)
    if maker is None or depth == 0:
        return True
    if maker.op == "Cast":
        return _fraction(maker.operand(0), c, depth - 1)
    if maker.op in _WHOLE:
        return False
    if maker.op in (*_WHOLE_OF_WHOLE, "Unsqueeze", "Transpose", "Identity", "Flatten"):
        floats = [o for o in maker.operands if o.dtype is None or o.dtype.kind == "f"]
        return any(_fraction(o, c, depth - 1) for o in floats)
    return True


def _cast_to(*kinds: str) -> Callable[[Construct], bool]:
    names = {"i": {2, 3, 4, 5, 6, 7, 12, 13}, "b": {9}}
    wanted = {number for kind in kinds for number in names[kind]}
    return lambda c: c.attribute("to") in wanted and _is_float(c.operand(0))


def _is_float(operand: Operand) -> bool:
    return operand.dtype is None or operand.dtype.kind == "f"


def _not_zero_or_one(c: Construct) -> bool:
    """A float cast to bool that is no mask: a mask is an input of that name."""
    return _cast_to("b")(c) and "mask" not in c.operand(0).name


ELEMENTWISE = {"Relu", "LeakyRelu", "Elu", "Sigmoid", "Tanh", "Mul", "Add", "Clip", "Max", "Min", "Identity", "Selu"}


def _flattened_conv(c: Construct) -> bool:
    """Flatten of a convolution, read by a product; elementwise operators between them change nothing."""
    maker = c.maker()
    for _ in range(16):
        if maker is None or maker.op not in ELEMENTWISE:
            break
        maker = maker.maker()
    return maker is not None and maker.op == "Conv" and any(r.op in ("Gemm", "MatMul") for r in c.readers())


def _flat_in_first(c: Construct) -> bool:
    """A flattened tensor of rank 3 or 4 that is not read by a product at once (1.1.2 has turned its axes)."""
    rank = _rank(c.operand(0))
    maker = c.maker()
    if rank not in (3, 4) or (maker is not None and maker.op in ("Transpose", "OneHot")):
        return False
    return _flat(c) and any(r.op == OUTPUT for r in c.readers())


def _flat(c: Construct) -> bool:
    if c.op == "Flatten":
        return True
    target = c.operand(1).value
    return target is not None and target.size < _rank(c.operand(0))


def _joined_after_flattening(c: Construct) -> bool:
    """Concat of a flattened image in 1.1.2."""
    makers = [c.maker(i) for i in range(len(c.operands))]
    return any(
        m is not None and m.op in ("Reshape", "Flatten") and _flat(m) and _rank(m.operand(0)) == 4 for m in makers
    )


def _of_image_input(c: Construct) -> bool:
    return c.attribute("perm") == [0, 3, 1, 2] and c.operand(0).source is OperandSource.INPUT


def _groups(c: Construct) -> bool:
    group, weights = int(c.attribute("group", 1)), c.operand(1).shape
    channels = group * (weights[1] or 0) if weights is not None and len(weights) > 1 else 0
    return 1 < group < channels


def _row_first(c: Construct) -> bool:
    """Arithmetic with a constant row [1, n] of the same width as the other operand."""
    for row, other in ((c.operand(0), c.operand(1)), (c.operand(1), c.operand(0))):
        if row.source is not OperandSource.CONSTANT or row.shape is None or other.shape is None:
            continue
        if len(row.shape) == len(other.shape) == 2 and row.shape[0] == 1 != row.shape[1] == other.shape[1]:
            return True
    return False


def _grows(c: Construct) -> bool:
    shapes = [o.shape for o in c.operands if o.source is not OperandSource.CONSTANT]
    ranks = {len(s) for s in shapes if s is not None}
    return len(shapes) == 2 and None not in shapes and len(ranks) == 2 and min(ranks) > 1


def _last_of_three(c: Construct) -> bool:
    """A constant vector added to the last axis of a tensor of rank 3."""
    other = next(
        (o for o in c.operands if o.source is OperandSource.CONSTANT and _rank(o) == 1 and o.shape != (1,)), None
    )
    return other is not None and any(_rank(o) == 3 for o in c.operands)


def _uneven(*names: str) -> Callable[[Construct], bool]:
    """Any of these lists has numbers that differ."""
    return lambda c: any(len({*(c.attribute(name) or ())}) > 1 for name in names)


def _constant_first(c: Construct) -> bool:
    return c.operand(0).source is OperandSource.CONSTANT and c.operand(1).source is not OperandSource.CONSTANT


def _negative(index: int) -> Callable[[Construct], bool]:
    def negative(c: Construct) -> bool:
        value = c.operand(index).value
        return value is not None and bool(np.any(value < 0))

    return negative


def _endless(c: Construct) -> bool:
    value = c.operand(2).value
    return value is not None and bool(np.any(value >= np.iinfo(np.int32).max))


def _old_softmax(c: Construct) -> bool:
    rank, axis = _rank(c.operand(0)), int(c.attribute("axis", 1))
    return c.opset < 13 and rank > 2 and axis % rank != rank - 1


def _dropped_batch(c: Construct) -> bool:
    """Two leading axes squeezed at once from a rank of 4."""
    given = c.operand(1).value
    axes = c.attribute("axes") or ([] if given is None else given.tolist())
    return _rank(c.operand(0)) == 4 and list(axes) == [0, 1]


def _reaches_output(c: Construct) -> bool:
    """A Shape that ends in an output."""
    stack, seen = list(c.readers()), set()
    while stack:
        reader = stack.pop()
        if reader.op == OUTPUT:
            return True
        if reader.op in ("Cast", "Gather", "Slice", "Concat", "Identity") and id(reader) not in seen:
            seen.add(id(reader))
            stack.extend(reader.readers())
    return False


def _identity_of_reshaped(c: Construct) -> bool:
    maker = c.maker()
    source = maker.operand(0).name if maker is not None and maker.op == "Identity" else ""
    made = c.model.makers.get(source)
    return source in c.model.outputs and made is not None and made.op == "Reshape"


def _many_dims(c: Construct) -> bool:
    return _rank(c.operand(0)) > 2 or _rank(c.operand(1)) > 2


def _slopes(c: Construct) -> bool:
    return _rank(c.operand(1)) > 1 and _rank(c.operand(0)) > 2


# ------------------------------------------------------------------ rules


def _rules() -> Iterator[Form]:
    wrong, refused, fails = Reading.WRONG, Reading.REFUSED, Reading.FAILS
    old = FROM_1_4_TO_2_3
    sums = ("ReduceSum", "ReduceMean")
    reductions = (*sums, "ReduceMax", "ReduceMin", "ReduceProd")
    yield Form(
        reductions, wrong, old, "axes as an operand are not read: it reduces the batch", "ReduceSum_10", _is_given(1)
    )
    yield Form(reductions, refused, FIRST, "axes as an operand are not read", "ReduceSum_10", _is_given(1))
    yield Form(reductions, wrong, LATER, "without axes it reduces the batch alone", "ReduceSum_05", _without_axes)
    yield Form(reductions, refused, FIRST, "without axes", "ReduceSum_05", _without_axes)
    yield Form(reductions, fails, FIRST, "over the last axis of rank 3 or 4", "ReduceSum_06", _deep_last_axis)
    yield Form(reductions, refused, FIRST, "over height and width of an NHWC input", "input_12", _over_image)

    never = (
        "ReduceL2 ReduceSumSquare ReduceLogSumExp GreaterOrEqual GatherElements LayerNormalization GRU Range Softsign "
        "ThresholdedRelu Mod HardSwish Gelu Einsum CumSum If Loop Scan"
    )
    yield Form(tuple(never.split()), refused, BARRACUDA, "Barracuda has no such operator", "Einsum_01")
    since_14 = "Split ArgMax ArgMin Where LessOrEqual Tile Shape ConstantOfShape Sign Softplus"
    yield Form(tuple(since_14.split()), refused, FIRST, "Barracuda has it from 1.4 on", "ArgMax_01")
    yield Form(("Erf", "HardSigmoid", "ScatterND"), refused, BEFORE_2_3, "Barracuda has it from 2.3.1 on", "Erf_01")
    yield Form(("GRU",), refused, SENTIS, "Sentis has no such operator", "GRU_01")
    yield Form(("If", "Loop", "Scan"), Reading.LOST, SENTIS, "Sentis leaves it out", "If_01")

    sizes = "the sizes are read from the attribute alone"
    yield Form(("Split",), refused, LATER, sizes, "Split_04", lambda c: c.attribute("split") is None)
    axes = "axes as an operand are read from 2.3.1 on"
    yield Form(("Squeeze", "Unsqueeze"), refused, BEFORE_2_3, axes, "Squeeze_04", _is_given(1))
    yield Form(("Squeeze",), wrong, LATER, "two leading axes at once, batch above 1", "LSTM_01", _dropped_batch)
    yield Form(("Reshape",), fails, LATER, "a computed shape, batch above 1", "Reshape_08", _is_computed(1))
    flat = "the elements come in another order"
    yield Form(("Reshape", "Flatten"), wrong, FIRST, flat, "Reshape_01", _flat_in_first)
    yield Form(("Concat",), refused, FIRST, "a flattened image cannot be joined", "Conv_21", _joined_after_flattening)
    yield Form(("Flatten",), wrong, FROM_1_4_TO_2_0, f"of a convolution: {flat}", "Conv_18", _flattened_conv)

    yield Form(("Gemm",), wrong, BARRACUDA, "alpha and beta are not read", "Gemm_04", _is_scaled)
    yield Form(
        ("Gemm",), refused, FROM_2_3, "without C", "Gemm_06", _all(_missing(2), lambda c: c.operand(1).is_constant)
    )
    yield Form(("Gemm",), fails, BARRACUDA, "C of one element is not spread", "Gemm_07", _bias_of_one)
    yield Form(("Gemm",), wrong, BARRACUDA, "C of shape [1, n] is dropped", "Gemm_08", _bias_is_row)
    yield Form(("Gemm",), wrong, BARRACUDA, "a computed C is dropped", "Gemm_12", _is_computed(2))
    yield Form(("Gemm",), refused, FROM_1_4_TO_2_0, "B is computed", "Gemm_10", _is_computed(1))
    matrix = _all(_is_computed(1), lambda c: c.operand(1).source is not OperandSource.COPIED)
    yield Form(("Gemm",), refused, FIRST, "B is computed", "Gemm_10", matrix)
    dropped = _all(_is_computed(1), _is_given(2))
    yield Form(("Gemm",), wrong, FROM_2_3, "C is dropped where B is computed", "Gemm_10", dropped)
    constant = _all(_many_dims, lambda c: c.operand(1).is_constant)
    yield Form(("MatMul",), refused, FIRST, "of rank 3 by a constant", "MatMul_05", constant)
    computed = _all(_many_dims, lambda c: not c.operand(1).is_constant)
    yield Form(("MatMul",), fails, FIRST, "of rank 3 and above", "MatMul_06", computed)

    last = _all(lambda c: bool(c.attribute("select_last_index", 0)))
    yield Form(("ArgMax", "ArgMin"), wrong, LATER, "select_last_index is not read", "ArgMax_06", last)
    truncated = _all(_cast_to("i"), lambda c: _fraction(c.operand(0), c))
    yield Form(("Cast",), wrong, BARRACUDA, "to an integer: fractions are kept", "Cast_01", truncated)
    yield Form(("Cast",), wrong, EVERY, "to bool: the value is kept", "Cast_03", _not_zero_or_one)
    bounds = _all(lambda c: _is_computed(1)(c) or _is_computed(2)(c))
    yield Form(("Clip",), wrong, LATER, "a computed bound is not read", "Clip_07", bounds)
    yield Form(("Clip",), refused, FIRST, "a computed bound is not read", "Clip_07", bounds)

    yield Form(("Slice",), wrong, BARRACUDA, "it does not go backwards", "Slice_13", _negative(4))
    yield Form(("Slice",), wrong, FIRST, "an end beyond every index is misread", "Slice_10", _endless)
    two = _all(lambda c: _rank(c.operand(0)) == 3 and len(_axes(c)) > 1)
    yield Form(("Slice",), wrong, FIRST, "two axes of rank 3", "Slice_15", two)
    deep = _all(_deep_last_axis, lambda c: _rank(c.operand(0)) == 3 and len(_axes(c)) == 1)
    yield Form(("Slice",), fails, FIRST, "the last axis of rank 3", "Slice_16", deep)
    yield Form(("Gather",), fails, BARRACUDA, "a negative index", "Gather_04", _negative(1))
    table = _all(lambda c: c.operand(0).source is OperandSource.CONSTANT)
    yield Form(("Gather",), refused, FIRST, "rows of a constant table", "Gather_05", table)
    unnamed = _all(lambda c: c.attribute("perm") is None and _rank(c.operand(0)) == 2 and c.operand(0).value is None)
    wide = "of more than four axes (seen in 3.0.0; no other was tried)"
    yield Form(("Reshape", "Transpose"), refused, BARRACUDA, wide, "r4, entity_attention", lambda c: c.axes > MOST_AXES)
    yield Form(("Transpose",), wrong, LATER, "of rank 2 without perm, batch above 1", "Transpose_02", unnamed)
    swapped = _all(lambda c: c.attribute("perm") == [1, 0, 2])
    yield Form(("Transpose",), wrong, FIRST, "of rank 3, batch above 1", "Transpose_04", swapped)
    shown = _all(_of_image_input, lambda c: c.given_out)
    yield Form(("Transpose",), wrong, FIRST, "of an NHWC input", "Transpose_06", shown)
    hidden = _all(_of_image_input, lambda c: not c.given_out)
    yield Form(("Transpose",), fails, FIRST, "of an NHWC input", "Conv_15", hidden)
    unknown = "Barracuda 1.4 and later"
    says = f"to a constant shape, batch above 1; {unknown} do"
    yield Form(("Expand",), fails, FIRST, says, "Expand_01", lambda c: c.operand(1).is_constant)
    yield Form(("Shape",), wrong, LATER, "as an output: the batch is that of the import", "Shape_01", _reaches_output)
    yield Form(("TopK",), fails, FIRST, f"{unknown} run it", "TopK_01")
    yield Form(("ScatterND",), wrong, FROM_2_3, "other values", "ScatterND_01")

    yield Form(("Conv",), fails, BARRACUDA, "groups of several channels", "Conv_11", _groups)
    yield Form(("Conv",), refused, BARRACUDA, "computed weights", "Conv_14", _is_computed(1))
    uneven_by = "lengths that differ by axis: heights are taken for widths"
    played = "cases/rank2_barracuda-3"
    yield Form(("Conv",), fails, BARRACUDA, f"strides of {uneven_by}", played, _uneven("strides"))
    uneven = _uneven("strides", "kernel_shape")
    yield Form(("MaxPool", "AveragePool"), fails, BARRACUDA, f"{uneven_by} (read, a Conv was run)", played, uneven)
    ceiling = _all(lambda c: bool(c.attribute("ceil_mode", 0)))
    yield Form(("MaxPool", "AveragePool"), wrong, EVERY, "ceil_mode is not read", "MaxPool_04", ceiling)
    padded = _all(lambda c: bool(c.attribute("count_include_pad", 0)))
    yield Form(("AveragePool",), wrong, EVERY, "count_include_pad is not read", "AveragePool_03", padded)
    yield Form(("Pad",), wrong, FIRST, "pads as an operand are not read", "Pad_02", _is_given(1))
    yield Form(("Softmax", "LogSoftmax"), wrong, EVERY, "read as of opset 13", "Softmax_08", _old_softmax)
    soft = _all(lambda c: _rank(c.operand(0)) > 2, lambda c: not _old_softmax(c))
    yield Form(("Softmax", "LogSoftmax"), wrong, FIRST, "of rank 3", "Softmax_06", soft)
    yield Form(("PRelu",), wrong, LATER, "a slope for each channel of rank 4", "PRelu_02", _slopes)
    yield Form(("PRelu",), fails, FIRST, "a slope for each channel of rank 4", "PRelu_02", _slopes)
    yield Form(("LSTM",), refused, BARRACUDA, "without B", "LSTM_03", _missing(3))
    both = _all(lambda c: c.attribute("direction", b"forward") != b"forward")
    yield Form(("LSTM",), refused, BARRACUDA, "only forward", "LSTM_06", both)
    yield Form(("LSTM",), fails, FIRST, "its memory is not found", "LSTM_01", _all(_is_given(3), _is_given(5)))
    yield Form(("LSTM",), refused, FIRST, "without a first state", "LSTM_02", _missing(5))

    yield Form(("Sub", "Div"), wrong, FIRST, "a constant first operand: they are swapped", "Sub_01", _constant_first)
    four = ("Add", "Sub", "Mul", "Div")
    yield Form(four, wrong, FIRST, "a constant of shape [1, n]: another shape", "Add_02", _row_first)
    yield Form(four, wrong, FIRST, "operands of different rank: another shape", "Add_10", _grows)
    yield Form(four, fails, FIRST, "a vector over the last axis of rank 3", "Add_06", _last_of_three)
    yield Form(("Round",), wrong, FIRST, "halves are not rounded to even", "Round_01")
    unheld = "value_float and value_floats"
    yield Form(("Constant",), refused, BEFORE_2_4, unheld, "Constant_02", lambda c: "value" not in c.attributes)
    through = "an input that is an output"
    yield Form((OUTPUT,), refused, SENTIS, through, "output_02", lambda c: c.operand(0).source is OperandSource.INPUT)
    again = "an Identity of an output that a Reshape makes"
    yield Form((OUTPUT,), refused, FROM_2_4, again, "beside the 352", _identity_of_reshaped)


RULES = tuple(_rules())
_BY_OP = {op: tuple(r for r in RULES if op in r.ops) for rule in RULES for op in rule.ops}
_MEASURED = """
    Abs Add And ArgMax ArgMin Atan AveragePool BatchNormalization Cast Ceil Clip Concat Constant ConstantOfShape
    Conv ConvTranspose Cos CumSum DepthToSpace Div Dropout Einsum Elu Equal Erf Exp Expand Flatten Floor GRU Gather
    GatherElements Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual HardSigmoid HardSwish Identity
    If InstanceNormalization LSTM LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool
    Mean Min Mod Mul Multinomial Neg Not OneHot Or PRelu Pad Pow RandomNormal RandomNormalLike RandomUniformLike
    Range Reciprocal ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare
    Relu Reshape Round ScatterND Selu Shape Sigmoid Sign Sin Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub
    Sum Tan Tanh ThresholdedRelu Tile TopK Transpose Unsqueeze Where Xor
"""
#: Operators that occur in what was measured; of any other, nothing is known.
MEASURED = frozenset((*_MEASURED.split(), INPUT, OUTPUT))
