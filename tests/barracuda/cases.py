"""One small model per kind of layer and activation, with an input that shows what it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from export_model.converters.formats.barracuda.format import NnModel
from tests.barracuda.nn_files import Maker

Array = np.ndarray
BATCH = 3


@dataclass(frozen=True)
class Case:
    """A model whose last tensor, flattened, is ``action``; ``feeds`` are [N, H, W, C]."""

    name: str
    model: NnModel
    feeds: dict[str, Array]


def _draw(*shape: int, low: float = -2.5, high: float = 2.5) -> Array:
    seed = sum((i + 1) * n for i, n in enumerate(shape))
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def _case(name: str, build: Callable[[Maker], str], x: Array, version: int = 16, **others: Array) -> Case:
    m = Maker(version)
    main = "vector_observation" if x.shape[1:3] == (1, 1) else "visual_observation_0"
    feeds = {main: x, **others}
    for key, array in feeds.items():
        m.input(key, *array.shape[1:])
    last = build(m)
    # A constant goes through arithmetic with the observation, so that the action has a row per agent.
    m.layer("flat", 200, last)
    m.layer("action", 50, "flat")
    return Case(name, m.model(), feeds)


X1, X4 = "vector_observation", "visual_observation_0"
VECTOR = _draw(BATCH, 1, 1, 6)
IMAGE = _draw(BATCH, 5, 7, 4)


def _unary() -> Iterator[Case]:
    inside, above, apart = (
        _draw(BATCH, 1, 1, 8, low=-0.99, high=0.99),
        _draw(BATCH, 1, 1, 8, low=1.01, high=9),
        _draw(BATCH, 1, 1, 8, low=0.1, high=4),
    )
    domain = {111: apart, 112: apart, 114: apart, 110: apart, 200: inside, 202: inside, 205: inside, 201: above}
    parameters = {5: (0.7, 0.0), 7: (0.1, 0.0), 8: (1.6732, 1.0507), 21: (0.2, 0.5), 103: (-0.5, 1.25), 112: (2.5, 0)}
    numbers = [*range(1, 13), 20, 21, *range(100, 106), *range(110, 115), *range(200, 212)]
    for number in numbers:
        alpha, beta = parameters.get(number, (1.0, 0.0))
        for label, x in (("vector", domain.get(number, VECTOR)), ("image", domain.get(number, IMAGE))):
            if label == "image" and x.shape[1:3] == (1, 1):
                x = np.concatenate([x, x[::-1]], axis=3).reshape(BATCH, 2, 4, 2)

            def build(m: Maker, number: int = number, alpha: float = alpha, beta: float = beta) -> str:
                return m.layer("y", 50, m.inputs[0].name, activation=number, alpha=alpha, beta=beta)

            yield _case(f"activation-{number}-{label}", build, x)
    yield _case("leaky-steep", lambda m: m.layer("y", 50, X1, activation=7, alpha=1.5), VECTOR)
    yield _case("elu-default", lambda m: m.layer("y", 50, X1, activation=5), VECTOR)
    wide = np.array([[[[-1e30, -3e5, -1.5, -1e-4, 0, 1e-4, 1.5, 3e5, 1e30, 20]]]], np.float32).repeat(BATCH, 0)
    yield _case("atan-far", lambda m: m.layer("y", 50, X1, activation=204), wide)
    edge = np.array([[[[-1, -0.9999999, -0.5, 0, 1e-5, 0.9999999, 1]]]], np.float32).repeat(BATCH, 0)
    yield _case("asin-edges", lambda m: m.layer("y", 50, X1, activation=202), edge)
    yield _case("acos-edges", lambda m: m.layer("y", 50, X1, activation=200), edge)
    slopes = _draw(1, 1, 1, 4)
    yield _case("prelu", lambda m: m.layer("y", 50, X4, activation=13, data={"slopes": slopes}), IMAGE)


def _fused() -> Iterator[Case]:
    kernel, bias = _draw(6, 1, 1, 5), _draw(1, 1, 1, 5)
    for number in (1, 2, 3, 4, 5, 6, 9, 11, 101, 206, 208, 211):

        def build(m: Maker, number: int = number) -> str:
            return m.layer("y", 1, X1, activation=number, data={"k": kernel, "b": bias})

        yield _case(f"dense-fused-{number}", build, VECTOR)
    yield _case("add-fused", lambda m: m.layer("y", 100, X1, m.load("c", 1.5), activation=3), VECTOR)


def _products() -> Iterator[Case]:
    bias = _draw(1, 1, 1, 5)
    yield _case("dense", lambda m: m.layer("y", 1, X1, data={"k": _draw(6, 1, 1, 5), "b": bias}), VECTOR)
    yield _case("dense-image", lambda m: m.layer("y", 1, X4, data={"k": _draw(140, 1, 1, 5), "b": bias}), IMAGE)
    zero = np.zeros((1, 1, 1, 5))
    yield _case("dense-no-bias", lambda m: m.layer("y", 1, X1, data={"k": _draw(6, 1, 1, 5), "patch:0": zero}), VECTOR)
    yield _case("matmul", lambda m: m.layer("y", 2, X1, m.load("k", _draw(6, 1, 1, 3))), VECTOR)
    yield _case("matmul-2-2", lambda m: m.layer("y", 2, X1, m.load("k", _draw(6, 1, 1, 3)), pool=(2, 2)), VECTOR, 17)
    rows = _draw(BATCH, 1, 7, 4)
    yield _case("matmul-3-2", lambda m: m.layer("y", 2, X4, m.load("k", _draw(7, 1, 1, 3)), pool=(3, 2)), rows, 17)
    yield _case("matmul-4-2", lambda m: m.layer("y", 2, X4, m.load("k", _draw(7, 1, 1, 3)), pool=(4, 2)), IMAGE, 17)

    def both(m: Maker) -> str:
        turned = m.layer("t", 202, X4, pool=(0, 2, 1, 3))
        return m.layer("y", 2, X4, turned, pool=(4, 4))

    yield _case("matmul-4-4", both, IMAGE, 17)

    def three(m: Maker) -> str:
        cut = m.layer("part", 211, X4, pad=(0, 0, 0, 0), pool=(0, 0, 4, 0), stride=(1, 1, 1, 1))
        return m.layer("y", 2, cut, X4, pool=(3, 3))

    yield _case("matmul-3-3", three, _draw(BATCH, 1, 4, 4), 17)
    data = {"k": _draw(7, 1, 1, 3), "b": _draw(1, 1, 1, 3)}
    yield _case("dense3", lambda m: m.layer("y", 3, X4, data=data), rows, 18)
    ones, scale = np.ones((1, 1, 1, 4)), _draw(1, 1, 1, 4)
    yield _case("scale-bias", lambda m: m.layer("y", 51, X4, data={"s": scale, "b": scale[..., ::-1]}), IMAGE)
    yield _case("bias-alone", lambda m: m.layer("y", 51, X4, data={"s": ones, "b": scale}), IMAGE)
    short = {"s": _draw(1, 1, 1, 6), "b": np.zeros((1, 1, 1, 6))}
    yield _case("scale-alone", lambda m: m.layer("y", 51, X1, data=short), VECTOR)
    norm = {"s": scale, "b": scale[..., ::-1]}
    yield _case("normalization", lambda m: m.layer("y", 52, X4, beta=1e-5, data=norm), IMAGE)
    yield _case("normalization-no-epsilon", lambda m: m.layer("y", 52, X4, data=norm), IMAGE)


def _windows() -> Iterator[Case]:
    pads = {"valid": (0, 0, 0, 0), "upper": (-1,), "lower": (-2,), "explicit": (2, 0, 1, 3)}
    for (label, pad), stride in [(p, s) for p in pads.items() for s in ((1, 1), (2, 2), (3, 3))]:

        def conv(m: Maker, pad: tuple[int, ...] = pad, stride: tuple[int, int] = stride) -> str:
            data = {"k": _draw(3, 2, 4, 5), "b": _draw(1, 1, 1, 5)}
            return m.layer("y", 20, X4, pad=pad, stride=stride, data=data)

        def depthwise(m: Maker, pad: tuple[int, ...] = pad, stride: tuple[int, int] = stride) -> str:
            data = {"k": _draw(2, 3, 1, 4), "b": _draw(1, 1, 1, 4)}
            return m.layer("y", 21, X4, pad=pad, stride=stride, data=data)

        yield _case(f"conv2d-{label}-{stride[0]}", conv, IMAGE)
        yield _case(f"depthwise-{label}-{stride[0]}", depthwise, IMAGE)
        for kind, name in ((25, "max"), (26, "avg")):

            def pool(m: Maker, kind: int = kind, pad: tuple[int, ...] = pad, stride: tuple[int, int] = stride) -> str:
                return m.layer("y", kind, X4, pad=pad, stride=stride, pool=(3, 4))

            yield _case(f"{name}-pool-{label}-{stride[0]}", pool, IMAGE)
    wide = {"k": _draw(3, 2, 4, 5), "b": np.zeros((1, 1, 1, 5))}
    yield _case("conv2d-wide-stride", lambda m: m.layer("y", 20, X4, stride=(3, 2), pad=(0,) * 4, data=wide), IMAGE)
    whole = {"k": _draw(5, 7, 4, 5), "b": _draw(1, 1, 1, 5)}
    yield _case("conv2d-to-a-point", lambda m: m.layer("y", 20, X4, stride=(1, 1), pad=(0,) * 4, data=whole), IMAGE)
    for stride, pad, adjust, size in (
        (1, 0, (), (3, 3)),
        (2, 0, (), (3, 2)),
        (2, 1, (), (3, 3)),
        (2, 1, (1, 1), (4, 4)),
        (3, 2, (0, 0), (3, 5)),
        (2, 0, (0, 0), (1, 1)),
        (4, 0, (1, 2), (2, 2)),
        (1, 2, (), (3, 3)),
    ):

        def trans(
            m: Maker,
            stride: int = stride,
            pad: int = pad,
            adjust: tuple[int, ...] = adjust,
            size: tuple[int, int] = size,
        ) -> str:
            data = {"k": _draw(*size, 4, 3), "b": _draw(1, 1, 1, 3)}
            return m.layer("y", 22, X4, stride=(stride, stride), pad=(pad,) * 4, pool=adjust, data=data)

        yield _case(f"conv2dtrans-{stride}-{pad}-{len(adjust)}-{size[0]}{size[1]}", trans, IMAGE)
    yield _case("global-max-pool", lambda m: m.layer("y", 27, X4), IMAGE)
    yield _case("global-avg-pool", lambda m: m.layer("y", 28, X4), IMAGE)
    yield _case("global-avg-pool-of-a-row", lambda m: m.layer("y", 28, X1), VECTOR)
    yield _case("upsample", lambda m: m.layer("y", 23, X4, pool=(3, 2)), IMAGE)
    for kind, name in ((29, "border"), (160, "reflect"), (161, "symmetric"), (162, "edge")):
        for pad in ((1, 2, 3, 0), (-1, 0, 2, -2), (0, 1, 1, 2, 0, 0)):

            def edged(m: Maker, kind: int = kind, pad: tuple[int, ...] = pad) -> str:
                return m.layer("y", kind, X4, pad=pad, beta=1.5 if kind == 29 else 0.0)

            yield _case(f"{name}-{'_'.join(map(str, pad))}", edged, IMAGE)
    yield _case("border-zero", lambda m: m.layer("y", 29, X4, pad=(1, 1, 1, 1)), IMAGE)


def _arithmetic() -> Iterator[Case]:
    other = _draw(BATCH, 1, 1, 6, low=0.5, high=3)
    positive = np.abs(VECTOR) + 0.1
    for kind in (100, 101, 102, 103, 104, 110, 111, 112):

        def two(m: Maker, kind: int = kind) -> str:
            return m.layer("y", kind, X1, "vector_observation_1")

        def three(m: Maker, kind: int = kind) -> str:
            return m.layer("y", kind, X1, "vector_observation_1", m.load("c", _draw(1, 1, 1, 6, low=0.5)))

        def with_image(m: Maker, kind: int = kind) -> str:
            return m.layer("y", kind, X4, X1 if kind == 99 else "row", m.load("c", _draw(1, 1, 1, 4, low=0.5)))

        yield _case(f"binary-{kind}", two, positive, vector_observation_1=other)
        yield _case(f"n-ary-{kind}", three, positive, 17, vector_observation_1=other)
        row = _draw(BATCH, 1, 1, 4, low=0.5, high=2)
        yield _case(f"image-and-row-{kind}", with_image, np.abs(IMAGE) + 0.1, 17, row=row)
    rounded = np.round(VECTOR)
    for kind in (140, 141, 142, 143, 144, 145, 146, 148):

        def compare(m: Maker, kind: int = kind) -> str:
            return m.layer("y", kind, X1, "vector_observation_1")

        yield _case(f"logic-{kind}", compare, rounded, vector_observation_1=np.round(other - 1.5))
    yield _case("logic-147", lambda m: m.layer("y", 147, X1), rounded)

    def choose(m: Maker) -> str:
        return m.layer("y", 149, X1, "vector_observation_1", m.load("c", _draw(1, 1, 1, 6)))

    yield _case("where", choose, rounded, vector_observation_1=other)

    def choose_pixels(m: Maker) -> str:
        bright = m.layer("bright", 140, X4, m.load("zero", 0.0))
        return m.layer("y", 149, bright, "row", X4)

    yield _case("where-image", choose_pixels, IMAGE, row=_draw(BATCH, 1, 1, 4))
    yield _case("sign", lambda m: m.layer("y", 150, X1), rounded)
    for kind in (*range(120, 130), 163, 164):
        for axis in (-1, 3, 2, 1):

            def along(m: Maker, kind: int = kind, axis: int = axis) -> str:
                return m.layer("y", kind, X4, axis=axis)

            yield _case(f"reduce-{kind}-{axis}", along, np.abs(IMAGE) + 0.1)

        def row_of(m: Maker, kind: int = kind) -> str:
            return m.layer("y", kind, X1, m.load("y/reduction_indices", 1.0))

        yield _case(f"reduce-{kind}-row", row_of, positive)
        if kind == 123:
            low = VECTOR.copy()
            low[0] = -np.inf
            yield _case("reduce-123-minus-infinity", row_of, low)
        yield _case(f"reduce-{kind}-eight", lambda m, kind=kind: m.layer("y", kind, X4, axis=6), np.abs(IMAGE), 18)


def _moves() -> Iterator[Case]:
    yield _case("nop", lambda m: m.layer("y", 0, X1), VECTOR)
    yield _case("dropout", lambda m: m.layer("y", 60, X1, alpha=0.5), VECTOR)
    yield _case("flatten", lambda m: m.layer("y", 200, X4), IMAGE)
    for target in ((-1, 1, 1, 140), (0, 7, 5, 4), (0, -1, 2, 7), (-1, 0, 0, 0), (0, 35, 1, 4)):
        yield _case(f"reshape-{'_'.join(map(str, target))}", lambda m, t=target: m.layer("y", 201, X4, pool=t), IMAGE)
    yield _case("reshape-eight", lambda m: m.layer("y", 201, X4, pool=(1, 1, -1, 1, 1, 7, 5, 4)), IMAGE, 17)
    yield _case("reshape-like", lambda m: m.layer("y", 201, X4, "like"), IMAGE, like=_draw(BATCH, 7, 5, 4))
    for order in ((0, 2, 1, 3), (0, 3, 1, 2), (0, 1, 2, 3)):
        name = "".join(map(str, order))
        yield _case(f"transpose-{name}", lambda m, o=order: m.layer("y", 202, X4, pool=o), IMAGE)
    yield _case("transpose-eight", lambda m: m.layer("y", 202, X4, pool=(0, 1, 2, 3, 4, 7, 5, 6)), IMAGE, 17)
    yield _case("squeeze", lambda m: m.layer("y", 203, X1), VECTOR)
    yield _case("unsqueeze", lambda m: m.layer("y", 204, X1), VECTOR)
    for axis, index in ((1, [4, 0, 0]), (2, [6, 1]), (3, [3, 2, 1, 0]), (-1, [1])):
        yield _case(
            f"gather-{axis}",
            lambda m, a=axis, i=index: m.layer("y", 205, X4, m.load("i", np.array(i)), axis=a),
            IMAGE,
        )
    picks = np.array([2.0, 0.0, 4.0], np.float32).reshape(BATCH, 1, 1, 1)
    yield _case("gather-rows", lambda m: m.layer("y", 205, m.load("table", _draw(5, 1, 1, 3)), X1, axis=0), picks)
    yield _case("expand", lambda m: m.layer("y", 208, X1, pool=(1, 2, 3, 6)), VECTOR, 17)
    yield _case("tile", lambda m: m.layer("y", 212, X4, pool=(1, 2, 1, 3)), IMAGE, 17)
    blocks = _draw(BATCH, 4, 6, 12)
    for mode in (0, 1):
        yield _case(f"depth-to-space-{mode}", lambda m, a=mode: m.layer("y", 206, X4, pool=(3, 2), axis=a), blocks, 17)
    yield _case("space-to-depth", lambda m: m.layer("y", 207, X4, pool=(3, 2)), blocks, 17)
    for axis, version, other in (
        (3, 16, (5, 7, 2)),
        (-1, 15, (5, 7, 2)),
        (1, 16, (2, 7, 4)),
        (2, 16, (5, 1, 4)),
        (7, 17, (5, 7, 2)),
        (6, 20, (5, 1, 4)),
        (5, 19, (2, 7, 4)),
    ):
        yield _case(
            f"concat-{axis}-{version}",
            lambda m, a=axis: (
                m.layer("y", 210, X4, "second", X4, axis=a)
                if a in (3, -1, 7)
                else m.layer("y", 210, X4, "second", axis=a)
            ),
            IMAGE,
            version,
            second=_draw(BATCH, *other),
        )
    yield _case("concat-rows", lambda m: m.layer("y", 210, X1, "more", X1, axis=3), VECTOR, more=_draw(BATCH, 1, 1, 2))
    yield _case("concat-one", lambda m: m.layer("y", 210, X1, axis=-1), VECTOR)
    for pad, pool, stride in (
        ((0, 0, 0, 0), (0, 0, 0, 3), (1, 1, 1, 1)),
        ((0, 0, 0, 2), (0, 0, 0, 0), (1, 1, 1, 1)),
        ((0, 0, 0, 1), (0, 0, 0, 1), (1, 1, 1, 0)),
        ((0, 0, 0, 0), (0, 0, 0, 0), (1, 1, 1, 0)),
        ((0, 0, 0, -2), (0, 0, 0, -1), (1, 1, 1, 1)),
        ((0, 1, 2, 0), (0, 4, 0, 2), (1, 1, 1, 1)),
        ((0, 0, 0, 0), (0, 4, 6, 0), (1, 2, 3, 1)),
    ):
        name = "-".join("".join(map(str, v)) for v in (pad, pool, stride))
        yield _case(
            f"slice{name}",
            lambda m, a=pad, b=pool, c=stride: m.layer("y", 211, X4, pad=a, pool=b, stride=c),
            IMAGE,
        )
    yield _case("slice-row", lambda m: m.layer("y", 211, X1, pad=(0, 0, 0, 3), pool=(0,) * 4, stride=(1,) * 4), VECTOR)
    eight = {"pad": (0,) * 7 + (1,), "pool": (0, 0, 0, 0, 0, 0, 4, 3), "stride": (1,) * 8}
    yield _case("slice-eight", lambda m: m.layer("y", 211, X4, **eight), IMAGE, 18)
    index = np.array([[0, 2], [3, 1], [1, 4]], np.float32).reshape(BATCH, 1, 1, 2)
    yield _case("one-hot", lambda m: m.layer("y", 67, X1, pool=(4,), alpha=2.0, beta=-1.0), index[..., :1])
    yield _case("one-hot-two", lambda m: m.layer("y", 67, X1, pool=(4,)), index)
    yield _case("one-hot-rank-1", lambda m: m.layer("y", 67, X1, pool=(4,), axis=1), index[..., :1], 18)
    yield _case("one-hot-rank-2", lambda m: m.layer("y", 67, X1, pool=(4,), axis=2), index, 18)

    def constants(m: Maker) -> str:
        m.layer("many", 255, data={"one": _draw(1, 1, 1, 6), "two": _draw(1, 1, 1, 1), "three": _draw(4, 1, 1, 6)})
        inner = m.layer("inner", 50, "one", activation=113)
        root = m.layer("root", 50, inner, activation=111)
        product = m.layer("product", 1, root, data={"k": _draw(6, 1, 1, 6), "b": _draw(1, 1, 1, 6)})
        scaled = m.layer("scaled", 102, product, "two")
        return m.layer("y", 100, X1, scaled)

    yield _case("constants", constants, VECTOR)


def all_cases() -> list[Case]:
    return [case for group in (_unary, _fused, _products, _windows, _arithmetic, _moves) for case in group()]
