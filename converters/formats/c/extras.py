"""Parts of a header that only some options ask for, or that say what the contract says.

They are constants, weights in a file, and which observations are unusual.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.c.text import C_TYPES, C
from export_model.converters.formats.programs.plan import Guarded, Plan
from export_model.converters.graph.language import lines_of
from export_model.converters.graph.printer import Printer
from export_model.converters.graph.program import Place

_LOAD = """
/* Bit by bit: the CRC-32 of zlib, PNG and Ethernet. */
static uint32_t $P_checksum(const unsigned char *bytes, size_t size)
{
    uint32_t crc = UINT32_C(0xFFFFFFFF);
    for (size_t i = 0; i < size; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1) != 0 ? UINT32_C(0xEDB88320) : 0);
    }
    return ~crc;
}

int $P_load($P_memory *memory, const void *weights, size_t size)
{
    const uint16_t one = 1;
    memory->weights = NULL;
    if (size != $P_weights_size) return 1;
    if ($P_checksum((const unsigned char *)weights, size) != UINT32_C($SUM)) return 2;
    if ((uintptr_t)weights % 4 != 0 || *(const unsigned char *)&one != 1) return 3;
    memory->weights = (const unsigned char *)weights;
    return 0;
}
"""
LOAD_SAID = """
/* Let an agent read its weights from the content of $FILE, which stays yours and must lie at a multiple of 4 bytes.
   0; 1: its size is another, 2: its checksum is, 3: it is not aligned, or this processor is big-endian. */
int $P_load($P_memory *memory, const void *weights, size_t size);
"""
UNUSUAL_SAID = """
/* How many observed numbers lie farther than $K standard deviations from their mean in training; NaN does. */
int $P_unusual(const $P_input *input);
"""


def load_text(plan: Plan) -> str:
    """The function that takes the file."""
    checksum = f"0x{plan.weights.checksum:08X}"
    return _LOAD.replace("$P", plan.header.prefix).replace("$SUM", checksum).strip()


def sizes_text(plan: Plan) -> str:
    """The contract's numbers as constants."""
    p = plan.header.prefix
    rows = [f"{p}_size_{f.name} = {f.size}" for f in (*plan.header.fed, *plan.header.outputs)]
    rows += [f"{p}_weights_size = {len(plan.weights.file)}"] if plan.weights.file is not None else []
    branches = f"\n#define {p.upper()}_BRANCHES {{{', '.join(map(str, plan.sizes))}}}" if plan.sizes else ""
    return (
        "/* How many numbers each member has, and how many actions each branch. */\n"
        + f"enum {{\n    {(',' + chr(10) + '    ').join(rows)}\n}};{branches}"
    )


def places_of(plan: Plan) -> list[tuple[Place, int | None]]:
    """All constants as they are kept, and where they are in the file."""
    found: list[tuple[Place, int | None]] = []
    for kept in plan.weights.kept:
        parts = [kept.narrow, *([] if kept.step is None else [kept.step])]
        offsets: Sequence[int | None] = kept.offsets or [None] * len(parts)
        found += zip(parts, offsets, strict=True)
    return found


def pointers(plan: Plan, printer: Printer) -> list[str]:
    """The constants that lie in the file, as statements of the function that computes."""
    return [
        f"    const {kind} *const {printer.name(place)} = (const {kind} *)(const void *)(memory->weights + {offset});"
        for place, offset in places_of(plan)
        if offset is not None
        for kind in [C_TYPES[place.dtype.name]]
    ]


def unusual_text(plan: Plan, words: C) -> str:
    """The function that counts what training did not see."""
    p = plan.header.prefix
    loops = [_count(p, guarded, words) for guarded in plan.guarded]
    return f"int {p}_unusual(const {p}_input *input)\n{{\n    int count = 0;\n{''.join(loops)}    return count;\n}}"


def _count(prefix: str, guarded: Guarded, words: C) -> str:
    name, size = guarded.field.name, guarded.field.size

    def array(called: str, values: Sequence[float]) -> str:
        literals = lines_of([words.literal(x, np.dtype(np.float32)) for x in values]).replace("\n", "\n    ")
        return f"    static const float {called}_{name}[{size}] = {{\n        {literals}\n    }};\n"

    return (
        array("mean", guarded.mean)
        + array("limit", guarded.limit)
        + f"    for (int i = 0; i < {size}; i++)\n"
        + f"        if (!(fabsf(input->{name}[i] - mean_{name}[i]) <= limit_{name}[i])) count++;\n"
    )
