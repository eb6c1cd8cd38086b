"""How far the runtimes' approximations of functions are from the functions, by op.

It was measured (``tests/runtimes/test_approximations.py``), over arguments from 1e-6 to 30; a formula like exp(x) - 1
is as far off at its zero as anywhere, which no number of units in the last place of its result says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

Arithmetic: TypeAlias = Literal["processor", "graphics", "phone", "compiled"]

#: The smallest float32 that has all its digits. XNNPACK's exp (LiteRT, TensorFlow.js' wasm) adds 2ⁿ and a part of it,
#: which is flushed to zero: near this number a result is off by some of it (measured: exp(-84.52) by 4 %).
TINY = 2.0**-126
#: Op → (units in the last place of the result, absolute): the farther of both counts. The worst of TensorFlow 1.4, 1.7
#: and 2.21 (Eigen), onnxruntime 1.31 and its wasm build 1.30 (MLAS), TensorFlow.js 4.22's cpu and wasm (XNNPACK).
_PROCESSOR: Mapping[str, tuple[float, float]] = {
    "Cos": (2, 3.2e-7),
    "Elu": (1, 7e-8),
    "Erf": (5, 1.7e-7),
    "Exp": (2, TINY),
    "Expm1": (4, 9e-8),
    "Log": (3, 0),
    "Log1p": (3, 1.1e-7),
    "LogSoftmax": (3, 1.3e-7),
    "Rsqrt": (3, 0),
    "Selu": (2, 1.3e-7),
    "Sigmoid": (6, 1.7e-7),
    "Sin": (5, 2.5e-7),
    "Softmax": (36, TINY),
    "Softplus": (7, 1.1e-7),
    "Sqrt": (4, 0),
    "Tanh": (6, 0),
}
#: TensorFlow.js' WebGL, where it is worse: shaders, and here Chromium's software renderer.
_GRAPHICS = {
    "Cos": (2, 2e-4),
    "Elu": (4, 1.8e-7),
    "Erf": (6, 5.8e-7),
    "Exp": (28, TINY),
    "Expm1": (28, 2.2e-7),
    "Log": (4, 1.2e-7),
    "Log1p": (4, 1.8e-7),
    "LogSoftmax": (3, 2.4e-7),
    "Selu": (4, 3.2e-7),
    "Sin": (5, 2e-4),
    "Softmax": (64, TINY),
    "Softplus": (7, 1.1e-7),
    "Tanh": (6, 1.4e-7),
}
#: LiteRT 2.3, with XNNPACK and without, where it is worse: XNNPACK's exp, and formulas for what it has no operator for.
_PHONE = {
    "Erf": (5, 4.9e-7),
    "Exp": (27, TINY),
    "Expm1": (27, 9e-8),
    "Log": (3, 5.7e-7),
    "Log1p": (3, 3.1e-7),
    "Softplus": (7, 5.8e-7),
}
#: OpenVINO 2026.4, which makes the code of a model's functions itself, where it is worse.
_COMPILED = {"Elu": (1, 1.1e-7), "Erf": (5, 4.6e-7), "Exp": (3, TINY), "Expm1": (4, 2e-7), "Softplus": (7, 2e-6)}
#: One unit in the last place above 1, and two: onnxruntime 1.31's tanh of 8.4755; Eigen's in TensorFlow 1.4 gives one.
_ONE, _TANH = 1 + 2.0**-23, 1 + 2.0**-22
#: What no runtime's function goes beyond, however it approximates it (measured there, too): log(1 - tanh(x)² + 1e-6) of
#: a number farther above 1 would be no number.
RANGES: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(("Cos", "Erf", "Sin"), (-_ONE, _ONE)),
    "Tanh": (-_TANH, _TANH),
    **dict.fromkeys(("Sigmoid", "Softmax"), (0.0, _ONE)),
    "Exp": (0.0, float("inf")),
}
APPROXIMATIONS: Mapping[Arithmetic, Mapping[str, tuple[float, float]]] = {
    "processor": _PROCESSOR,
    "graphics": {**_PROCESSOR, **_GRAPHICS},
    "phone": {**_PROCESSOR, **_PHONE},
    "compiled": {**_PROCESSOR, **_COMPILED},
}
