"""Which stored arrays are whose: each layer's in the order in which Keras makes them, whatever file they lie in.

A ``.keras`` has a group per layer, called by class and number (``layers/dense_1/vars/0``: saving_lib.py of Keras 3). An
``.h5`` and a TensorFlow.js model have lists of names in which the layer's is a part (``lstm/cell/kernel``).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from export_model.converters.formats.keras.model import KerasLayer, cells_of

Arrays = tuple[np.ndarray, ...]
#: Under which names the parts of a layer lie, in the order in which Keras makes them; "_" may stand before each.
_PARTS = (
    *("cell", "forward_layer", "backward_layer", "layer"),
    *("query_dense", "key_dense", "value_dense", "output_dense"),
)
#: The folders that hold a model's layers; the second in Keras 2.12 and 2.13.
_FOLDERS = ("layers", "_layer_checkpoint_dependencies")


class KerasWeights(Protocol):
    """The arrays of a layer, or of the layers of a model."""

    def arrays(self, layer: KerasLayer) -> Arrays:
        """All of a layer's."""

    def among(self, layers: Sequence[KerasLayer]) -> Mapping[str, KerasWeights]:
        """Those of each layer of a model, by its name."""


class Groups:
    """The groups of a ``.keras``: path → array."""

    def __init__(self, stored: Mapping[str, np.ndarray]) -> None:
        self.stored = stored

    def arrays(self, layer: KerasLayer) -> Arrays:
        """The layer's own, then those of its parts."""
        return tuple(self._own([x.kind for x in cells_of(layer)])) if self.stored else ()

    def _own(self, cells: Sequence[str]) -> list[np.ndarray]:
        if not self.stored:
            return []
        own = sorted((int(k[5:]), a) for k, a in self.stored.items() if re.fullmatch(r"vars/\d{1,4}", k))
        found = [a for _, a in own]
        for part in (*_PARTS, *(f"cells/{name}" for name in _group_names(cells))):
            for name in (part, f"_{part}"):
                found += self._inside(name)._own(cells)
        return found

    def _inside(self, path: str) -> Groups:
        return Groups({k.removeprefix(f"{path}/"): a for k, a in self.stored.items() if k.startswith(f"{path}/")})

    def among(self, layers: Sequence[KerasLayer]) -> Mapping[str, KerasWeights]:
        """See Weights; layers of one class are numbered in the order of the configuration."""
        folder = next((f for f in _FOLDERS if any(k.startswith(f"{f}/") for k in self.stored)), _FOLDERS[0])
        inside, held = self._inside(folder), [x for x in layers if not x.operation]
        names = _group_names([x.kind for x in held])
        return {layer.name: inside._inside(name) for layer, name in zip(held, names, strict=True)}


def _group_names(kinds: Sequence[str]) -> list[str]:
    """What the groups of several objects of these classes are called."""
    seen, names = Counter[str](), []
    for name in map(_snake_case, kinds):
        names.append(f"{name}_{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return names


def _snake_case(name: str) -> str:
    """``Conv2DTranspose`` as conv2d_transpose, ``PReLU`` as p_re_lu: what groups are called."""
    return re.sub(r"(?<=.)(?=[A-Z][a-z])|(?<=[a-z])(?=[A-Z])", "_", name).lower()


class Listed:
    """Arrays under names with slashes, in their order; ``owners`` says which layer's each is, where the file does."""

    def __init__(self, entries: Sequence[tuple[str, np.ndarray]], owners: Sequence[str] = ()) -> None:
        self.entries, self.owners = entries, owners

    def arrays(self, layer: KerasLayer) -> Arrays:
        """All of them."""
        return tuple(array for _, array in self.entries)

    def among(self, layers: Sequence[KerasLayer]) -> Mapping[str, KerasWeights]:
        """See Weights."""
        if self.owners:
            owned = list(zip(self.owners, self.entries, strict=True))
            return {x.name: Listed([e for owner, e in owned if owner == x.name]) for x in layers}
        found = {x.name: Listed([e for e in self.entries if f"/{x.name}/" in f"/{e[0]}"]) for x in layers}
        # The layers of a model inside another may be named without it.
        return {x.name: found[x.name] if found[x.name].entries or x.model is None else self for x in layers}
