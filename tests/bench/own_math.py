"""``python -m tests.bench.own_math``: how far the functions of ``--math own`` are off, over all 2^32 floats (10 min).

Beside the C library in double, compiled by gcc; units in the last place of the true value, a float's least spacing
below the least normal number. ``pow`` takes two numbers: its bases go over all floats, its exponents over some.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from export_model.converters.formats.c.text import C
from export_model.converters.graph.ops.loops.base import Applied, Given
from export_model.converters.graph.ops.loops.own_math import OWN
from export_model.converters.graph.printer import Printer
from export_model.converters.graph.types import FLOAT32
from export_model.converters.runtimes.c import compiler

#: What is left out for a function: where its entry says so.
_WHERE = {
    "results from 0.001 to 1000, angles below 8192": "fabs(right) > 1e-3 && fabs(right) < 1e3",
    "results from 1e-30 to 1e30": "(right != right || (fabs(right) > 1e-30 && fabs(right) < 1e30))",
    "all floats": "1",
}
_MAIN = """
#include <stdio.h>
#include <stdlib.h>
int main(int count, char **words)
{
    const uint64_t step = strtoull(words[1], 0, 10);
    static const float exponents[] = {-3.0f, -1.5f, -1.0f, 0.3f, 0.5f, 1.0f, 2.0f, 2.2f, 3.0f, 7.0f};
    double most = 0.0;
    float where = 0.0f;
    (void)count;
    for (uint64_t i = 0; i < (UINT64_C(1) << 32); i += step) {
        const uint32_t bits = (uint32_t)i;
        float a;
        memcpy(&a, &bits, sizeof a);
        const double x = (double)a;
        if (!(TAKEN)) continue;
        const float b = exponents[i / step % 10];
        double right = CALLED(x, (double)b);
        const float found = OWN(a, b);
        if (!(KEPT)) continue;
        if ((right != right) != (found != found)) { printf("%.9g %.9g\\n", 1e30, x); return 0; }
        if (right != right) continue;
        if (fabs(right) > 0x1p128) right = right < 0 ? -0x1p128 : 0x1p128;
        const double given = isinf(found) ? (found < 0 ? -0x1p128 : 0x1p128) : (double)found;
        uint64_t word;
        memcpy(&word, &right, sizeof word);
        int exponent = (int)(word >> 52 & 2047) - 1022;
        exponent = exponent > 128 ? 128 : exponent < -125 ? -125 : exponent;
        word = (uint64_t)(1023 + 24 - exponent) << 52;
        double scale;
        memcpy(&scale, &word, sizeof scale);
        const double off = fabs(given - right) * scale;
        if (off > most) { most = off; where = a; }
    }
    printf("%.9g %.9g\\n", most, (double)where);
    return 0;
}
"""


def source_of(function: str) -> str:
    """C that measures a function of ours."""
    words = C("own", own=True)
    given = [Given("a"), Given("b")][: 2 if function == "pow" else 1]
    Printer(words, "").function(lambda *x: Applied(function, x, FLOAT32), *(g.name for g in given))
    names = "(a)" if len(given) == 1 else "(a, b)"
    macros = {
        "TAKEN": "fabs(x) < 8192.0" if "angles" in OWN[function].where else "1",
        "KEPT": _WHERE[OWN[function].where],
        "OWN(a, b)": f"own_{function}f{names}",
        "CALLED(a, b)": f"{function}{names}",
    }
    defined = "".join(f"#define {name} {text}\n" for name, text in macros.items())
    head = "#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"
    return head + "\n".join(words.helpers.values()) + "\n" + defined + _MAIN


def measure(function: str, step: int, folder: Path) -> tuple[float, float]:
    """How many units one of each ``step`` floats is off at most, and which."""
    (folder / f"{function}.c").write_text(source_of(function), "ascii")
    command = [str(compiler()), "-std=c99", "-O2", "-ffp-contract=off", "-o", function, f"{function}.c", "-lm"]
    subprocess.run(command, check=True, cwd=folder)
    said = subprocess.run([str(folder / function), str(step)], check=True, capture_output=True, text=True).stdout
    most, where = said.split()
    return float(most), float(where)


def main(step: int) -> int:
    """Print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        for function, own in OWN.items():
            most, where = measure(function, step, Path(scratch))
            print(f"{function:6} {most:8.3f} at {where:<16.9g} promised {own.ulps:g} of {own.where}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 1))
