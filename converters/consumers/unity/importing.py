"""What the importers refuse: the exception that ends the import of an ONNX file, or None.

Measured with 352 constructs and 400 files; see docs/unity.md. Where an exception's text goes on with the node as
JSON and a stack, only its beginning is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from export_model.converters.consumers.mlagents.names import RECURRENT_IN
from export_model.converters.consumers.unity.constructs import MOST_AXES
from export_model.converters.consumers.unity.consumers import Consumer, Engine
from export_model.converters.consumers.unity.findings import Thrown, null_reference
from export_model.converters.consumers.unity.onnx_file import OnnxFile, attributes
from export_model.converters.consumers.unity.readings import ELEMENTWISE

#: The operators of Barracuda 3.0.0 (its manual, and the constructs that were run).
_BARRACUDA = """
    Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Cast Ceil Clip Concat
    Constant ConstantOfShape Conv ConvTranspose Cos Cosh DepthToSpace Div Dropout Elu Equal Erf Exp Expand Flatten
    Floor Gather Gemm GlobalAveragePool GlobalMaxPool Greater HardSigmoid Identity ImageScaler InstanceNormalization
    LRN LSTM LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Mean Min Mul Multinomial Neg
    NonMaxSuppression NonZero Not OneHot Or PRelu Pad Pow RandomNormal RandomNormalLike RandomUniform
    RandomUniformLike Range Reciprocal ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum Relu Reshape Resize
    RoiAlign Round ScatterND Selu Shape Shrink Sigmoid Sign Sin Sinh Slice Softmax Softplus SpaceToDepth Split Sqrt
    Squeeze Sub Sum Tan Tanh Tile TopK Transpose Unsqueeze Upsample Where Xor
"""
BARRACUDA_OPS = frozenset(_BARRACUDA.split())
#: Operators that Sentis and the Inference Engine leave out when they import, with a warning.
_LEFT_OUT = """
    AffineGrid BitShift BlackmanWindow CenterCropPad Col2Im ConcatFromSequence ConvInteger DFT DeformConv
    DequantizeLinear Det DynamicQuantizeLinear EyeLike GRU GlobalLpPool GroupNormalization HammingWindow HannWindow If
    ImageDecoder Loop LpNormalization LpPool MatMulInteger MaxRoiPool MaxUnpool MeanVarianceNormalization
    MelWeightMatrix NegativeLogLikelihoodLoss Optional OptionalGetElement OptionalHasElement QLinearConv
    QLinearMatMul QuantizeLinear RNN RegexFullMatch ReverseSequence STFT Scan SequenceAt SequenceConstruct
    SequenceEmpty SequenceErase SequenceInsert SequenceLength SequenceMap SoftmaxCrossEntropyLoss SplitToSequence
    StringConcat StringNormalizer StringSplit TfIdfVectorizer Unique
