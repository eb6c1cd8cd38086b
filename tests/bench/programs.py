"""``python -m tests.bench.programs``: policies as C beside onnxruntime, as C# beside C, and on a microcontroller.

One decision of one agent, one thread, the smallest of 100 rounds: compiled by gcc -O2 and called in a loop; and
onnxruntime's session with its inputs and outputs bound before, and called as people call it from Python. A ratio above
1 says that the C is faster. Flash and RAM are of a Cortex-M4 with ``arm-none-eabi-gcc -O2`` (Debian's gcc-arm-none-eabi
and libnewlib-arm-none-eabi), the policy, its weights, the mathematics of newlib and one agent's memory: no start-up
code, no stack. C# is compiled by mcs and run by Mono, and by ``dotnet`` if that is on the PATH (PyPI's dotnetcore2 is
the runtime of .NET Core 3.1); its ratio says how many times longer it takes than C. ``--full`` then runs every policy
of ../shared under ASan and UBSan (an hour).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from export_model.converters.formats.programs.members import header_of
from export_model.converters.runtimes.c import compiler
from export_model.converters.runtimes.csharp import tools
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path
from tests.programs import sanitize

ROOT = Path(__file__).resolve().parents[2]
SOURCES = (
    ROOT / "fixtures/trained/3DBall",
    *(path(name) for name in ("continuous", "discrete", "recurrent", "visual")),
)
ROUNDS = 100
_CORTEX = (
    "-mcpu=cortex-m4",
    "-mthumb",
    "-mfloat-abi=hard",
    "-mfpu=fpv4-sp-d16",
    "-ffunction-sections",
    "-fdata-sections",
)
_TIMED = """
#define _POSIX_C_SOURCE 199309L
#define {upper}_IMPLEMENTATION
#include "{name}.h"
#include <stdio.h>
#include <time.h>
static {p}_memory memory;
static {p}_input input;
static {p}_output output;
int main(void)
{{
    double least = 1e9;
    {p}_reset(&memory, 1);
    for (int round = 0; round < {rounds}; round++) {{
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        for (int i = 0; i < 100; i++) {p}_compute(&input, &memory, &output);
        clock_gettime(CLOCK_MONOTONIC, &b);
        const double took = (double)(b.tv_sec - a.tv_sec) * 1e6 + (double)(b.tv_nsec - a.tv_nsec) * 1e-3;
        if (took < least) least = took;
    }}
    printf("%.9g %d", least / 100, (int)sizeof memory);
    return 0;
}}
"""
_CS_TIMED = """
static class Program
{{
    static void Main()
    {{
        var agent = new Policies.{kind}(1);
        double least = 1e9;
        for (int round = 0; round < 3 * {rounds}; round++) {{
            long begun = System.Diagnostics.Stopwatch.GetTimestamp();
            for (int i = 0; i < 100; i++) agent.Compute();
            least = System.Math.Min(least, System.Diagnostics.Stopwatch.GetTimestamp() - begun);
        }}
        least *= 1e4 / System.Diagnostics.Stopwatch.Frequency;
        System.Console.WriteLine(least.ToString(System.Globalization.CultureInfo.InvariantCulture));
    }}
}}
"""
_DOTNET = """{"runtimeOptions": {"framework": {"name": "Microsoft.NETCore.App", "version": "3.1.0"},
"rollForward": "Major", "configProperties": {"System.Globalization.Invariant": true}}}"""
_LINKED = """
#define {upper}_IMPLEMENTATION
#include "{name}.h"
static {p}_memory memory;
static {p}_input input;
static {p}_output output;
int main(void) {{ return {p}_compute(&input, &memory, &output); }}
"""


def main() -> int:
    import onnxruntime

    cc, arm = compiler(), shutil.which("arm-none-eabi-gcc")
    if cc is None:
        print("not measured: no C compiler is installed")
        return 0
    print(f"onnxruntime {onnxruntime.__version__}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'':12}{'C, µs':>9}{'bound, µs':>11}{'ratio':>7}{'Python, µs':>12}{'ratio':>7}{'flash, kB':>11}{'RAM, B':>8}"
        f"{'Mono, µs':>10}{'ratio':>7}{'.NET, µs':>10}{'ratio':>7}"
    )
    with tempfile.TemporaryDirectory() as scratch:
        options = ExportOptions(Path(scratch), ("c", "csharp", "onnx"), verify="none")
        for result in (r for source in SOURCES for r in export([source], options)):
            header = header_of(result.policy.name, result.policy.signature)
            words = {"p": header.prefix, "upper": header.prefix.upper(), "name": result.policy.name, "rounds": ROUNDS}
            micros, memory = _timed(cc, result.folder, _TIMED.format(**words))
            bound, called = _onnxruntime(result.folder / f"{result.policy.name}.onnx", result.policy.name)
            flash = f"{_flash(arm, result.folder, _LINKED.format(**words)) / 1000:.1f}" if arm else "no gcc"
            words["kind"] = header.class_name
            virtual = _virtual_machines(result.folder, result.policy.name, _CS_TIMED.format(**words))
            print(
                f"{result.policy.name:12}{micros:>9.2f}{bound:>11.1f}{bound / micros:>7.1f}{called:>12.1f}"
                f"{called / micros:>7.1f}{flash:>11}{int(memory):>8}"
                + "".join(f"{v:>10.2f}{v / micros:>7.2f}" if v else f"{'none':>10}{'':7}" for v in virtual),
                flush=True,
            )
    return sanitize.main() if "--full" in sys.argv[1:] else 0


def _timed(cc: str, folder: Path, source: str) -> tuple[float, float]:
    """Microseconds a decision, and the bytes of an agent's memory."""
    (folder / "main.c").write_text(source)
    subprocess.run([cc, "-std=c99", "-O2", "-o", "main", "main.c", "-lm"], check=True, cwd=folder)
    done = subprocess.run([str(folder / "main")], check=True, capture_output=True, text=True)
    micros, memory = done.stdout.split()
    return float(micros), float(memory)


