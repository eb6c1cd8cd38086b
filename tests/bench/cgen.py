"""``python -m tests.bench.cgen FOLDER``: our C beside that of emx-onnx-cgen, of the same ONNX files.

``FOLDER/bin/emx-onnx-cgen`` is that tool in an environment of its own (``pip install emx-onnx-cgen onnxruntime``).
Both are compiled by gcc -O2; sizes are of objects (code and constants), times the least of 100 rounds of 50 decisions.
What is right is so by onnxruntime's answers to the same inputs; an alarm of the tool's own check on that is false.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.formats.programs.members import header_of
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import ExportModelError
from fixtures import path
from tests import known
from tests.bench.programs import ROOT

_CLOCK = """
static double timed(void)
{
    double least = 1e9;
    for (int r = 0; r < 100; r++) {
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        for (int i = 0; i < 50; i++) CALL;
        clock_gettime(CLOCK_MONOTONIC, &b);
        const double t = (double)(b.tv_sec - a.tv_sec) * 1e6 + (double)(b.tv_nsec - a.tv_nsec) * 1e-3;
        if (t < least) least = t;
    }
    return least / 50;
}
"""
_HEAD = "#include <stdio.h>\n#include <stdint.h>\n#include <stdbool.h>\n#include <time.h>\n"
_OURS = """
#define {upper}_IMPLEMENTATION
#include "{name}.h"
static {p}_memory memory; static {p}_input input; static {p}_output output;
"""
_DTYPES = {"float": "f4", "double": "f8", "int32_t": "i4", "int64_t": "i8", "_Bool": "?", "bool": "?"}


def sources() -> list[Path]:
    """The fixtures, and every 29th file of ../shared."""
    named = [path(name) for name in ("continuous", "discrete", "recurrent", "visual")]
    return [ROOT / "fixtures/trained/3DBall", *named, *known.sources()[5::29]]


def _run(folder: Path, *command: str, given: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(command, cwd=folder, input=given, capture_output=True)


def _bytes(folder: Path, source: str) -> int:
    _run(folder, "gcc", "-std=gnu99", "-O2", "-w", "-c", source, "-o", "object.o")
    code, data = _run(folder, "size", "object.o").stdout.decode().splitlines()[1].split()[:2]
    return int(code) + int(data)


def _compiled(folder: Path, text: str) -> str:
    (folder / "main.c").write_text(_HEAD + text)
    _run(folder, "gcc", "-std=gnu99", "-O2", "-w", "-o", "main", "main.c", "-lm").check_returncode()
    return str(folder / "main")


def theirs(tool: Path, folder: Path, model: Path) -> dict[str, Any]:
    """What their C of a model is: refused, or how it answers, its size and time, what their check says."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(model))
    kinds = {"tensor(float)": "f4", "tensor(int32)": "i4", "tensor(int64)": "i8", "tensor(bool)": "?"}
    random, feeds = np.random.default_rng(1), {}
    for i in session.get_inputs():
        shape = [n if isinstance(n, int) else 1 for n in i.shape]
        drawn = i.type == "tensor(float)" and "mask" not in i.name
        feeds[i.name] = (random.standard_normal(shape) if drawn else np.ones(shape)).astype(kinds[i.type])
    expected, again = session.run(None, feeds), session.run(None, feeds)
    free = {d for i in session.get_inputs() for d in i.shape if not isinstance(d, int)}
    flags = [word for d in sorted(free) for word in ("--input-dim", f"{d}=1")]
    flags += ["--large-weight-threshold", "100000000", str(model)]
    if _run(folder, str(tool), "compile", *flags, "model.c").returncode:
        return {"refused": 1}
    false_alarm = _run(folder, str(tool), "verify", *flags).returncode != 0
    name, text = re.findall(r"^void (\w+)\((.*?)\) \{", (folder / "model.c").read_text(), re.M)[-1]
    ports = re.findall(r"(const )?(\w+) \w+((?:\[[^\]]*\])+)", text)
    sizes = [math.prod(int(n or 1) for n in re.findall(r"\[(?:restrict )?(\d*)\]", p[2])) for p in ports]
    arrays = "".join(f"static {p[1]} a{i}[{n}];\n" for i, (p, n) in enumerate(zip(ports, sizes, strict=True)))
    call = f"{name}({', '.join(f'(void *)a{i}' for i in range(len(ports)))})"
    reads = "".join(f"fread(a{i}, sizeof a{i}, 1, stdin);" for i, p in enumerate(ports) if p[0])
    writes = "".join(f"fwrite(a{i}, sizeof a{i}, 1, stdout);" for i, p in enumerate(ports) if not p[0])
    clock = _CLOCK.replace("CALL", call)
    body = f'{{ {reads} {call}; {writes} fprintf(stderr, "%.6g", timed()); return 0; }}'
    main = _compiled(folder, f'#include "model.c"\n{arrays}{clock}int main(void) {body}')
    done = _run(folder, main, given=b"".join(v.tobytes() for v in feeds.values()))
    right, at = True, 0
    for (_, kind, _), n, a, b in zip(
        [p for p in ports if not p[0]], [n for p, n in zip(ports, sizes, strict=True) if not p[0]], expected, again,
        strict=True,
    ):  # fmt: skip
        found = np.frombuffer(done.stdout, _DTYPES[kind], n, at)
        at += found.nbytes
        if np.array_equal(a, b):  # else it is drawn
            right &= np.allclose(found.astype(float), a.reshape(-1).astype(float), rtol=1e-5, atol=1e-5)
    size = _bytes(folder, "model.c")
    return {"right": right, "alarm": right and false_alarm, "bytes": size, "micros": float(done.stderr)}


