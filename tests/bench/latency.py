"""``python -m tests.bench.latency``: how fast our ONNX and TensorFlow.js models run beside those of the official tools.

Both sides are made of the same graph and give the same outputs: tf2onnx is given our ``.bytes``, tensorflowjs_converter
our SavedModel. "loops" is the recurrent policy once more, the official tools given the source as it was trained, with
its while loop, for the outputs that both have. Sides are called in turn in one process with one thread, and it is the
processor's time that is measured (in WebGL the clock's); a ratio below 1 says that ours is faster.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from tests.peers.environment import Peers, PeersUnavailableError, ensure_peers

ROOT = Path(__file__).resolve().parents[2]
JS = ROOT / "converters/runtimes/javascript/js"
POLICIES = ("continuous", "discrete", "recurrent", "visual", "loops")
BATCHES = (1, 64)
RUNTIMES = ("onnxruntime", "cpu", "wasm", "webgl")
#: Calls of a side before the other's turn.
_CALLS = 20


@dataclass(frozen=True)
class Side:
    """One tool's files, and what is fetched of them."""

    onnx: Path
    tfjs: Path
    outputs: Sequence[str]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.latency", description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=60, help="turns of each side")
    parser.add_argument("--policies", default=",".join(POLICIES), help="of these, by commas")
    parser.add_argument("--runtimes", default=",".join(RUNTIMES[:3]), help="of these and webgl, by commas")
    options = parser.parse_args()
    try:
        peers = ensure_peers()
    except PeersUnavailableError as error:
        print(f"not measured: {error}")
        return 0
    cells = [(r, b) for r in options.runtimes.split(",") for b in BATCHES]
    print("our time / theirs (tf2onnx in onnxruntime; tensorflowjs_converter in TensorFlow.js), smallest and median of")
    print(f"{options.rounds} rounds, by runtime and batch")
    print(f"{'':12}" + "".join(f"{f'{r} {b}':>16}" for r, b in cells), flush=True)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for policy in options.policies.split(","):
            sides = made(policy, peers, Path(scratch) / policy)
            print(f"{policy:12}", end="", flush=True)
            row = []
            for runtime, batch in cells:
                row.append(ratios(runtime, sides, batch, options.rounds))
                print(f"{'{:.2f} {:.2f}'.format(*row[-1]):>16}", end="", flush=True)
            print()
            if policy != "loops":
                rows.append(row)
    if rows:
        means = [
            [math.exp(sum(map(math.log, c)) / len(c)) for c in zip(*cell, strict=True)]
            for cell in zip(*rows, strict=True)
        ]
        print(f"{'geom. mean':12}" + "".join(f"{'{:.2f} {:.2f}'.format(*m):>16}" for m in means))
    return 0


def made(policy: str, peers: Peers, scratch: Path) -> tuple[Side, Side]:
    """Our files and theirs."""
    from tests.exporting import export_model

    source = ROOT / "fixtures" / f"{policy.replace('loops', 'recurrent')}.bytes"
    (bundle,) = export_model(source, scratch, verify="none")
    signature = bundle.policy.signature
    specs = [s for s in signature.outputs if policy != "loops" or s.source]
    onnx, tfjs = bundle.folder / "theirs.onnx", bundle.folder / "theirs"
    if policy == "loops":
        inputs, given = _placeholders(source), [str(s.source) for s in specs]
        names = ",".join(o.split(":")[0] for o in given)
        command = ["--input_format=tf_frozen_model", f"--output_node_names={names}", str(source), str(tfjs)]
    else:
        source = bundle.folder / source.name
        inputs, given = [f"{s.name}:0" for s in signature.inputs], [f"{s.name}:0" for s in specs]
        command = ["--input_format=tf_saved_model", str(bundle.folder / "saved_model"), str(tfjs)]
    wanted = ["--inputs", ",".join(inputs), "--outputs", ",".join(given), "--output", str(onnx)]
    peers.run([*peers.tf2onnx(), "--graphdef", str(source), *wanted])
    peers.run([*peers.tensorflowjs_converter(), *command])
    ours = Side(bundle.folder / f"{bundle.policy.name}.onnx", bundle.folder / "tfjs", [s.name for s in specs])
    return ours, Side(onnx, tfjs, given)


def _placeholders(source: Path) -> list[str]:
    from export_model.converters.files import tensorflow_messages as schema

    message = schema.GraphDef()
    message.ParseFromString(source.read_bytes())
    return [f"{n.name}:0" for n in message.node if n.op == "Placeholder"]


def ratios(runtime: str, sides: tuple[Side, Side], batch: int, rounds: int) -> tuple[float, float]:
    """Our smallest time in theirs, our median in theirs."""
    if runtime == "onnxruntime":
        ours, theirs = (sorted(t) for t in in_onnxruntime(sides, batch, rounds))
        return ours[0] / theirs[0], median(ours) / median(theirs)
    (least, middle), (other_least, other_middle) = in_tfjs(runtime, sides, batch, rounds)
    return least / other_least, middle / other_middle


def in_onnxruntime(sides: tuple[Side, Side], batch: int, rounds: int) -> list[list[float]]:
    """Each side's rounds, one thread."""
    calls = [_call(side, batch) for side in sides]
    times: list[list[float]] = [[], []]
    for number in range(-10, rounds):
        for side, call in zip(times, calls, strict=True):
            begin = time.process_time()
            for _ in range(_CALLS):
                call()
            if number >= 0:
                side.append(time.process_time() - begin)
    return times


def _call(side: Side, batch: int) -> Callable[[], object]:
    import numpy as np
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(side.onnx), settings, providers=["CPUExecutionProvider"])
    kinds: Mapping[str, type] = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(int64)": np.int64}
    number = {"batch_size:0": batch, "sequence_length:0": 1}
    feeds: Mapping[str, object] = {
        i.name: np.full([n if isinstance(n, int) else batch for n in i.shape], number.get(i.name, 0.5), kinds[i.type])
        for i in session.get_inputs()
    }
    return lambda: session.run(list(side.outputs), feeds)


def in_tfjs(backend: str, sides: tuple[Side, Side], batch: int, rounds: int) -> list[list[float]]:
    """The smallest and the median time of each side, in one Node or one page."""
    from export_model.converters.runtimes.javascript.browser import chromium_executable

    script = Path(__file__).with_suffix(".mjs")
    command = ["node", script, JS / "tfjs_node.mjs", JS, backend, batch, rounds]
    for side in sides:
        command += [side.tfjs, ",".join(o.split(":")[0] for o in side.outputs)]
    done = subprocess.run([*map(str, command), chromium_executable() or ""], capture_output=True, text=True, check=True)
    found: list[list[float]] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


if __name__ == "__main__":
    sys.exit(main())
