"""Images with structure: what a convolution, a pooling or a change of layout may get wrong and noise does not show."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

#: Rows, columns and channels of one image → its pixels, from 0 to 1.
Picture: TypeAlias = "Callable[[np.random.Generator, np.ndarray, np.ndarray, np.ndarray], np.ndarray]"


def structured_images(rng: np.random.Generator, shape: tuple[int, ...], *, first: int = 0) -> np.ndarray:
    """Images of the kinds in turn from ``first`` on, float [B, …], in 0..1.

    Which axis is that of the channels is told by its size: the last, or the first of an image that is higher than it
    is long there.
    """
    made = rng.random(shape)
    if len(shape) != 4:
        return made
    planes_first = shape[1] < min(shape[2:]) and shape[3] > 4
    turned = np.moveaxis(made, 1, -1) if planes_first else made  # a view
    for number, image in enumerate(turned):
        rows, columns, channels = np.ogrid[tuple(slice(n) for n in image.shape)]
        height, width, depth = image.shape
        x, y = columns / max(1, width - 1), rows / max(1, height - 1)
        image[:] = _KINDS[(first + number) % len(_KINDS)](rng, y, x, channels / max(1, depth))
    return made


def _object(rng: np.random.Generator, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Where a rectangle is, of a fifth to a half of each side."""
    top, left = rng.uniform(0, 0.5, 2)
    tall, wide = rng.uniform(0.2, 0.5, 2)
    return np.asarray((y >= top) & (y <= top + tall) & (x >= left) & (x <= left + wide))


def _blob(rng: np.random.Generator, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    middle = rng.random(2)
    return np.asarray(np.exp(-8 * ((y - middle[0]) ** 2 + (x - middle[1]) ** 2)))


def _noise(rng: np.random.Generator, y: np.ndarray, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    return rng.random(np.broadcast_shapes(y.shape, x.shape, c.shape))


#: Each differs from its mirror images, or is the mirror image of another.
_KINDS: tuple[Picture, ...] = (
    lambda rng, y, x, c: _noise(rng, y, x, c) * (x >= 0.5),  # the left half is black
    lambda rng, y, x, c: y + 0 * x + 0 * c,  # brighter from top to bottom
    lambda rng, y, x, c: 0.1 + 0.8 * _object(rng, y, x) + 0 * c,  # one bright object
    lambda rng, y, x, c: _noise(rng, y, x, c) * (c == 0),  # the first channel alone
    lambda rng, y, x, c: _noise(rng, y, x, c) * (y >= 0.5),  # the upper half is black
    lambda rng, y, x, c: x + 0 * y + 0 * c,  # brighter from left to right
    lambda rng, y, x, c: _blob(rng, y, x) + 0 * c,  # a bright spot, smooth
    lambda rng, y, x, c: _noise(rng, y, x, c) * (c == c.max()),  # the last channel alone
    lambda rng, y, x, c: _noise(rng, y, x, c) * (x < 0.5),  # the right half is black
    lambda rng, y, x, c: 0.5 + 0.5 * np.sin(9 * x + 5 * y) + 0 * c,  # waves, smooth
    lambda rng, y, x, c: 0.9 - 0.8 * _object(rng, y, x) + 0 * c,  # one dark object
    lambda rng, y, x, c: 0.2 + 0.7 * c + 0 * x + 0 * y,  # one colour
    lambda rng, y, x, c: _noise(rng, y, x, c) * (y < 0.5),  # the lower half is black
    lambda rng, y, x, c: 0.5 + 0.02 * _noise(rng, y, x, c),  # hardly any contrast
    lambda rng, y, x, c: ((x == rng.choice(x.ravel())) & (y == rng.choice(y.ravel()))) + 0.0 * c,  # one pixel
    lambda rng, y, x, c: (1 - x) * _object(rng, y, x) * (1 - c),  # an object that fades and has a colour
)