def ours(folder: Path, name: str, prefix: str) -> tuple[int, float]:
    """Bytes and microseconds of our header."""
    words = {"upper": prefix.upper(), "name": name, "p": prefix}
    (folder / "only.c").write_text(_OURS.format(**words).splitlines()[1] + f'\n#include "{name}.h"\n')
    clock = _CLOCK.replace("CALL", f"{prefix}_compute(&input, &memory, &output)")
    body = f'{{ {prefix}_reset(&memory, 1); fprintf(stderr, "%.6g", timed()); return 0; }}'
    main = _compiled(folder, f"{_OURS.format(**words)}{clock}int main(void) {body}")
    return _bytes(folder, "only.c"), float(_run(folder, main).stderr)


def main() -> int:
    """Print a line for each file, and the sums."""
    tool = Path(sys.argv[1], "bin", "emx-onnx-cgen").resolve()
    lines = list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as scratch:
        options = ExportOptions(Path(scratch), ("onnx", "c"), verify="none", code=CodeOptions(outputs="all"))
        for number, source in enumerate(sources()):
            try:
                result, *_ = export([source], options)
            except ExportModelError:
                continue
            name, folder = result.policy.name, Path(scratch, str(number))
            folder.mkdir()
            begun = time.process_time()
            found = theirs(tool, folder, result.folder / f"{name}.onnx")
            if "refused" not in found:
                size, micros = ours(result.folder, name, header_of(name, result.policy.signature).prefix)
                found |= {"size": size / found["bytes"], "time": micros / found["micros"]}
            lines.append(found)
            print(f"{name[:40]:42}{found} {time.process_time() - begun:.1f} s", flush=True)
    both = [one for one in lines if "size" in one]
    print(f"theirs: {sum(one['right'] for one in both)} of {len(lines)} right, {len(lines) - len(both)} refused, "
          f"{sum(one['alarm'] for one in both)} false alarms")  # fmt: skip
    for key in ("size", "time"):
        ratios = [one[key] for one in both]
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
        print(f"our {key} in theirs: {min(ratios):.2f} to {max(ratios):.2f}, geometric mean {mean:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
