"""ONNX ops that make images larger or smaller, or turn pixels into channels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn.resizing import Resampling, resample
from export_model.converters.graph.types import Dim

_IMAGE = 4


def _constant_operand(op: Op, net: Importer, position: int, meaning: str) -> np.ndarray | None:
    operand = op.get(position)
    if operand is None or 0 in net.shape(operand):
        return None
    return net.needed_constant(operand, meaning).astype(np.float64).reshape(-1)


def _resize(op: Op, net: Importer) -> str:
    """Scales are an input in opset 10, beside a region and sizes from 11 on; ``axes`` from 18 on."""
    x = op.need(0)
    old = op.opset < 11
    scales = _constant_operand(op, net, 1 if old else 2, "how much larger it gets")
    sizes = None if old else _constant_operand(op, net, 3, "how large it gets")
    given = op.integers("axes")
    axes = list(range(net.rank(x))) if given is None else [net.axis(x, a) for a in given]
    numbers = sizes if sizes is not None else scales
    if numbers is None or len(numbers) != len(axes):
        raise op.op_error("neither its scales nor its sizes fit its axes", "the model is damaged")
    coordinates = op.text("coordinate_transformation_mode", "asymmetric" if old else "half_pixel")
    region = _constant_operand(op, net, 1, "the region") if coordinates == "tf_crop_and_resize" else None
    dims = net.shape(x)
    policy = op.text("keep_aspect_ratio_policy", "stretch")
    if sizes is not None and policy != "stretch":
        ratios = [n / net.length(x, a) for n, a in zip(sizes, axes, strict=True)]
        ratio = min(ratios) if policy == "not_larger" else max(ratios)
        scales, sizes = np.full(len(axes), ratio), None
        numbers = np.array([np.floor(ratio * net.length(x, a) + 0.5) for a in axes])
    elif sizes is None:
        numbers = np.array([_scaled_length(dims[a], s) for a, s in zip(axes, numbers, strict=True)])
    told = None if sizes is not None else scales
    for i, axis in enumerate(axes):
        if region is None and _stays(dims[axis], numbers[i], None if told is None else told[i]):
            continue
        scale = numbers[i] / net.length(x, axis) if told is None else told[i]
        part = (0.0, 1.0) if region is None else (region[i], region[i + len(axes)])
        x = resample(net, x, axis, int(numbers[i]), float(scale), _resampling(op, coordinates, part))
    return x


def _resampling(op: Op, coordinates: str, region: tuple[float, float]) -> Resampling:
    return Resampling(
        mode=op.text("mode", "nearest"),
        coordinates=coordinates,
        nearest=op.text("nearest_mode", "floor" if op.opset < 11 else "round_prefer_floor"),
        cubic=op.number("cubic_coeff_a", -0.75),
        exclude_outside=bool(op.integer("exclude_outside", 0)),
        antialias=bool(op.integer("antialias", 0)),
        outside=op.number("extrapolation_value", 0.0),
        region=region,
    )


def _scaled_length(dim: Dim, scale: float) -> float:
    """The length that comes out, in float32 as onnxruntime: 5 times 1.4 is 7 there, 6.999… in float64."""
    return float(np.floor(np.float32(dim) * np.float32(scale))) if isinstance(dim, int) else scale


def _stays(dim: Dim, number: float, scale: float | None) -> bool:
    """Whether an axis keeps its length; the agents' must."""
    return scale == 1 if not isinstance(dim, int) and scale is not None else dim == number and scale in (None, 1)


def _upsample(op: Op, net: Importer) -> str:
    """The deprecated Resize of opsets 7 and 9, whose scales were an attribute before."""
    x = op.need(0)
    scales = op.attrs.get("scales") if op.opset < 9 else _constant_operand(op, net, 1, "how much larger it gets")
    if scales is None or len(scales) != net.rank(x):
        raise op.op_error("its scales do not fit its axes", "the model is damaged")
    how = Resampling(op.text("mode", "nearest"), "asymmetric", "floor")
    for axis, scale in enumerate(scales):
        if scale != 1:
            x = resample(net, x, axis, int(_scaled_length(net.length(x, axis), scale)), float(scale), how)
    return x


# ------------------------------------------------------------------ pixels and channels


def _depth_to_space(op: Op, net: Importer) -> str:
    """[N, C·b², H, W] to [N, C, H·b, W·b]; mode DCR: the block's place comes first among the channels, CRD: last."""
    x, size = op.need(0), op.integer("blocksize", 0)
    n, channels, height, width = _blocks(op, net, x, size)
    if channels % (size * size):
        raise op.op_error(f"it parts {channels} channels into blocks of {size}×{size}", "the model is damaged")
    deep = channels // (size * size)
    if op.text("mode", "DCR") == "DCR":
        parted, order = net.reshape(x, (n, size, size, deep, height, width)), (0, 3, 4, 1, 5, 2)
    else:
        parted, order = net.reshape(x, (n, deep, size, size, height, width)), (0, 1, 4, 2, 5, 3)
    return net.reshape(net.transpose(parted, order), (n, deep, height * size, width * size))


def _space_to_depth(op: Op, net: Importer) -> str:
    """[N, C, H, W] to [N, b²·C, H/b, W/b], the block's place first."""
    x, size = op.need(0), op.integer("blocksize", 0)
    n, channels, height, width = _blocks(op, net, x, size)
    if height % size or width % size:
        raise op.op_error(f"{height}×{width} pixels do not part into blocks of {size}", "the model is damaged")
    parted = net.reshape(x, (n, channels, height // size, size, width // size, size))
    order = (0, 3, 5, 1, 2, 4) if op.text("mode", "DCR") == "DCR" else (0, 1, 3, 5, 2, 4)
    return net.reshape(net.transpose(parted, order), (n, channels * size * size, height // size, width // size))


def _blocks(op: Op, net: Importer, x: str, size: int) -> tuple[Dim, int, int, int]:
    if net.rank(x) != _IMAGE or size < 1:
        raise op.op_error(f"it makes blocks of {size} in {net.rank(x)} axes", "the model is damaged")
    return net.shape(x)[0], net.length(x, 1), net.length(x, 2), net.length(x, 3)


OPS: Mapping[str, Translate] = {
    "Resize": _resize,
    "Upsample": _upsample,
    "DepthToSpace": _depth_to_space,
    "SpaceToDepth": _space_to_depth,
}
