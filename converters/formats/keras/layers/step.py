"""One call of a layer: what its function is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from export_model.converters.formats.keras.model import KerasLayer
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError

if TYPE_CHECKING:
    from export_model.converters.formats.keras.network import KerasNetwork

Translate = Callable[["Step"], "str | Sequence[str]"]


class Step:
    """A layer's settings, weights and arguments; ``left`` are the weights that were not taken yet."""

    def __init__(
        self,
        net: KerasNetwork,
        layer: KerasLayer,
        arrays: Sequence[np.ndarray],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        path: str = "",
    ) -> None:
        self.net, self.layer, self.args, self.kwargs, self.path = net, layer, list(args), dict(kwargs or {}), path
        self.left = [*arrays]
        #: settings and named arguments that were asked for
        self.asked: set[str] = set()

    def inner(self, layer: KerasLayer, args: Sequence[Any], arrays: Sequence[np.ndarray]) -> Step:
        """A call of a layer that this one wraps."""
        return Step(self.net, layer, arrays, args, {}, f"{self.path}/{layer.name}")

    def get(self, key: str, default: Any = None) -> Any:
        """A setting."""
        self.asked.add(key)
        return self.layer.config.get(key, default)

    def refuse_unless(self, key: str, *values: Any) -> None:
        """Raise UnsupportedOpError where a setting is none of these, or is not said."""
        if self.get(key, values[0]) not in values:
            raise UnsupportedOpError(f"its {key} is {str(self.get(key))[:80]!r}")

    @property
    def is_keras_3(self) -> bool:
        """Whether the formulas of Keras 3 hold, where they are others."""
        return self.net.version.startswith("3")

    @property
    def is_tfjs(self) -> bool:
        """Whether TensorFlow.js wrote it, whose defaults are others."""
        return self.net.version.startswith("tfjs")

    def damaged_error(self, what: str, why: str | None = None) -> DamagedFileError:
        """The error of a layer that cannot be what its file says."""
        return DamagedFileError(f"the layer {self.path!r} {what}", why=why, fix="save the model again")

    # ------------------------------------------------------------------ tensors

    @property
    def tensors(self) -> list[str]:
        """The tensors that it is given, lists of them written out."""
        return [t for a in self.args for t in (a if isinstance(a, list) else [a]) if isinstance(t, str)]

    @property
    def x(self) -> str:
        """The one tensor that it is given, the first of several."""
        if not self.tensors:
            raise self.damaged_error("is given no tensor")
        return self.tensors[0]

    @property
    def rank(self) -> int:
        """The number of axes of x."""
        return self.net.rank(self.x)

    # ------------------------------------------------------------------ weights

    def take(self, *shape: int | None) -> np.ndarray:
        """The next weight, float32. Raises DamagedFileError where there is none, or not of this shape."""
        if not self.left:
            raise self.damaged_error("has too few weights")
        array = self.left.pop(0)
        fits = len(shape) == array.ndim and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
        if shape and not fits:
            raise DamagedFileError(
                f"a weight of the layer {self.path!r} has the shape {list(array.shape)}",
                why=f"{['any' if n is None else n for n in shape]} fits its settings and what it reads",
                fix="save the model again",
            )
        return array.astype(FLOAT32)

    def unread_settings(self) -> list[str]:
        """Settings and named arguments that say something and were never asked for."""
        given = {**self.layer.config, **self.kwargs}
        known = {*self.asked, "name", "trainable"}
        return [f"{k}={str(v)[:60]}" for k, v in given.items() if k not in known and v is not None and v is not False]

    def add_bias(self, value: str, width: int | None) -> str:
        """``value`` plus the next weight, where the layer has a bias."""
        if not self.get("use_bias", True):
            return value
        return self.net.add("BiasAdd", [value, self.net.const(self.take(width), "bias")])
