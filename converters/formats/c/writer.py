"""Policy to one C header: every stage a loop nest, weights as constants, nothing to link but the C library's maths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.c.extras import (
    LOAD_SAID,
    UNUSUAL_SAID,
    load_text,
    places_of,
    pointers,
    sizes_text,
    unusual_text,
)
from export_model.converters.formats.c.text import C_TYPES, C
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.members import Field
from export_model.converters.formats.programs.plan import CLOSE, NAN_SAID, ROWS, Plan, formula, write_program
from export_model.converters.formats.programs.weights import weights_name, widen_where_used
from export_model.converters.graph.ops.loops.layers import box_muller, gumbel
from export_model.converters.graph.printer import Printer
from export_model.converters.graph.program import arena_of
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import UnsupportedOpError

_DRAWS = """
/* The stream of draws: splitmix64 (Steele, Lea and Flood 2014), its top 23 bits, in the middle of their step: above 0,
   below 1, and exact in a float. The same seed gives the same draws everywhere. */
static float $P_uniform($P_memory *memory)
{
    uint64_t z = (memory->stream += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    z ^= z >> 31;
    return ((float)(int32_t)(z >> 41) + 0.5f) * 1.1920928955078125e-7f;
}
"""
_NORMAL = """
/* Draws from N(0, 1), by Box and Muller. */
static void $P_normal($P_memory *memory, float *out, int count)
{
    for (int i = 0; i < count; i++) {
        const float radius = $P_uniform(memory), turn = $P_uniform(memory);
        out[i] = $X;
    }
}
"""
#: What gcc is told: speculation raises no flag that anyone reads, and 16 terms at a time do not fit into registers.
_VECTORS = """
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 8
#pragma GCC push_options
#pragma GCC optimize ("no-trapping-math", "no-loop-unroll-and-jam", "no-tree-loop-distribute-patterns")
#endif
#if defined(__GNUC__) && defined(__AVX__)
#define $U_ALIGNED __attribute__((aligned(64))) /* a line of the cache */
#else
#define $U_ALIGNED
#endif
"""
_APART = """
#if defined(__GNUC__) && !defined(__clang__)
#define $U_APART _Pragma("GCC ivdep")
#else
#define $U_APART
#endif
"""
_END = """
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 8
#pragma GCC pop_options
#endif
#endif
"""
_STRICT = """
/* The same bits on every processor: every operation is rounded to float, and none is fused with another. */
#if defined(__FAST_MATH__) || FLT_EVAL_METHOD < 0 || FLT_EVAL_METHOD == 1 || FLT_EVAL_METHOD == 2
#error "compile without -ffast-math, and on x86 with -msse2 -mfpmath=sse"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize ("fp-contract=off")
#elif defined(_MSC_VER)
#pragma fp_contract (off)
#endif
"""


#: Headers of C, C23's too, and those that these include in glibc, newlib and Visual C++: a file of one of these names,
#: beside the program or in a folder of -I, is included in its place.
_LIBRARY_HEADERS = frozenset(
    """assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic
    stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
    alloca corecrt crtdefs endian features features-time64 malloc memory newlib reent sal stdc-predef strings unistd
    vadefs vcruntime yvals""".split()  # noqa: SIM905  a list of forty lines otherwise
)


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The header. Raises UnsupportedOpError, too where it would be taken for one of the C library's."""
    if policy.name.lower() in _LIBRARY_HEADERS:  # file systems ignore case
        raise UnsupportedOpError(
            f"a header cannot be called {policy.name}.h",
            issues=[],
            why=f"programs would include it in the place of <{policy.name.lower()}.h>, which it needs itself",
            fix="give the policy another name: --name",
        )
    return write_program(policy, options, ".h", _text)


def _text(name: str, plan: Plan) -> str:
    plan = replace(plan, program=widen_where_used(plan.program, plan.weights))
    header, program, p = plan.header, plan.program, plan.header.prefix
    words = C(p, plan.code.math == "own", plan.weights.file is not None)
    printer = Printer(words, f"{p}_w_")
    by_name = {f.spec.name: f"input->{f.name}" for f in header.inputs}
    by_name |= {f.spec.name: f"memory->{f.name}" for f in header.own_values}
    by_name |= {f.spec.name: f"allowed_{f.name}" for f, _ in plan.masks}
    for key, tensor in program.inputs.items():
        printer.called(tensor.place, by_name[key])
    body = _compute_lines(plan, printer)
    choose = _choose(p, plan.chosen, plan.sizes, printer.function(gumbel, "row[i]", "u")) if plan.chosen else ""
    parts = [*_declarations(name, plan, printer, choose), *_definitions(plan, printer, words, body, choose)]
    return "\n\n".join(parts) + "\n"


def _compute_lines(plan: Plan, printer: Printer) -> list[str]:
    """The lines of the function that computes: pointers, the loops, and what is handed on."""
    header, program, state = plan.header, plan.program, plan.header.state
    statements = printer.body(program)
    places = [stage.result.place for stage in program.stages]
    body = [
        f"    {C_TYPES[at.dtype.name]} *const {printer.name(at)} = memory->{arena_of(at.dtype)} + {at.offset};"
        for at in places
    ]
    loads = plan.weights.file is not None
    body = [*(["    if (memory->weights == NULL) return 2;"] if loads else []), *pointers(plan, printer), *body]
    body = [*(["    int outside = 0;"] if printer.looks_up else []), *body, *statements]
    body += ["    if (outside) return 1;"] if printer.looks_up else []
    for f in header.answered:
        target = f"memory->{state.name}" if f is header.next_state and state else f"output->{f.name}"
        source = printer.name(program.outputs[f.spec.name].place)
        body.append(f"    for (int i = 0; i < {f.size}; i++) {target}[i] = {source}[i];")
    return body


def _declarations(name: str, plan: Plan, printer: Printer, choose: str) -> list[str]:
    """What a program that includes the header sees: structures and functions, with what they do."""
    header, program = plan.header, plan.program
    p, sizes, loads = header.prefix, plan.sizes, plan.weights.file is not None
    unmasked = "\n   Of a branch whose masks are all 0, as in an input of zeros, all actions are allowed." * bool(
        plan.masks
    )
    unloaded = "; 2 before the weights are loaded" * loads
    exact = ", with the masks as they are" * bool(plan.masks)
    return [
        f"/* {p}: a policy without a runtime. In one source file, write\n"
        f"       #define {p.upper()}_IMPLEMENTATION\n"
        f'       #include "{name}.h"\n'
        f"   and link the C library's maths (-lm). C99 or later, C++11 or later. Made by export-model.\n\n"
        f"{plan.contract}",
        f"#ifndef {p.upper()}_H\n#define {p.upper()}_H\n\n#include <stddef.h>\n#include <stdint.h>\n\n"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif',
        sizes_text(plan),
        _struct(f"{p}_input", f"What an agent observes. {NAN_SAID}", map(_member, header.inputs)),
        _struct(
            f"{p}_memory",
            "What an agent keeps: the stream of its draws, its state; the rest is for computing.",
            [
                *(["const unsigned char *weights;"] if loads else []),
                "uint64_t stream;",
                *map(_member, header.own_values),
                *(
                    f"{c} {arena}[{size}];"
                    for arena, size in program.arenas.items()
                    for c in [{"floats": "float", "ints": "int32_t", "longs": "int64_t"}[arena]]
                ),
            ],
        ),
        _struct(f"{p}_output", "What an agent does.", map(_member, header.outputs)),
        *([LOAD_SAID.replace("$P", p).replace("$FILE", weights_name(name)).strip()] if loads else []),
        f"/* Begin an episode: no state, draws by a seed{'; the weights stay loaded' * loads}. */\n"
        f"void {p}_reset({p}_memory *memory, uint64_t seed);\n"
        f"/* Decide: draw the noise where there is some, then compute. 0; 1, and no output, where an observed index\n"
        f"   lies outside of the table that it is looked up in{unloaded}.{unmasked} */\n"
        f"int {p}_act(const {p}_input *input, {p}_memory *memory, {p}_output *output);\n"
        f"/* The same for some agents, each with a memory of its own; how many of them have no output. */\n"
        f"int {p}_act_all(int agents, const {p}_input *input, {p}_memory *memory, {p}_output *output);\n"
        f"/* Compute {plan.chance(printer, 'the memory')}{exact}. */\n"
        f"int {p}_compute(const {p}_input *input, {p}_memory *memory, {p}_output *output);\n"
        f"#ifdef {p.upper()}_SELFTEST\n"
        f"/* How many numbers are not what the policy's own kernels computed at export: 0. */\n"
        f"int {p}_selftest({p}_memory *memory);\n#endif",
        *([UNUSUAL_SAID.replace("$P", p).replace("$K", f"{plan.code.guard:g}").strip()] if plan.guarded else []),
        *([f"/* Draw a class for each of {len(sizes)} branches. */\n{choose.splitlines()[0]};"] if choose else []),
    ]


def _definitions(plan: Plan, printer: Printer, words: C, body: Sequence[str], choose: str) -> list[str]:
    """What the one source file gets that defines the implementation."""
    header = plan.header
    p, loads = header.prefix, plan.weights.file is not None
    normal = printer.function(box_muller, "radius", "turn") if header.noise else ""
    draws = plan.draws(printer)
    takes, given = f"const {p}_input *input, {p}_memory *memory, {p}_output *output", "input, memory, output"
    masks = "".join(f", const {C_TYPES[f.spec.dtype]} *allowed_{f.name}" for f, _ in plan.masks)
    as_fed, allowed = ("".join(f", {each}{f.name}" for f, _ in plan.masks) for each in ("input->", "allowed_"))
    computes = f"{p}_decide" if masks else f"{p}_compute"
    return [
        f"#ifdef __cplusplus\n}}\n#endif\n\n#endif\n\n"
        f"#ifdef {p.upper()}_IMPLEMENTATION\n#include <float.h>\n#include <math.h>\n#include <string.h>",
        (_VECTORS + _APART * loads).replace("$U", p.upper()).strip(),
        *([_STRICT.strip()] if words.own else []),
        *(words.constant(place, printer.name(place)) for place, offset in places_of(plan) if offset is None),
        *words.helpers.values(),
        *([_DRAWS.replace("$P", p).strip()] if draws else []),
        *([_NORMAL.replace("$P", p).replace("$X", normal).strip()] if header.noise else []),
        *([load_text(plan)] if loads else []),
        f"void {p}_reset({p}_memory *memory, uint64_t seed)\n{{\n"
        + ("    const unsigned char *const weights = memory->weights;\n" if loads else "")
        + "    memset(memory, 0, sizeof *memory);\n"
        + ("    memory->weights = weights;\n" if loads else "")
        + "    memory->stream = seed;\n}",
        *(_allow(p, f, branches) for f, branches in plan.masks),
        f"{'static ' * bool(masks)}int {computes}({takes}{masks})\n{{\n"
        f"    (void)input;\n    (void)memory;\n" + "\n".join(body) + "\n    return 0;\n}",
        *([f"int {p}_compute({takes})\n{{\n    return {computes}({given}{as_fed});\n}}"] if masks else []),
        f"int {p}_act({takes})\n{{\n"
        + "".join(f"    {C_TYPES[f.spec.dtype]} allowed_{f.name}[{f.size}];\n" for f, _ in plan.masks)
        + "".join(f"    {p}_allow_{f.name}(input->{f.name}, allowed_{f.name});\n" for f, _ in plan.masks)
        + "".join(f"    {p}_normal(memory, memory->{f.name}, {f.size});\n" for f in header.noise)
        + f"    return {computes}({given}{allowed});\n}}",
        f"int {p}_act_all(int agents, const {p}_input *input, {p}_memory *memory, {p}_output *output)\n{{\n"
        f"    int without = 0;\n"
        f"    for (int i = 0; i < agents; i++) without += {p}_act(&input[i], &memory[i], &output[i]);\n"
        f"    return without;\n}}",
        *([choose] if choose else []),
        *([unusual_text(plan, words)] if plan.guarded else []),
        _selftest(plan, words),
        _END.strip(),
    ]


def _allow(prefix: str, field: Field, branches: Sequence[int]) -> str:
    """The function that allows all actions of a branch of which no mask is set."""
    kind = C_TYPES[field.spec.dtype]
    return (
        f"static void {prefix}_allow_{field.name}(const {kind} *masks, {kind} *allowed)\n{{\n"
        f"    static const int sizes[{len(branches)}] = {{{', '.join(map(str, branches))}}};\n"
        f"    for (int branch = 0; branch < {len(branches)}; branch++) {{\n        int none = 1;\n"
        f"        for (int i = 0; i < sizes[branch]; i++) none = none && masks[i] == 0;\n"
        f"        for (int i = 0; i < sizes[branch]; i++) allowed[i] = none ? 1 : masks[i];\n"
        f"        masks += sizes[branch];\n        allowed += sizes[branch];\n    }}\n}}"
    )


def _choose(prefix: str, field: Field, sizes: Sequence[int], drawn: str) -> str:
    """The function that draws classes by their log-probabilities, by the Gumbel trick."""
    return (
        f"void {prefix}_choose({prefix}_memory *memory, const {prefix}_output *output, int32_t *action)\n{{\n"
        f"    static const int sizes[{len(sizes)}] = {{{', '.join(map(str, sizes))}}};\n"
        f"    const float *row = output->{field.name};\n"
        f"    for (int branch = 0; branch < {len(sizes)}; branch++) {{\n"
        f"        float best = -INFINITY;\n        action[branch] = 0;\n"
        f"        for (int i = 0; i < sizes[branch]; i++) {{\n"
        f"            const float u = {prefix}_uniform(memory);\n            const float drawn = {drawn};\n"
        f"            if (best < drawn) {{ best = drawn; action[branch] = i; }}\n        }}\n"
        f"        row += sizes[branch];\n    }}\n}}"
    )


def _struct(name: str, about: str, members: Iterable[str]) -> str:
    lines = list(members) or ["int32_t nothing;"]
    inner = "\n".join(f"    {line}" for line in lines)
    return f"/* {about} */\ntypedef struct {{\n{inner}\n}} {name};"


def _member(field: Field) -> str:
    return f"{C_TYPES[field.spec.dtype]} {field.name}[{field.size}]; /* {field.about} */"


def _selftest(plan: Plan, words: C) -> str:
    """Golden rows: inputs by a formula, what the kernels make of them."""
    p, lines = plan.header.prefix, list[str]()
    for f in plan.header.inputs:
        fed = formula(f, "(float)((i * 7 + row * 5) % 17 - 8) / 8.0f")
        lines.append(f"        for (int i = 0; i < {f.size}; i++) input.{f.name}[i] = {fed};")
    tests = [
        f"        for (int i = 0; i < {f.size}; i++, at++)\n"
        f"            if (golden[at] == golden[at] /* NaN: nothing to compare */\n"
        f"                && !(fabsf(output.{f.name}[i] - golden[at])\n"
        f"                    <= {CLOSE}f * (1.0f + fabsf(golden[at])))) wrong++;"
        for f in plan.checked
    ]
    if not plan.golden:
        empty = f"int {p}_selftest({p}_memory *memory)\n{{\n    (void)memory;\n    return 0;\n}}"
        return f"#ifdef {p.upper()}_SELFTEST\n{empty}\n#endif"
    numbers = ", ".join(words.literal(x, np.dtype(np.float32)) for x in plan.golden)
    return (
        f"#ifdef {p.upper()}_SELFTEST\nint {p}_selftest({p}_memory *memory)\n{{\n"
        f"    static const float golden[{len(plan.golden)}] = {{{numbers}}};\n"
        f"    {p}_input input;\n    {p}_output output;\n"
        f"    int wrong = 0, at = 0;\n    for (int row = 0; row < {ROWS}; row++) {{\n"
        f"        {p}_reset(memory, 0);\n        memset(&input, 0, sizeof input);\n"
        + "\n".join([*lines, f"        wrong += {p}_compute(&input, memory, &output);", *tests])
        + "\n    }\n    return wrong;\n}\n#endif"
    )
