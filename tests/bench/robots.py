"""``python -m tests.bench.robots [FOLDER]``: C of policies at the size of robots beside onnxruntime's C interface.

``FOLDER/bin/emx-onnx-cgen``, where it is given, is that tool in an environment of its own. One decision of one agent,
one thread, µs of the processor's time: all programs in turn, the smallest of ``ROUNDS`` rounds of 5 × 100 decisions.
onnxruntime's shared object is that of its wheel; its functions are called by their places in OrtApi (an interface that
only grows). Each column is a compiler and its flags; ``peak`` is numpy's product of the same matrices by vectors alone.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from export_model.converters.formats.programs.members import header_of
from export_model.exporter.export.pipeline import ExportOptions, export
from tests.bench.programs import ROOT
from tests.bench.robot_networks import NETWORKS, Network

ROUNDS = 5
FLAGS = ("-O2", "-O3", "-O3 -march=native", "-O3 -ffast-math")
_CLOCK = """
#define _POSIX_C_SOURCE 200112L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#define TIMED(CALL) do { double least = 1e9; for (int r = 0; r < 5; r++) { struct timespec a, b; \\
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a); for (int i = 0; i < 100; i++) CALL; \\
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b); \\
    const double t = (double)(b.tv_sec - a.tv_sec) * 1e4 + (double)(b.tv_nsec - a.tv_nsec) * 1e-5; \\
    if (t < least) least = t; } printf("%.6g", least); } while (0)
static void fill(float *x, size_t n) { for (size_t i = 0; i < n; i++) x[i] = (float)((int)(i * 7 % 17) - 8) / 8.0f; }
"""
_OURS = """
#define {upper}_IMPLEMENTATION
#include "{name}.h"
static {p}_memory memory; static {p}_input input; static {p}_output output;
int main(void) {{ {p}_reset(&memory, 1); fill((float *)&input, sizeof input / 4);
    TIMED({p}_compute(&input, &memory, &output)); return 0; }}
