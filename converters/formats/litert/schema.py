"""The tables of a LiteRT file as data: TensorFlow Lite's schema.fbs, version 3, as LiteRT 2.3.0 has it.

Only what is written or read here stands in it: a table's fields in the order of their slots. Slots are never given to
another field, so that a file of any version of the schema is read by the same rows.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec import Struct

#: ``Model.version``, and what stands in bytes 4 to 8 of a file.
VERSION, IDENTIFIER = 3, b"TFL3"

#: Table → its fields by slot: name, type, and behind ``=`` the default where that is not 0. ``[…]`` is a vector, a name
#: with a capital another table, ``data`` bytes that lie at a multiple of 16; ``union`` is of the type that the field
#: before it says. An empty name: a slot that nothing here asks for.
_TABLES = {
    "Model": "version:u32 operator_codes:[OperatorCode] subgraphs:[SubGraph] description:str buffers:[Buffer] "
    "metadata_buffer:[i32] metadata:[Metadata] signature_defs:[SignatureDef]",
    "OperatorCode": "deprecated_builtin_code:i8 custom_code:str version:i32=1 builtin_code:i32",
    "SubGraph": "tensors:[Tensor] inputs:[i32] outputs:[i32] operators:[Operator] name:str",
    "Tensor": "shape:[i32] type:i8 buffer:u32 name:str quantization:QuantizationParameters is_variable:bool "
    "sparsity:SparsityParameters shape_signature:[i32] has_rank:bool",
    "SparsityParameters": "",
    "QuantizationParameters": "min:[f32] max:[f32] scale:[f32] zero_point:[i64] details_type:u8 :Any "
    "quantized_dimension:i32",
    "Operator": "opcode_index:u32 inputs:[i32] outputs:[i32] builtin_options_type:u8 builtin_options:union "
    "custom_options:[u8] custom_options_format:i8 mutating_variable_inputs:[u8] intermediates:[i32]",
    "Buffer": "data:data offset:u64 size:u64",
    "Metadata": "name:str buffer:u32",
    "SignatureDef": "inputs:[TensorMap] outputs:[TensorMap] signature_key:str :u8 subgraph_index:u32",
    "TensorMap": "name:str tensor_index:u32",
    # what an operator is told beside its operands
    "Conv2DOptions": "padding:i8 stride_w:i32 stride_h:i32 activation:i8 dilation_w_factor:i32=1 "
    "dilation_h_factor:i32=1",
    "DepthwiseConv2DOptions": "padding:i8 stride_w:i32 stride_h:i32 depth_multiplier:i32 activation:i8 "
    "dilation_w_factor:i32=1 dilation_h_factor:i32=1",
    "TransposeConvOptions": "padding:i8 stride_w:i32 stride_h:i32 activation:i8",
    "Pool2DOptions": "padding:i8 stride_w:i32 stride_h:i32 filter_width:i32 filter_height:i32 activation:i8",
    "FullyConnectedOptions": "activation:i8 weights_format:i8 keep_num_dims:bool asymmetric_quantize_inputs:bool",
    "SoftmaxOptions": "beta:f32",
    "ConcatenationOptions": "axis:i32 activation:i8",
    **dict.fromkeys(("AddOptions", "SubOptions"), "activation:i8 pot_scale_int16:bool=1"),
    **dict.fromkeys(("MulOptions", "DivOptions"), "activation:i8"),
    "ReshapeOptions": "new_shape:[i32]",
    "GatherOptions": "axis:i32 batch_dims:i32",
    "ReducerOptions": "keep_dims:bool",
    "SqueezeOptions": "squeeze_dims:[i32]",
    "StridedSliceOptions": "begin_mask:i32 end_mask:i32 ellipsis_mask:i32 new_axis_mask:i32 shrink_axis_mask:i32 "
    "offset:bool",
    **dict.fromkeys(("SplitOptions", "SplitVOptions"), "num_splits:i32"),
    "CastOptions": "in_data_type:i8 out_data_type:i8",
    **dict.fromkeys(("ArgMaxOptions", "ArgMinOptions"), "output_type:i8"),
    "ShapeOptions": "out_type:i8",
    "PackOptions": "values_count:i32 axis:i32",
    "OneHotOptions": "axis:i32",
    "UnpackOptions": "num:i32 axis:i32",
    "LeakyReluOptions": "alpha:f32",
    "BatchMatMulOptions": "adj_x:bool adj_y:bool asymmetric_quantize_inputs:bool",
    "RandomOptions": "seed:i64 seed2:i64",
    "L2NormOptions": "activation:i8",
    "CumsumOptions": "exclusive:bool reverse:bool",
    "GeluOptions": "approximate:bool",
}

#: What an ``Operator.builtin_options_type`` stands for; an operator that is told nothing may have an empty table.
OPTIONS: Mapping[str, int] = {
    "Conv2DOptions": 1,
    "DepthwiseConv2DOptions": 2,
    "Pool2DOptions": 5,
    "TransposeConvOptions": 49,
    "FullyConnectedOptions": 8,
    "SoftmaxOptions": 9,
    "ConcatenationOptions": 10,
    "L2NormOptions": 12,
    "AddOptions": 11,
    "ReshapeOptions": 17,
    "MulOptions": 21,
    "GatherOptions": 23,
    "ReducerOptions": 27,
    "SubOptions": 28,
    "DivOptions": 29,
    "SqueezeOptions": 30,
    "StridedSliceOptions": 32,
    "SplitOptions": 35,
    "CastOptions": 37,
    "ArgMaxOptions": 40,
    "ShapeOptions": 55,
    "ArgMinOptions": 57,
    "PackOptions": 59,
    "OneHotOptions": 61,
    "UnpackOptions": 64,
    "LeakyReluOptions": 75,
    "SplitVOptions": 79,
    "BatchMatMulOptions": 101,
    "CumsumOptions": 102,
    "RandomOptions": 114,
    "GeluOptions": 116,
}

#: ``Tensor.type`` by dtype, and the letter by which ``BUILTINS`` calls it.
TYPES: Mapping[np.dtype, tuple[int, str]] = {
    np.dtype(name): found
    for name, found in {
        "float32": (0, "f"),
        "float16": (1, "h"),
        "int32": (2, "i"),
        "uint8": (3, "u"),
        "int64": (4, "l"),
        "bool": (6, "b"),
        "int16": (7, "s"),
        "int8": (9, "c"),
        "float64": (10, "d"),
        "uint64": (12, "L"),
        "uint32": (15, "I"),
        "uint16": (16, "S"),
    }.items()
}
PADDINGS = {"SAME": 0, "VALID": 1}
ACTIVATIONS = {"": 0, "RELU": 1, "RELU_N1_TO_1": 2, "RELU6": 3, "TANH": 4}

#: Operator → its number, its table of options, the dtypes that its kernel takes (by the letters of ``TYPES``, ``*`` for
#: all), then ``@`` the operand whose dtype counts where that is not the first, and versions above 1: by dtype, and
#: behind ``>4=`` where operands of more than four axes are broadcast (0: that is not done).
#: Versions are those that TensorFlow 2.21's converter gives the same operator, and dtypes those that it writes it for.
#: No dtype (``-``): an operator of other tools' files, which is read and not written.
_BUILTINS = """
ABS 101 - fi i=5
ADD 0 AddOptions fil l=4
ADD_N 106 - fi
ARG_MAX 56 ArgMaxOptions fib b=3
ARG_MIN 79 ArgMinOptions fib b=3
AVERAGE_POOL_2D 1 Pool2DOptions f
BATCH_MATMUL 126 BatchMatMulOptions f
BATCH_TO_SPACE_ND 37 - -
BROADCAST_TO 130 - -
CAST 53 CastOptions *
CEIL 104 - f
CONCATENATION 2 ConcatenationOptions filub
CONV_2D 3 Conv2DOptions f
COS 108 - f
CUMSUM 128 CumsumOptions -
DEPTHWISE_CONV_2D 4 DepthwiseConv2DOptions f
DEQUANTIZE 6 - hc h=3 c=5
DIV 42 DivOptions fi >4=2
ELU 111 - f
EQUAL 71 - filb >4=0
EXP 47 - f
EXPAND_DIMS 70 - *
FILL 94 - filb @1 b=2
FLOOR 8 - f
FLOOR_DIV 90 - fi f=2 >4=0
FLOOR_MOD 95 - fil >4=0
FULLY_CONNECTED 9 FullyConnectedOptions f
GATHER 36 GatherOptions filub b=3
GATHER_ND 107 - -
GELU 150 GeluOptions -
GREATER 61 - fil >4=0
GREATER_EQUAL 62 - fil >4=0
HARD_SWISH 117 - -
L2_NORMALIZATION 11 L2NormOptions -
LEAKY_RELU 98 LeakyReluOptions f
LESS 58 - fil >4=0
LESS_EQUAL 63 - fil >4=0
LOG 73 - f
LOGICAL_AND 86 - b >4=0
LOGICAL_NOT 87 - b
LOGICAL_OR 84 - b >4=0
LOGISTIC 14 - f
LOG_SOFTMAX 50 - f
MAXIMUM 55 - fil >4=3
MAX_POOL_2D 17 Pool2DOptions f
MEAN 40 ReducerOptions fil
MINIMUM 57 - fil >4=3
MUL 18 MulOptions fil l=5
MULTINOMIAL 149 RandomOptions f
NEG 59 - fil
NOT_EQUAL 72 - filb >4=0
ONE_HOT 85 OneHotOptions filb @2
PACK 83 PackOptions filu
PAD 34 - fil
PADV2 60 - fil
POW 78 - fi >4=0
PRELU 54 - -
RANDOM_STANDARD_NORMAL 146 RandomOptions *
RANDOM_UNIFORM 148 RandomOptions *
RANGE 96 - fil l=2
RANK 110 - -
REDUCE_ALL 140 ReducerOptions b
REDUCE_ANY 91 ReducerOptions b
REDUCE_MAX 82 ReducerOptions fil
REDUCE_MIN 89 ReducerOptions fil
REDUCE_PROD 81 ReducerOptions fil
RELU 19 - f
RELU6 21 - f
RELU_0_TO_1 152 - -
RELU_N1_TO_1 20 - -
RESHAPE 22 ReshapeOptions *
REVERSE_V2 105 - -
ROUND 116 - f
RSQRT 76 - f
SELECT 64 - filub @1
SELECT_V2 123 - filub @1
SHAPE 77 ShapeOptions *
SIGN 158 - fi i=2
SIN 66 - f
SLICE 65 - filub
SOFTMAX 25 SoftmaxOptions f
SPACE_TO_BATCH_ND 38 - -
SPARSE_TO_DENSE 68 - filu @2
SPLIT 49 SplitOptions fi @1 i=3
SPLIT_V 102 SplitVOptions fil
SQRT 75 - f
SQUARE 92 - f
SQUARED_DIFFERENCE 99 - fi >4=0
SQUEEZE 43 SqueezeOptions *
STRIDED_SLICE 45 StridedSliceOptions filub b=3
SUB 41 SubOptions fil l=4 >4=3
SUM 74 ReducerOptions fil
TANH 28 - f
TILE 69 - filub
TOPK_V2 48 - -
TRANSPOSE 39 - filub b=3 >4=4
TRANSPOSE_CONV 67 TransposeConvOptions -
UNPACK 88 UnpackOptions fib b=3
WHERE 109 - bfil
ZEROS_LIKE 93 - fil
"""


class Builtin(Struct, frozen=True):
    """An operator; see ``_BUILTINS``."""

    code: int
    options: str
    takes: str
    operand: int
    versions: Mapping[str, int]

    def version(self, letter: str, axes: int) -> int | None:
        """The lowest that does, for operands of a dtype and ``axes`` axes at most; None where none does."""
        if self.takes != "*" and letter not in self.takes:
            return None
        wide = self.versions.get(">4", 1) if axes > 4 else 1
        return max(wide, self.versions.get(letter, 1)) if wide else None


#: Operators that are neither written nor read, by the names that people know, for messages.
_OTHERS = """
ASSIGN_VARIABLE 144
BIDIRECTIONAL_SEQUENCE_LSTM 52
CALL_ONCE 129
CONV_3D 132
DEPTH_TO_SPACE 5
EMBEDDING_LOOKUP 7
FAKE_QUANT 80
IF 118
LSTM 16
MIRROR_PAD 100
QUANTIZE 114
READ_VARIABLE 143
RESIZE_BILINEAR 23
RESIZE_NEAREST_NEIGHBOR 97
SCATTER_ND 122
SPACE_TO_DEPTH 26
STABLEHLO_COMPOSITE 206
SVDF 27
UNIDIRECTIONAL_SEQUENCE_LSTM 44
UNIDIRECTIONAL_SEQUENCE_RNN 35
VAR_HANDLE 142
WHILE 119
"""


def _builtin(code: str, options: str, takes: str, *more: str) -> Builtin:
    operand = next((int(m[1:]) for m in more if m.startswith("@")), 0)
    versions = {key: int(version) for key, _, version in (m.partition("=") for m in more) if version}
    return Builtin(int(code), options.strip("-"), takes, operand, versions)


BUILTINS: Mapping[str, Builtin] = {
    name: _builtin(*rest) for name, *rest in (line.split() for line in _BUILTINS.split("\n") if line)
}


#: Number → name of every operator that has one here.
OPERATOR_NAMES: Mapping[int, str] = {
    **{int(code): name for name, code in (line.split() for line in _OTHERS.split("\n") if line)},
    **{builtin.code: name for name, builtin in BUILTINS.items()},
}


class TableField(Struct, frozen=True):
    """A field of a table: its slot, what it holds, and what it is where the file does not say."""

    name: str
    slot: int
    kind: str
    default: int


def _fields(text: str) -> tuple[TableField, ...]:
    found = []
    for slot, field in enumerate(text.split()):
        name, _, kind = field.partition(":")
        kind, _, default = kind.partition("=")
        if name:
            found.append(TableField(name, slot, kind, int(default or 0)))
    return tuple(found)


TABLES: Mapping[str, tuple[TableField, ...]] = {name: _fields(text) for name, text in _TABLES.items()}