def _virtual_machines(folder: Path, name: str, source: str) -> list[float | None]:
    """Microseconds a decision in Mono and in .NET, of those that are here."""
    here, dotnet = tools(), shutil.which("dotnet")
    if here is None:
        return [None, None]
    mcs, mono = here
    (folder / "main.cs").write_text(source)
    (folder / "main.runtimeconfig.json").write_text(_DOTNET)
    command = [mcs, "-langversion:7", "-optimize+", "-out:main.exe", "main.cs", f"{name}.cs"]
    subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    runs = ([mono, "main.exe"], dotnet and [dotnet, "exec", "--runtimeconfig", "main.runtimeconfig.json", "main.exe"])
    return [float(subprocess.run(r, check=True, cwd=folder, capture_output=True).stdout) if r else None for r in runs]


def _flash(arm: str, folder: Path, source: str) -> int:
    """Bytes of code and constants; those of a program that does nothing are newlib's own, and left out."""

    def size(text: str) -> int:
        (folder / "arm.c").write_text(text)
        flags = ("-std=c99", "-O2", *_CORTEX, "-Wl,--gc-sections", "--specs=nosys.specs", "--specs=nano.specs")
        subprocess.run([arm, *flags, "-o", "arm.elf", "arm.c", "-lm"], check=True, cwd=folder, capture_output=True)
        done = subprocess.run(["arm-none-eabi-size", "arm.elf"], check=True, capture_output=True, text=True, cwd=folder)
        code, data = done.stdout.splitlines()[1].split()[:2]
        return int(code) + int(data)

    return size(source) - size("int main(void) { return 0; }")


def _onnxruntime(model: Path, name: str) -> tuple[float, float]:
    """Microseconds a decision, the inputs and outputs bound before, and by ``run``."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(model), options)
    kinds = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(int64)": np.int64}
    feeds = {
        i.name: np.zeros([n if isinstance(n, int) else 1 for n in i.shape], kinds[i.type]) for i in session.get_inputs()
    }
    outputs = [o.name for o in session.get_outputs() if o.name not in ("value_estimate", "action_probs")]
    binding = session.io_binding()
    for key, value in feeds.items():
        binding.bind_cpu_input(key, value)
    for key in outputs:
        binding.bind_output(key)
    return _least(lambda: session.run_with_iobinding(binding)), _least(lambda: session.run(outputs, feeds))


def _least(call: Callable[[], object]) -> float:
    least = float("inf")
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(100):
            call()
        least = min(least, time.perf_counter() - start)
    return least / 100 * 1e6


if __name__ == "__main__":
    sys.exit(main())
