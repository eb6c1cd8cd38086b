"""The numbers that a ``.nn`` uses for layers and activations, and the axes of its tensors.

Source: Barracuda's ``Layer.Type`` and ``Layer.Activation`` (Model.cs of 0.1.x to 3.0).
"""

from __future__ import annotations

from enum import IntEnum


class LayerType(IntEnum):
    """What a layer computes."""

    NOP = 0
    DENSE = 1
    MATMUL = 2
    DENSE3 = 3
    CONV2D = 20
    DEPTHWISE_CONV2D = 21
    CONV2D_TRANS = 22
    UPSAMPLE2D = 23
    MAX_POOL2D = 25
    AVG_POOL2D = 26
    GLOBAL_MAX_POOL2D = 27
    GLOBAL_AVG_POOL2D = 28
    BORDER2D = 29
    CONV3D = 30
    CONV3D_TRANS = 32
    UPSAMPLE3D = 33
    MAX_POOL3D = 35
    AVG_POOL3D = 36
    GLOBAL_MAX_POOL3D = 37
    GLOBAL_AVG_POOL3D = 38
    BORDER3D = 39
    ACTIVATION = 50
    SCALE_BIAS = 51
    NORMALIZATION = 52
    LRN = 53
    DROPOUT = 60
    RANDOM_NORMAL = 64
    RANDOM_UNIFORM = 65
    MULTINOMIAL = 66
    ONE_HOT = 67
    TOP_K_INDICES = 68
    TOP_K_VALUES = 69
    NON_ZERO = 70
    RANGE = 71
    ROI_ALIGN = 72
    ADD = 100
    SUB = 101
    MUL = 102
    DIV = 103
    POW = 104
    MIN = 110
    MAX = 111
    MEAN = 112
    REDUCE_L1 = 120
    REDUCE_L2 = 121
    REDUCE_LOG_SUM = 122
    REDUCE_LOG_SUM_EXP = 123
    REDUCE_MAX = 124
    REDUCE_MEAN = 125
    REDUCE_MIN = 126
    REDUCE_PROD = 127
    REDUCE_SUM = 128
    REDUCE_SUM_SQUARE = 129
    GREATER = 140
    GREATER_EQUAL = 141
    LESS = 142
    LESS_EQUAL = 143
    EQUAL = 144
    LOGICAL_OR = 145
    LOGICAL_AND = 146
    LOGICAL_NOT = 147
    LOGICAL_XOR = 148
    WHERE = 149
    SIGN = 150
    PAD = 159
    PAD2D_REFLECT = 160
    PAD2D_SYMMETRIC = 161
    PAD2D_EDGE = 162
    ARG_MAX = 163
    ARG_MIN = 164
    CONSTANT_OF_SHAPE = 199
    FLATTEN = 200
    RESHAPE = 201
    TRANSPOSE = 202
    SQUEEZE = 203
    UNSQUEEZE = 204
    GATHER = 205
    DEPTH_TO_SPACE = 206
    SPACE_TO_DEPTH = 207
    EXPAND = 208
    RESAMPLE2D = 209
    CONCAT = 210
    STRIDED_SLICE = 211
    TILE = 212
    SHAPE = 213
    NON_MAX_SUPPRESSION = 214
    LSTM = 215
    SCATTER_ND = 216
    LOAD = 255


class Activation(IntEnum):
    """What an Activation layer computes, or what another layer applies to its result."""

    NONE = 0
    RELU = 1
    SOFTMAX = 2
    TANH = 3
    SIGMOID = 4
    ELU = 5
    RELU6 = 6
    LEAKY_RELU = 7
    SELU = 8
    SWISH = 9
    LOG_SOFTMAX = 10
    SOFTPLUS = 11
    SOFTSIGN = 12
    PRELU = 13
    HARDMAX = 20
    HARD_SIGMOID = 21
    ABS = 100
    NEG = 101
    CEIL = 102
    CLIP = 103
    FLOOR = 104
    ROUND = 105
    RECIPROCAL = 110
    SQRT = 111
    POW = 112
    EXP = 113
    LOG = 114
    ACOS = 200
    ACOSH = 201
    ASIN = 202
    ASINH = 203
    ATAN = 204
    ATANH = 205
    COS = 206
    COSH = 207
    SIN = 208
    SINH = 209
    TAN = 210
    ERF = 211


#: Positions of the axes in the four-entry shapes of versions up to 16.
N, H, W, C = range(4)


def layer_label(number: int) -> str:
    """``"Conv2D (20)"``-like words for a layer's type."""
    return _label(LayerType, number)


def activation_label(number: int) -> str:
    """``"Elu (5)"``-like words for an activation."""
    return _label(Activation, number)


def _label(kind: type[IntEnum], number: int) -> str:
    if number not in kind._value2member_map_:
        return f"an unknown one ({number})"
    words = kind(number).name.split("_")
    return f"{''.join(w[:1] + w[1:].lower() for w in words)} ({number})"
