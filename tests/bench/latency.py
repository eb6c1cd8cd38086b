"""``python -m tests.bench.latency``: how fast our ONNX and TensorFlow.js models run beside those of the official tools.

Both sides are made of the same graph and give the same outputs: tf2onnx is given our ``.bytes``, tensorflowjs_converter
our SavedModel. They are called in turn in one process with one thread; a ratio below 1 says that ours is faster.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

from tests.peers.environment import Peers, PeersUnavailableError, ensure_peers

ROOT = Path(__file__).resolve().parents[2]
JS = ROOT / "converters/runtimes/javascript/js"
POLICIES = ("continuous", "discrete", "recurrent", "visual")
BATCHES = (1, 64)
BACKENDS = ("cpu", "wasm")
#: Calls of a side before the other's turn.
_CALLS = 20


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.latency", description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=60, help="turns of each side")
    options = parser.parse_args()
    try:
        peers = ensure_peers()
    except PeersUnavailableError as error:
        print(f"not measured: {error}")
        return 0
    heads = [*(f"onnxruntime {b}" for b in BATCHES), *(f"{k} {b}" for k in BACKENDS for b in BATCHES)]
    print("our time / theirs (tf2onnx in onnxruntime; tensorflowjs_converter in TensorFlow.js), by batch")
    print(f"{'':12}" + "".join(f"{h:>16}" for h in heads), flush=True)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for policy in POLICIES:
            rows.append(list(ratios(policy, options.rounds, peers, Path(scratch)).values()))
            print(f"{policy:12}" + "".join(f"{r:>16.2f}" for r in rows[-1]), flush=True)
    means = [math.exp(sum(map(math.log, column)) / len(column)) for column in zip(*rows, strict=True)]
    print(f"{'geom. mean':12}" + "".join(f"{m:>16.2f}" for m in means))
    return 0


def ratios(policy: str, rounds: int, peers: Peers, scratch: Path) -> dict[str, float]:
    """Runtime and batch → our time in theirs."""
    from exporter import export_model

    (bundle,) = export_model(ROOT / "fixtures" / f"{policy}.bytes", scratch, verify="none")
    inputs, outputs = (
        ",".join(f"{s.name}:0" for s in side)
        for side in (bundle.policy.signature.inputs, bundle.policy.signature.outputs)
    )
    onnx, tfjs = bundle.folder / "theirs.onnx", bundle.folder / "theirs"
    source = str(bundle.folder / f"{policy}.bytes")
    peers.run([*peers.tf2onnx(), "--graphdef", source, "--inputs", inputs, "--outputs", outputs, "--output", str(onnx)])
    saved = str(bundle.folder / "saved_model")
    peers.run([*peers.tensorflowjs_converter(), "--input_format=tf_saved_model", saved, str(tfjs)])
    found = {}
    for batch in BATCHES:
        found[f"onnxruntime {batch}"] = in_onnxruntime(bundle.folder / f"{policy}.onnx", onnx, batch, rounds)
    for backend in BACKENDS:
        for batch in BATCHES:
            found[f"{backend} {batch}"] = in_tfjs(backend, bundle.folder / "tfjs", tfjs, batch, rounds)
    return found


def in_onnxruntime(ours: Path, theirs: Path, batch: int, rounds: int) -> float:
    """Our time in theirs, one thread."""
    calls = [_call(path, batch) for path in (ours, theirs)]
    times: list[list[float]] = [[], []]
    for number in range(-10, rounds):
        for side, call in zip(times, calls, strict=True):
            begin = time.process_time()
            for _ in range(_CALLS):
                call()
            if number >= 0:
                side.append(time.process_time() - begin)
    return median(times[0]) / median(times[1])


def _call(path: Path, batch: int) -> Callable[[], object]:
    import numpy as np
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
    kinds: Mapping[str, type] = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(int64)": np.int64}
    feeds = {
        i.name: np.full([n if isinstance(n, int) else batch for n in i.shape], 0.5).astype(kinds[i.type])
        for i in session.get_inputs()
    }
    return lambda: session.run(None, feeds)


def in_tfjs(backend: str, ours: Path, theirs: Path, batch: int, rounds: int) -> float:
    """Our time in theirs, in one Node."""
    script = Path(__file__).with_suffix(".mjs")
    command = ["node", script, JS / "tfjs_node.mjs", JS, backend, str(batch), str(rounds), ours, theirs]
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=True)
    mine, other = json.loads(done.stdout.strip().splitlines()[-1])
    return float(mine / other)


if __name__ == "__main__":
    sys.exit(main())
