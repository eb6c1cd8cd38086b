"""``python -m tests.bench.litert``: our .tflite files in LiteRT beside those of TensorFlow's converter.

Both are made of the same policy (the converter is given our SavedModel), and called for all outputs in turn, in one
process with one thread; the processor's time is measured, and a ratio below 1 says that ours is faster.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path

POLICIES = ("continuous", "discrete", "recurrent", "visual")
BATCHES = (1, 64)
_CALLS, _ROUNDS = 40, 25


def _files(name: str, folder: Path) -> tuple[Path, Path]:
    """(ours, theirs)."""
    import tensorflow as tf

    (made,) = export([path(name)], ExportOptions(folder, ("litert", "saved_model"), verify="none"))
    theirs = folder / f"{name}.tflite"
    theirs.write_bytes(tf.lite.TFLiteConverter.from_saved_model(str(made.folder / "saved_model")).convert())
    return made.folder / theirs.name, theirs


def _runner(file: Path, batch: int) -> Any:
    """A call of the file's signature with rows of 0.5."""
    from ai_edge_litert.interpreter import Interpreter

    runner = Interpreter(str(file), num_threads=1).get_signature_runner("serving_default")
    shapes = {name: d["shape_signature"] for name, d in runner.get_input_details().items()}
    dtypes = {name: d["dtype"] for name, d in runner.get_input_details().items()}
    feeds = {n: np.full([batch if d < 0 else d for d in s], 0.5).astype(dtypes[n]) for n, s in shapes.items()}
    return lambda: runner(**feeds)


def _seconds(call: Any) -> float:
    begun = time.process_time()
    for _ in range(_CALLS):
        call()
    return time.process_time() - begun


def main() -> int:
    """Print the ratios, and their geometric mean."""
    os.environ.update(TF_CPP_MIN_LOG_LEVEL="3", CUDA_VISIBLE_DEVICES="")
    ratios = []
    print("our time / that of TensorFlow's converter, in LiteRT: policy, batch, bytes of both, ratio")
    with tempfile.TemporaryDirectory() as scratch:
        for name in POLICIES:
            files = _files(name, Path(scratch))
            sizes = [file.stat().st_size for file in files]
            for batch in BATCHES:
                ours, theirs = (_runner(file, batch) for file in files)
                pairs = [(_seconds(ours), _seconds(theirs)) for _ in range(_ROUNDS)]
                ratios.append(median(a / b for a, b in pairs[1:]))
                print(f"{name:12}{batch:4}{sizes[0]:8,}{sizes[1]:8,}{ratios[-1]:8.2f}", flush=True)
    print(f"geometric mean {math.exp(sum(map(math.log, ratios)) / len(ratios)):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
