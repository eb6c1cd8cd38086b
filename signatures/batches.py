"""Any number of agents for what takes a fixed number of them at a time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from export_model.signatures.spec import PolicySignature

Arrays = Mapping[str, npt.NDArray[Any]]
#: Outputs by name, for feeds and the outputs that are asked for.
Run = Callable[[Arrays, Sequence[str]], dict[str, npt.NDArray[Any]]]


def batches_of(feeds: Arrays, size: int, batched: Collection[str]) -> list[dict[str, npt.NDArray[Any]]]:
    """``feeds`` in parts of ``size`` agents, the last agent repeated to fill the last.

    ``batched`` are those that have the agents' axis.
    """
    rows = rows_of(feeds, batched)
    parts = max(1, -(-rows // size))
    order = np.minimum(np.arange(parts * size), max(rows - 1, 0)).reshape(parts, size)
    return [{n: a[chosen] if n in batched else a for n, a in feeds.items()} for chosen in order]


def rows_of(feeds: Arrays, batched: Collection[str]) -> int:
    """How many agents are fed."""
    return next((len(array) for name, array in feeds.items() if name in batched), 1)


def put_together(answers: Sequence[Arrays], rows: int) -> dict[str, npt.NDArray[Any]]:
    """What the parts answered, for ``rows`` agents."""
    return {name: np.concatenate([a[name] for a in answers])[:rows] for name in answers[0]}


def in_batches(run: Run, size: int | None, signature: PolicySignature) -> Run:
    """``run`` for any number of agents, where it takes ``size`` at a time (None: any)."""
    if size is None:
        return run
    batched = {s.name for s in signature.inputs if s.batched}
    return lambda feeds, fetch: put_together(
        [run(part, fetch) for part in batches_of(feeds, size, batched)], rows_of(feeds, batched)
    )
