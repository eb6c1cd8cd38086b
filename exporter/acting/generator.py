"""The generator that draws actions, the same in Python and in policy.mjs: one seed, the same actions everywhere.

sfc32 (Chris Doty-Humphrey's Small Fast Counting generator, PractRand 0.9x, 32 bits), because it needs nothing but
additions, shifts and rotations of 32 bits, which JavaScript has. The seed goes through splitmix32's finaliser.
"""

from __future__ import annotations

import math

import numpy as np

from signatures.errors import UsageError

_MASK = 0xFFFFFFFF
#: The largest seed that a JavaScript number holds exactly.
MAX_SEED = 2**53 - 1


class Generator:
    """Uniform and normal draws; the state is four words of 32 bits."""

    def __init__(self, seed: int) -> None:
        if not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
            raise UsageError(f"the seed is {seed}", fix=f"give a whole number from 0 to {MAX_SEED}")
        low, high = _mixed(seed & _MASK), _mixed((seed >> 32) ^ 0x9E3779B9)
        self._a, self._b, self._c, self._counter = low, high, low ^ high, 1
        for _ in range(12):  # until every bit of the seed is in every word
            self._word()

    def _word(self) -> int:
        result = (self._a + self._b + self._counter) & _MASK
        self._counter = (self._counter + 1) & _MASK
        self._a = self._b ^ (self._b >> 9)
        self._b = (self._c + (self._c << 3)) & _MASK
        self._c = (((self._c << 21) | (self._c >> 11)) + result) & _MASK
        return result

    def uniform(self) -> float:
        """In [0, 1), with all 53 bits."""
        high, low = self._word() >> 5, self._word() >> 6
        return (high * 67108864 + low) / 9007199254740992

    def normal(self) -> float:
        """N(0, 1), by Box and Muller; two uniform draws for each."""
        radius = math.sqrt(-2 * math.log(1 - self.uniform()))
        return radius * math.cos(2 * math.pi * self.uniform())

    def normals(self, shape: tuple[int, ...]) -> np.ndarray:
        """float32 draws of N(0, 1) in C order."""
        return np.array([self.normal() for _ in range(math.prod(shape))], np.float32).reshape(shape)

    def choice(self, log_probs: np.ndarray) -> int:
        """An index of ``log_probs`` ([n], unnormalised will do), by its probability; one uniform draw."""
        wide = [float(v) for v in log_probs]
        best = max(wide)
        if not best > -math.inf:
            raise UsageError(
                f"nothing can be drawn from the log-probabilities {wide}",
                fix="allow an action of every branch in masks, and give observations that are numbers",
            )
        weights = [math.exp(v - best) if v > -math.inf else 0.0 for v in wide]
        left = self.uniform() * sum(weights)
        for index, weight in enumerate(weights):
            left -= weight
            if left < 0:
                return index
        return max(i for i, weight in enumerate(weights) if weight > 0)


def _mixed(word: int) -> int:
    word = ((word ^ (word >> 16)) * 0x21F0AAAD) & _MASK
    word = ((word ^ (word >> 15)) * 0x735A2D97) & _MASK
    return word ^ (word >> 15)