"""
SENTIS_LEAVES_OUT = frozenset(_LEFT_OUT.split())
#: Runtime → operators that it leaves out too (seen in an original of another trainer).
LEFT_OUT_BY = {"Sentis 2.1.3": frozenset({"Mish"})}
_STANDARD = ("", "ai.onnx")
#: AttributeProto.AttributeType → the type's name in Unity's message.
_TYPES = {1: "Float", 2: "Int", 3: "String", 4: "Tensor", 6: "Floats", 7: "Ints", 8: "Strings"}
_OPTIONS = {"Slice": "Slice does the same", "Gemm": "give it a C of zeros", "LSTM": "give it a B of zeros"}


def refusal(file: OnnxFile, consumer: Consumer) -> Thrown | None:
    """The exception that importing the file throws, None where it is imported."""
    for given in file.inputs:
        if given.dims is None:
            return null_reference(f"input {given.name}", "declare a shape for the input")
        if not consumer.reads_version and given.name == RECURRENT_IN and given.dims[:1] == (1,):
            text = f"The given key '{RECURRENT_IN}' was not present in the dictionary."  # minimal model mem_1NM
            return Thrown("KeyNotFoundException", text, f"input {given.name}", "put the batch first: [N, 1, M]")
    if not consumer.refusals:
        return None
    found = _by_barracuda(file) if consumer.engine is Engine.BARRACUDA else _by_sentis(file, consumer)
    return next(found, None)


# ------------------------------------------------------------------ Barracuda


def _by_barracuda(file: OnnxFile) -> Iterator[Thrown]:
    if file.beside:
        yield Thrown(
            "OnnxLayerImportException",
            "Could not read tensor data for constant tensor.",
            f"tensor {file.beside}",
            "keep all weights in the .onnx itself; --for barracuda-3 does",
        )
    for node in file.model.graph.node:
        layer = node.output[0] if node.output else node.name
        if node.op_type not in BARRACUDA_OPS or node.domain not in _STANDARD:
            yield Thrown(
                "OnnxImportException",
                f"Unknown type {node.op_type} encountered while parsing layer {layer}.\n",
                f"node {layer} ({node.op_type})",
                "Barracuda has no such operator: --for barracuda-3 writes the policy without it",
            )
        if node.op_type == "Flatten" and _loses_rank(file, node.input[0]):
            yield Thrown(
                "Exception",
                f"Must have input rank for {node.input[0]} in order to convert Flatten to NHWC",
                f"node {layer} (Flatten)",
                "write a Reshape; --for barracuda-3 does",
            )
        if len(file.shapes.get(layer, ())) > MOST_AXES:
            yield Thrown(
                "ArgumentOutOfRangeException",
                "the shapes of a tensor of more than four axes are not known (seen of an attention over entities)",
                f"node {layer} ({node.op_type})",
                "write a .nn, or export for a later consumer",
                worded=False,
            )
        why = _refusal_of(file, node, layer)
        if why is not None:
            yield Thrown(
                "OnnxImportException",
                f"Unexpected error while parsing layer {layer} of type {node.op_type}.\n{why}",
                f"node {layer} ({node.op_type})",
                _OPTIONS.get(node.op_type, "write it another way") + "; --for barracuda-3 does",
            )


def _loses_rank(file: OnnxFile, name: str) -> bool:
    """Whether a value comes, by sums, products and activations, from a Slice whose bounds are computed.

    Barracuda does not know the rank of such a one (foreign/convlstm__legacy.onnx in r3/cases/import_not_foreseen).
    """
    waiting, seen = [name], set[str]()
    while waiting:
        node = file.producers.get(waiting.pop())
        if node is None or node.output[0] in seen:
            continue
        seen.add(node.output[0])
        if node.op_type == "Slice" and not all(file.is_stored(bound) for bound in node.input[1:] if bound):
            return True
        if node.op_type in ELEMENTWISE:
            waiting.extend(node.input)
    return False


def _refusal_of(file: OnnxFile, node: Any, layer: str) -> str | None:
    """What is said to an operator in a form that is not taken; None to every other."""
    held, given = attributes(node), dict(enumerate(node.input))
    match node.op_type:
        case "Split" if "split" not in held:
            return f"Unsupported default attribute `split` for node {layer} of type Split. Value is required."
        case "Gemm" if not given.get(2) and file.is_stored(given.get(1, "")):
            return "required Input 2 was not found."
        case "LSTM" if not given.get(3):
            return "required Input 3 was not found."
        case "LSTM" if "direction" in held and held["direction"].s not in (b"", b"forward"):
            return "Assertion failure. Value was False\nExpected: True"
        case "Conv" if 1 in given and not file.is_constant(given[1]):
            return (
                "Currently only constant tensors are supported for `W` input in node of type Conv. "
                f"Instead {layer}.W is pointing to non constant node {given[1]}."
            )
        case "Constant" if "value" not in held:
            return "Couldn't find attribute value of type Tensor"
        case "Add" if any(getattr(file.producers.get(name), "op_type", "") == "Range" for name in node.input):
            return "Assertion failure. Value was False\nExpected: True"
    return None


# ------------------------------------------------------------------ Sentis, Inference Engine


def _by_sentis(file: OnnxFile, consumer: Consumer) -> Iterator[Thrown]:
    left_out: set[str] = set()
    for node in file.model.graph.node:
        unknown = node.op_type in SENTIS_LEAVES_OUT or node.op_type in LEFT_OUT_BY.get(consumer.runtime, ())
        if unknown or node.domain not in _STANDARD:
            left_out.update(n for n in node.output if n)
            continue
        for name in node.input:
            if name in left_out:
                yield Thrown(
                    "OnnxImportException",
                    f"The given key '{name}' was not present in the dictionary.",
                    f"node {file.producers[name].output[0]} ({file.producers[name].op_type})",
                    f"the importer does not know this operator: --for {consumer.profile} writes the policy without it",
                )
        yield from _attributes(node, consumer, file.opset)
    declared = {i.name for i in file.inputs}
    for name in file.outputs:
        if name in declared:
            yield Thrown(
                "AssertionException",
                "Assertion failure. Values are not equal. Expected: 1 == 0 unexpected broken links",
                f"output {name}",
                "give it out through an Identity",
            )
        if consumer.trips_on_reshape and _identity_of_reshaped_output(file, name):
            thrown = null_reference(f"output {name}", f"give it its own producer; --for {consumer.profile} does")
            yield thrown


def _attributes(node: Any, consumer: Consumer, opset: int) -> Iterator[Thrown]:
    """An attribute of another type than the operator says is not found."""
    import onnx.defs

    layer = f"node {node.output[0] if node.output else node.name} ({node.op_type})"
    held = attributes(node)
    if node.op_type == "Constant" and "value" not in held and not (consumer.reads_value_float and held):
        yield Thrown(
            "OnnxImportException",
            "Couldn't find attribute value of type Tensor",
            layer,
            "store the number as a tensor",
        )
    try:
        said: Mapping[str, Any] = onnx.defs.get_schema(node.op_type, opset, "").attributes
    except onnx.defs.SchemaError:
        return
    for name, attribute in held.items():
        wanted = int(said[name].type.value) if name in said else attribute.type
        if attribute.type not in (wanted, 0) and wanted in _TYPES:
            yield Thrown(
                "OnnxImportException",
                f"Couldn't find attribute {name} of type {_TYPES[wanted]}",
                layer,
                f"{name} is a {_TYPES.get(attribute.type, 'graph')} in the file; "
                f"--for {consumer.profile} writes it as the operator says",
            )


def _identity_of_reshaped_output(file: OnnxFile, name: str) -> bool:
    node = file.producers.get(name)
    if node is None or node.op_type != "Identity" or not set(node.input) & set(file.outputs):
        return False
    source = file.producers.get(node.input[0])
    return source is not None and source.op_type == "Reshape"
