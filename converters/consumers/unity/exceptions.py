"""What the importers throw at the constructs that they refuse or cannot run, in Unity's words.

Construct of ../shared/unity/onnx_rules → (the importer from which on it is thrown, class and text). Layers have the
names of that construct; where the text goes on with the node as JSON and a stack, only its beginning is given.
"""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.consumers.unity.importers import IMPORTERS


def _parsing(layer: str, op: str, cause: str) -> str:
    return f"OnnxImportException: Unexpected error while parsing layer {layer} of type {op}.\n{cause}"


EXCEPTIONS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "ReduceSum_10": (("Barracuda 1.1.2", _parsing("y", "ReduceSum", "Couldn't find attribute axes of type Ints")),),
    "ReduceSum_05": (("Barracuda 1.1.2", _parsing("y", "ReduceSum", "Couldn't find attribute axes of type Ints")),),
    "ReduceSum_06": (("Barracuda 1.1.2", "NotImplementedException: The method or operation is not implemented."),),
    "input_12": (
        ("Barracuda 1.1.2", "ArgumentException: An item with the same key has already been added. Key: y__transpose"),
    ),
    "Einsum_01": (("Barracuda 1.1.2", "OnnxImportException: Unknown type Einsum encountered while parsing layer y."),),
    "ArgMax_01": (("Barracuda 1.1.2", "OnnxImportException: Unknown type ArgMax encountered while parsing layer i."),),
    "Erf_01": (("Barracuda 1.1.2", "OnnxImportException: Unknown type Erf encountered while parsing layer y."),),
    "GRU_01": (("Sentis 2.1.3", "OnnxImportException: The given key 'ho' was not present in the dictionary."),),
    "Split_04": (
        (
            "Barracuda 1.4.0",
            _parsing(
                "y", "Split", "Unsupported default attribute `split` for node y of type Split. Value is required."
            ),
        ),
    ),
    "Squeeze_04": (("Barracuda 1.1.2", _parsing("y", "Squeeze", "Couldn't find attribute axes of type Ints")),),
    "Reshape_08": (
        ("Barracuda 1.4.0", "ArgumentException: Cannot reshape array of size 18 into shape (n:1, h:6, w:1, c:1)"),
    ),
    "Conv_21": (
        ("Barracuda 1.1.2", _parsing("fq", "Concat", "Only tensors of rank 4 or less are supported, but got rank 8")),
    ),
    "Gemm_06": (("Barracuda 2.3.1", _parsing("y", "Gemm", "required Input 2 was not found.")),),
    "Gemm_07": (("Barracuda 1.1.2", "AssertionException: Assertion failure. Values are not equal. Expected: 1 == 4"),),
    "Gemm_10": (
        (
            "Barracuda 1.1.2",
            _parsing(
                "y",
                "Gemm",
                "Currently only constant tensors are supported for `B` input in node of type Gemm. "
                "Instead y.B is pointing to non constant node b2.",
            ),
        ),
    ),
    "MatMul_05": (
        ("Barracuda 1.1.2", _parsing("y", "MatMul", "Assertion failure. Values are not equal. Expected: 15 == 20")),
    ),
    "MatMul_06": (
        ("Barracuda 1.1.2", "AssertionException: Assertion failure. Values are not equal. Expected: 12 == 1"),
    ),
    "Clip_07": (
        ("Barracuda 1.1.2", "ArgumentException: An item with the same key has already been added. Key: m__transpose"),
    ),
    "Slice_16": (("Barracuda 1.1.2", "AssertionException: Assertion failure. Value was False\nExpected: True"),),
    "Gather_04": (("Barracuda 1.1.2", "IndexOutOfRangeException: Index was outside the bounds of the array."),),
    "Gather_05": (
        (
            "Barracuda 1.1.2",
            _parsing(
                "y",
                "Gather",
                "Currently only constant tensors are supported for `indices` input in node of type "
                "Gather. Instead y.indices is pointing to non constant node i.",
            ),
        ),
    ),
    "Conv_15": (
        (
            "Barracuda 1.1.2",
            "ArgumentException: Cannot reshape array of size 12 into shape with multiple of 48 elements",
        ),
    ),
    "Expand_01": (("Barracuda 1.1.2", "AssertionException: Assertion failure. Value was False\nExpected: True"),),
    "TopK_01": (("Barracuda 1.1.2", "IndexOutOfRangeException: Index was outside the bounds of the array."),),
    "Conv_11": (
        ("Barracuda 1.1.2", "NotImplementedException: The method or operation is not implemented."),
        (
            "Barracuda 2.3.1",
            "NotImplementedException: DepthwiseConv2D only support number of groups == number of "
            "input channels at the moment.",
        ),
    ),
    "Conv_14": (
        (
            "Barracuda 1.1.2",
            _parsing(
                "y",
                "Conv",
                "Currently only constant tensors are supported for `W` input in node of type Conv. "
                "Instead y.W is pointing to non constant node k3.",
            ),
        ),
    ),
    "PRelu_02": (("Barracuda 1.1.2", "AssertionException: Assertion failure. Value was False\nExpected: True"),),
    "LSTM_03": (("Barracuda 1.1.2", _parsing("o", "LSTM", "required Input 3 was not found.")),),
    "LSTM_06": (
        (
            "Barracuda 1.1.2",
            "ArgumentOutOfRangeException: Specified argument was out of the range of valid values. (Parameter 'index')",
        ),
        ("Barracuda 1.4.0", _parsing("o", "LSTM", "Assertion failure. Value was False\nExpected: True")),
    ),
    "LSTM_01": (("Barracuda 1.1.2", "KeyNotFoundException: The given key 'c_h' was not present in the dictionary."),),
    "LSTM_02": (
        (
            "Barracuda 1.1.2",
            "ArgumentOutOfRangeException: Specified argument was out of the range of valid values. (Parameter 'index')",
        ),
    ),
    "Add_06": (("Barracuda 1.1.2", "AssertionException: Assertion failure. Value was False\nExpected: True"),),
    "Constant_02": (
        ("Barracuda 1.1.2", _parsing("c", "Constant", "Couldn't find attribute value of type Tensor")),
        ("Sentis 2.1.3", "OnnxImportException: Couldn't find attribute value of type Tensor"),
    ),
    "output_02": (
        (
            "Sentis 2.1.3",
            "AssertionException: Assertion failure. Values are not equal. Expected: 1 == 0 "
            "unexpected broken links: System.Collections.Generic.List`1[System.Int32]",
        ),
        (
            "Inference Engine 2.4.0",
            "AssertionException: Assertion failure. Values are not equal. Expected: 1 == 0 unexpected broken links: 1",
        ),
    ),
}


def exception_of(evidence: str, importer: str) -> str | None:
    """Return what an importer throws at a construct, None where that was not recorded."""
    order = tuple(IMPORTERS)
    until = order.index(importer)
    said = [text for since, text in EXCEPTIONS.get(evidence, ()) if order.index(since) <= until]
    return said[-1] if said else None
