"""The inputs that the page tries in the visitor's browser, and what is right: the numpy kernels' answers.

``golden.json`` says what lies where in ``golden.bin`` (little-endian, C order, each tensor on a multiple of 4):

- ``cases``: name, ``rows``, ``inputs`` and ``outputs`` (name, dtype, shape, offset in bytes). A case that ``continues``
  takes its memory from the answer to the one before, not from the file.
- ``tolerance``: per output, |a − b| ≤ atol + rtol·|b|. Integers must be equal, but for the indices in ``ties``.

Left out are outputs that a sampler inside the graph decides, and inputs so large that float32's own rounding shows
(those are verified with an account of that rounding, which a page has not).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Graph
from export_model.exporter.verify.difference import floor_log_probs, ties
from export_model.exporter.verify.reference import random_outputs
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, Case, draw_cases, draw_rollout
from export_model.signatures.spec import PolicySignature

SEED = 0
_STEPS = 4
_TOO_LARGE = ("beyond the clip", "1e3", *FAR_CASES)
#: Inputs with images are large; those that do not fit are left out, but never the first three (batches of 1, 2 and 7).
_MOST_BYTES = 4_000_000
#: A page plays a dozen agents: the large batch of a verification is left out.
_MOST_ROWS = 64
_STORED = {"int64": "int32", "bool": "uint8"}


def golden(signature: PolicySignature, graph: Graph) -> tuple[dict[str, Any], bytes]:
    """golden.json and golden.bin for the policy of ``graph``, which the numpy kernels run."""
    from export_model.converters.graph.run import run_graph

    drawn = random_outputs(graph, [s.name for s in signature.outputs])
    names = [s.name for s in signature.outputs if s.name not in drawn]
    book = _Book(signature)
    kept = [
        c for c in draw_cases(signature, seed=SEED, samples=1) if c.name not in _TOO_LARGE and c.batch <= _MOST_ROWS
    ]
    for number, case in enumerate(kept):
        if number >= 3 and len(book.data) + sum(a.nbytes for a in case.feeds.values()) > _MOST_BYTES:
            continue
        book.add(case, run_graph(graph, case.feeds, names))
    if signature.recurrence is not None:
        fed, fed_back = signature.recurrence
        last: Mapping[str, np.ndarray] | None = None
        for step, feeds in enumerate(draw_rollout(signature, seed=SEED, steps=_STEPS), 1):
            given = feeds if last is None else {**feeds, fed: last[fed_back]}
            answers = run_graph(graph, given, names)
            book.add(Case(f"memory fed back, step {step}", given, 2), answers, continues=last is not None)
            last = answers
    tolerance = {n: tolerance_for(signature, n, Tolerance()) for n in names}
    said = {n: {"atol": t.atol, "rtol": t.rtol, "reason": t.reason} for n, t in tolerance.items()}
    left_out = [s.name for s in signature.outputs if s.name in drawn]
    return {"seed": SEED, "cases": book.cases, "tolerance": said, "left_out": left_out}, bytes(book.data)


class _Book:
    def __init__(self, signature: PolicySignature) -> None:
        self.signature = signature
        self.cases: list[dict[str, Any]] = []
        self.data = bytearray()

    def add(self, case: Case, answers: Mapping[str, np.ndarray], *, continues: bool = False) -> None:
        scored = (s.name for s in self.signature.outputs if s.role in (Role.LOG_PROBS, Role.PROBS))
        scores = next((answers[name] for name in scored if name in answers), None)
        outputs = []
        for spec in self.signature.outputs:
            if spec.name not in answers:
                continue
            value = answers[spec.name]
            branches = self.signature.branches
            if spec.role is Role.LOG_PROBS and value.ndim and value.dtype.kind == "f":
                value = floor_log_probs(value, branches)
            entry = self._tensor(spec.name, value)
            if spec.role is Role.LOG_PROBS:
                entry["floored"] = list(branches) if sum(branches) == value.shape[-1] else [value.shape[-1]]
            if spec.role is Role.DETERMINISTIC and value.dtype.kind != "f" and branches and scores is not None:
                open_ = ties(scores, branches, Tolerance())
                if open_.shape == value.shape and open_.any():
                    entry["ties"] = [int(i) for i in np.flatnonzero(open_)]
            outputs.append(entry)
        inputs = [self._tensor(s.name, case.feeds[s.name]) for s in self.signature.inputs]
        self.cases.append(
            {"name": case.name, "rows": case.batch, "continues": continues, "inputs": inputs, "outputs": outputs}
        )

    def _tensor(self, name: str, value: np.ndarray) -> dict[str, Any]:
        dtype = value.dtype.name
        stored = value.astype(_STORED.get(dtype, dtype)).astype("<" + np.dtype(_STORED.get(dtype, dtype)).str[1:])
        offset = len(self.data)
        self.data += stored.tobytes()
        self.data += bytes(-len(self.data) % 4)
        return {"name": name, "dtype": dtype, "shape": list(value.shape), "offset": offset}