"""
_THEIRS = """
#include "model.c"
{arrays}
int main(void) {{ {fills} TIMED(model({names})); return 0; }}
"""
#: Places in OrtApi: CreateEnv 3, CreateSession 7, Run 9, CreateSessionOptions 10, SetIntraOpNumThreads 24,
#: CreateTensorWithDataAsOrtValue 49, CreateCpuMemoryInfo 69.
_ORT = """
#include <dlfcn.h>
#include <stdint.h>
typedef void *S;
#define ASK(e) do {{ if (e) {{ fprintf(stderr, "onnxruntime refuses\\n"); return 1; }} }} while (0)
int main(void)
{{
    void *lib = dlopen("{library}", RTLD_NOW), *env, *options, *session, *info, *values[8];
    if (!lib) {{ fprintf(stderr, "%s\\n", dlerror()); return 1; }}
    struct base {{ const void *const *(*api)(uint32_t); }};
    const void *const *f = ((const struct base *(*)(void))dlsym(lib, "OrtGetApiBase"))()->api(17);
    ASK(((S(*)(int, const char *, void **))f[3])(3, "bench", &env));
    ASK(((S(*)(void **))f[10])(&options));
    ASK(((S(*)(void *, int))f[24])(options, 1));
    ASK(((S(*)(void *, const char *, void *, void **))f[7])(env, "{model}", options, &session));
    ASK(((S(*)(int, int, void **))f[69])(0, 0, &info));
    static const char *const names[] = {{{names}}};
    static const int64_t dims[][4] = {{{dims}}};
    static const size_t ranks[] = {{{ranks}}}, sizes[] = {{{sizes}}};
    for (int i = 0; i < {total}; i++) {{
        float *data = (float *)calloc(sizes[i], 4);
        fill(data, sizes[i]);
        ASK(((S(*)(void *, void *, size_t, const int64_t *, size_t, int, void **))f[49])(
            info, data, sizes[i] * 4, dims[i], ranks[i], 1, &values[i]));
    }}
    S (*run)(void *, void *, const char *const *, void **, size_t, const char *const *, size_t, void **) =
        (S(*)(void *, void *, const char *const *, void **, size_t, const char *const *, size_t, void **))f[9];
    ASK(run(session, 0, names, values, {given}, names + {given}, {total} - {given}, values + {given}));
    TIMED(run(session, 0, names, values, {given}, names + {given}, {total} - {given}, values + {given}));
    return 0;
}}
"""


def _compile(folder: Path, name: str, text: str, command: Sequence[str]) -> list[str]:
    (folder / f"{name}.c").write_text(_CLOCK + text)
    program = str(folder / re.sub(r"\W", "", name + "".join(command)))
    subprocess.run([*command, "-std=gnu99", "-w", "-o", program, f"{name}.c", "-lm", "-ldl"], check=True, cwd=folder)
    return [program]


def _ours(network: Network, model: Path, folder: Path) -> dict[str, list[str]]:
    (result,) = export([model], ExportOptions(folder, ("c",), verify="none"))
    name = result.policy.name
    p = header_of(name, result.policy.signature).prefix
    text = _OURS.format(p=p, upper=p.upper(), name=name)
    return {
        f"{compiler} {flags}": _compile(result.folder, "bench", text, [compiler, *flags.split()])
        for compiler in ("gcc", "clang")
        for flags in FLAGS
    }


def _theirs(tool: Path, network: Network, model: Path, folder: Path) -> dict[str, list[str]]:
    """Programs of emx-onnx-cgen; none where it refuses the model."""
    command = [str(tool), "compile", "--large-weight-threshold", "100000000", str(model), "model.c"]
    if subprocess.run(command, cwd=folder, capture_output=True).returncode:
        return {}
    shapes = [*network.inputs.values(), *network.outputs.values()]
    arrays = "".join(f"static float a{i}[{int(np.prod(s))}];\n" for i, s in enumerate(shapes))
    fills = " ".join(f"fill(a{i}, sizeof a{i} / 4);" for i in range(len(network.inputs)))
    names = ", ".join(f"(void *)a{i}" for i in range(len(shapes)))
    text = _THEIRS.format(arrays=arrays, fills=fills, names=names)
    flags = ("-O2", "-O3 -march=native", "-O3 -march=native -ffast-math")
    return {f"emx {c} {f}": _compile(folder, "theirs", text, [c, *f.split()]) for c in ("gcc", "clang") for f in flags}


def _onnxruntime(network: Network, model: Path, folder: Path) -> dict[str, list[str]]:
    """The program that asks onnxruntime; none where its wheel has no shared object."""
    import onnxruntime

    library = next(Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so*"), None)
    if library is None:
        return {}
    ports = {**network.inputs, **network.outputs}
    text = _ORT.format(
        library=library,
        model=model,
        names=", ".join(f'"{n}"' for n in ports),
        dims=", ".join("{" + ", ".join(map(str, s)) + "}" for s in ports.values()),
        ranks=", ".join(str(len(s)) for s in ports.values()),
        sizes=", ".join(str(int(np.prod(s))) for s in ports.values()),
        given=len(network.inputs),
        total=len(ports),
    )
    return {"onnxruntime": _compile(folder, "ort", text, ["gcc", "-O2"])}


def _product(shapes: Sequence[tuple[int, int]]) -> Callable[[], None]:
    pairs = [(np.ones((n, k), np.float32), np.ones(k, np.float32), np.empty(n, np.float32)) for k, n in shapes]

    def run() -> None:
        for matrix, vector, out in pairs:
            np.dot(matrix, vector, out=out)

    return run


def _peak(network: Network) -> float:
    """µs of numpy's products alone, without what it takes to call them."""
    run, empty = _product(network.products), _product([(1, 1)] * len(network.products))
    least = [1e9, 1e9]
    for _ in range(50):
        for i, each in enumerate((run, empty)):
            begun = time.process_time()
            for _ in range(50):
                each()
            least[i] = min(least[i], (time.process_time() - begun) / 50 * 1e6)
    return max(least[0] - least[1], 0.0)


def main() -> int:
    """Print a table for each network."""
    tool = Path(sys.argv[1], "bin", "emx-onnx-cgen").resolve() if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory(dir=ROOT / "build" if (ROOT / "build").is_dir() else None) as scratch:
        for network in NETWORKS:
            folder = Path(scratch, network.name)
            folder.mkdir()
            model = folder / f"{network.name}.onnx"
            network.save(model)
            programs = {**_ours(network, model, folder), **_onnxruntime(network, model, folder)}
            programs |= _theirs(tool, network, model, folder) if tool else {}
            least = dict.fromkeys(programs, float("inf"))
            for _ in range(ROUNDS):
                for name, command in programs.items():
                    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                    least[name] = min(least[name], float(said))
            peer, count = least.get("onnxruntime"), network.multiply_adds
            print(f"{network.name}: {count} multiply-adds; products by numpy alone {_peak(network):.2f} µs", flush=True)
            for name, micros in least.items():
                share = f"{micros / peer:6.2f} of onnxruntime" if peer else "onnxruntime: not here"
                print(f"  {name:34}{micros:9.3f} µs {micros * 1e3 / count:8.4f} ns each {share}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
