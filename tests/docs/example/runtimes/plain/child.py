"""Runs a policy's steps, an agent at a time: ``python -m export_model.converters.runtimes.plain.child``."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.children.child import claim_stdout, serve
from export_model.converters.files.children.frames import Tensors

_ARITHMETIC: Mapping[str, Callable[..., float]] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "larger": max,
    "smaller": min,
    "tanh": math.tanh,
    "sigmoid": lambda a: 1 / (1 + math.exp(-a)) if a > 0 else math.exp(a) / (1 + math.exp(a)),
    "relu": lambda a: max(a, 0.0),
    "square": lambda a: a * a,
    "squared_difference": lambda a, b: (a - b) ** 2,
    "same": lambda a: a,
}


class _Steps:
    def __init__(self, path: str) -> None:
        self.steps: list[dict[str, Any]] = json.loads(Path(path).read_text(encoding="utf-8"))["steps"]

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        """The answers for all agents: the row of each, computed alone."""
        agents = len(next(iter(feeds.values())))
        rows = [self.act({name: array[i].tolist() for name, array in feeds.items()}) for i in range(agents)]
        return {name: np.array([row[name] for row in rows], np.float32) for name in fetch}

    def act(self, values: dict[str, list[float]]) -> dict[str, list[float]]:
        """The numbers of every step, for the observation of one agent."""
        for step in self.steps:
            operands = [values[name] for name in step.get("of", ())]
            if step["do"] == "numbers":
                values[step["name"]] = step["numbers"]
            elif step["do"] == "product":
                columns = zip(*step["kernel"], strict=True)
                values[step["name"]] = [math.fsum(map(float.__mul__, operands[0], column)) for column in columns]
            elif step["do"] != "input":
                width = max(map(len, operands))
                wide = [row * width if len(row) == 1 else row for row in operands]
                values[step["name"]] = list(map(_ARITHMETIC[step["do"]], *wide))
        return values


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    serve("plain", platform.python_version(), lambda header: _Steps(header["path"]), (ArithmeticError,), out)


if __name__ == "__main__":
    main()
