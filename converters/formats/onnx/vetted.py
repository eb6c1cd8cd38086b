"""An ONNX model that anyone may have made, as far as a runtime may be given it.

onnxruntime reads the files that a model names as its weights, in some releases from any folder, and loads what
custom ops need. The copy is one file: weights that lie beside the model are brought into it (from 2 GiB on, into one of
our own name beside it), others are refused, and so is every op that is not of ONNX, or one of the runtime's own of
which it is known that it computes its outputs and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import Fetched, read_bytes
from export_model.converters.formats.onnx.edit import repair_seed
from export_model.converters.formats.onnx.exporters import repair_model
from export_model.converters.formats.onnx.messages import files_of
from export_model.converters.formats.onnx.proto import decode_model, inside, load_external
from export_model.signatures.errors import UnsupportedOpError

#: Domains of ONNX, all of whose operators compute.
_ONNX = frozenset(("", "ai.onnx", "ai.onnx.ml"))
#: onnxruntime's own. Its optimiser writes some of them, and others load libraries, or what was compiled elsewhere.
_OWN = "com.microsoft"
#: Operators of that domain that onnxruntime's CPU provider computes, with no effect but their outputs and no graphs of
#: their own (1.31.1). Left out: BeamSearch, GreedySearch, Sampling and WhisperBeamSearch, which run graphs of theirs as
#: often as an input says; Tokenizer, which takes patterns; SampleOp, which is an example.
_COMPUTING = """
Attention AttnLSTM BiasGelu BifurcationDetector BranchwiseRMSNorm CDist CausalConvWithState
ConvTransposeWithDynamicPads CropAndResize DecoderMaskedMultiHeadAttention DequantizeLinear DynamicQuantizeLSTM
DynamicQuantizeMatMul DynamicTimeWarping EmbedLayerNormalization EngramGate ExpandDims FastGelu FusedConv FusedGemm
FusedMatMul GatedAdd GatedRMSNorm GatherBlockQuantized GatherND Gelu GridSample GroupQueryAttention
HyperConnectionPostMix HyperConnectionPreMix Inverse LinearAttention LinearAttentionGate MRotaryEmbedding MatMulBnb4
MatMulFpQ4 MatMulInteger16 MatMulIntegerToFloat MatMulNBits MaxpoolWithMask MoE MultiHeadAttention MurmurHash3
NGramHashMapping NGramRepeatBlock NhwcMaxPool Pad QAttention QEmbedLayerNormalization QGemm QLinearAdd
QLinearAveragePool QLinearConcat QLinearConv QLinearGlobalAveragePool QLinearLeakyRelu QLinearMul QLinearSigmoid
QLinearSoftmax QLinearWhere QMoE QuantizeLinear QuickGelu Range RotaryEmbedding ScaledSiLU SkipLayerNormalization
SkipSimplifiedLayerNormalization SparseAttention SparseToDenseMatMul TransposeMatMul Trilu UnfoldTensor Unique
VarlenNGramHashMapping WordConvEmbedding
"""
COMPUTING = frozenset(_COMPUTING.split())
#: Domains of what onnxruntime's optimiser writes for the processor that it ran on (level "all").
_LAYOUTS = frozenset(("com.microsoft.nchwc", "com.ms.internal.nhwc"))


def safe_copy(path: Path, wanted: Sequence[str], folder: Path, *, repair: str | None = None) -> Path:
    """A copy in ``folder`` of the model in the file ``path``, with all its weights in it.

    ``repair`` is the fault of its exporter that is mended (exporters.py). Raises UnsupportedOpError where an op is not
    known to compute and do no more, DamagedFileError where weights lie elsewhere.
    """
    copy = folder / path.name
    detached = Detached()
    model = self_contained_model(path, detached)
    if repair is not None:
        repair_model(model, repair)
    for name, data in files_of(model, detached, path.name).items():
        data.write(folder / name)
    return copy


def self_contained_model(path: Path, detached: Detached | None = None) -> Any:
    """The ModelProto with the data of all its files, or ``detached`` with it. Raises what ``safe_copy`` raises."""
    model = decode_model(read_bytes(path), detached)
    own = {(f.domain, f.name) for f in model.functions}
    parts = (model.graph, *model.functions)
    load_external(parts, path.parent, detached)
    for part in parts:
        for node in inside(part, "NodeProto"):
            if not _computes(node.domain, node.op_type, own):
                raise _op_error(node)
            repair_seed(node)
    for value in (*model.graph.input, *model.graph.output):
        for length in value.type.tensor_type.shape.dim:
            if length.HasField("dim_value") and length.dim_value <= 0:  # free, as the importer has it
                length.ClearField("dim_value")
    return model


def flat(path: Path, wanted: Sequence[str]) -> bytes:
    """A model of a bundle, for the caller's own process: within the bounds of a source, with names of ours.

    ``wanted`` are the names that stay, of inputs and outputs. onnxruntime prints a node's name as it is where the node
    fails, and a loop of the model would have no end there. Raises what ``read_onnx`` raises, UnsupportedOpError where
    the file has functions or graphs inside: export-model writes none.
    """
    from export_model.converters.formats.onnx.reader import read_onnx

    read_onnx(Fetched(path))
    model = self_contained_model(path)
    if model.functions or any(a.HasField("g") or a.graphs for n in model.graph.node for a in n.attribute):
        raise UnsupportedOpError(
            "the model has functions, or graphs inside its operators",
            why="it would run in your own process, and export-model writes none",
            fix="export the policy again",
        )
    graph = model.graph
    names = {"": "", **{name: name for name in wanted}}
    graph.name = "policy"
    del graph.value_info[:]
    values = (*graph.input, *graph.output, *graph.initializer)
    for number, node in enumerate(graph.node):
        node.name = f"n{number}"
        for field in (node.input, node.output):
            field[:] = [names.setdefault(name, f"v{len(names)}") for name in field]
    for value in values:
        value.name = names.setdefault(value.name, f"v{len(names)}")
    whole: bytes = model.SerializeToString(deterministic=True)
    return whole


def _computes(domain: str, kind: str, own: Set[tuple[str, str]]) -> bool:
    """Whether an op computes and does no more.

    A function that the file has in the runtime's domain does not count: the runtime takes its own operator of that
    name.
    """
    if domain == _OWN:
        return kind in COMPUTING
    return domain in _ONNX or (domain not in _LAYOUTS and (domain, kind) in own)


def _op_error(node: Any) -> UnsupportedOpError:
    issues = [(node.name, node.op_type)]
    if node.domain in _LAYOUTS:
        return UnsupportedOpError(
            f"the model has {node.domain}::{node.op_type} (node {node.name!r}), laid out for one kind of processor",
            issues=issues,
            why="onnxruntime saved it after optimising it at the level 'all'; such a file runs where it was saved",
            fix="give the model that was optimised, or save it with GraphOptimizationLevel.ORT_ENABLE_EXTENDED",
        )
    if node.domain == _OWN:
        return UnsupportedOpError(
            f"the model has onnxruntime's operator {node.domain}::{node.op_type} (node {node.name!r})",
            issues=issues,
            why="a model file is untrusted, and a runtime is given only operators known to compute and do no more",
            fix="export the model with operators of ONNX only",
        )
    return UnsupportedOpError(
        f"the model has the custom operator {node.domain}::{node.op_type} (node {node.name!r})",
        issues=issues,
        why="a runtime would need a library for it; a model file is untrusted, and none is loaded for one",
        fix="export the model with operators of ONNX only",
    )
