"""Policy to one C# class: every stage a loop nest, weights as static arrays, nothing to reference but System."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.csharp.text import CS_TYPES, CSharp
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.members import Field
from export_model.converters.formats.programs.plan import CLOSE, NAN_SAID, ROWS, Plan, formula, write_program
from export_model.converters.formats.programs.weights import weights_name
from export_model.converters.graph.ops.loops.layers import box_muller, gumbel
from export_model.converters.graph.printer import Printer
from export_model.converters.graph.program import Place
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role

_UNIFORM = """
    /// <summary>The stream of draws, splitmix64: above 0, below 1. The same seed, the same draws as in C.</summary>
    float _Uniform()
    {
        unchecked
        {
            ulong z = stream += 0x9E3779B97F4A7C15UL;
            z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9UL;
            z = (z ^ (z >> 27)) * 0x94D049BB133111EBUL;
            z ^= z >> 31;
            return ((float)(int)(z >> 41) + 0.5f) * 1.1920928955078125e-7f;
        }
    }
""".strip("\n")
_NORMAL = """
    /// <summary>Draws from N(0, 1), by Box and Muller.</summary>
    void _Normal(float[] drawn)
    {
        for (int i = 0; i < drawn.Length; i++) {
            float radius = _Uniform(), turn = _Uniform();
            drawn[i] = $X;
        }
    }
""".strip("\n")


_LOAD = """
/// <summary>Takes the weights of all agents: the content of $FILE.</summary>
/// <exception cref="System.IO.InvalidDataException">It is another file's, or damaged.</exception>
public static void Load(global::System.IO.Stream stream)
{
    var bytes = new byte[$SIZE];
    int size = 0;
    for (int read; size < bytes.Length && (read = stream.Read(bytes, size, bytes.Length - size)) > 0; ) size += read;
    if (size < bytes.Length || stream.ReadByte() >= 0)
        throw new global::System.IO.InvalidDataException("the weights are not $SIZE bytes");
    uint crc = 0xFFFFFFFFu;
    foreach (byte one in bytes) {
        crc ^= one;
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1) != 0 ? 0xEDB88320u : 0u);
    }
    if (~crc != $SUM) throw new global::System.IO.InvalidDataException("the weights have another checksum");
$LINES    _loaded = true;
}
"""


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The class. Raises UnsupportedOpError."""
    return write_program(policy, options, ".cs", _text)


def _text(file: str, plan: Plan) -> str:
    header, program = plan.header, plan.program
    name = header.class_name
    words = CSharp(plan.code.math == "own")
    printer = Printer(words, "w_", (name, *sorted({f.name for f in (*header.fed, *header.answered)})))
    by_name = {f.spec.name: f for f in header.fed}
    for key, tensor in program.inputs.items():
        printer.called(tensor.place, by_name[key].name)
    body = _compute_lines(plan, printer)
    places = [
        (printer.name(s.result.place), CS_TYPES[s.result.dtype.name], s.result.place.size) for s in program.stages
    ]
    draws = plan.draws(printer)
    members = [
        _sizes(plan),
        "    // What the agent observes.\n" + "".join(map(_member, header.inputs)),
        "    // What it keeps: the stream of its draws, noise, its state.\n"
        + ("    ulong stream;\n" if draws else "")
        + "".join(_member(f) for f in header.own_values),
        "    // What it does.\n" + "".join(map(_member, header.outputs)),
        "    // For computing.\n" + "".join(f"    readonly {k}[] {n} = new {k}[{size}];\n" for n, k, size in places),
    ]
    methods = [
        *_beginning(name, plan, draws=draws),
        "    /// <summary>Decides: draws the noise where there is some, then computes.</summary>\n"
        + _copy_remark(plan)
        + "    public void Act()\n    {\n"
        + "".join(f"        _Normal(this.{f.name});\n" for f in header.noise)
        + "        Compute();\n    }",
        f"    /// <summary>Computes {plan.chance(printer, 'its members')}.</summary>\n"
        '    /// <exception cref="System.IndexOutOfRangeException">An observed index lies outside.</exception>\n'
        "    public void Compute()\n    {\n" + "\n".join(body) + "\n    }",
        *([_choose(plan.chosen, plan.sizes, printer)] if plan.chosen else []),
        *([_unusual(plan, words)] if plan.guarded else []),
        _selftest(plan, words),
        *([_UNIFORM] if draws else []),
        *([_NORMAL.replace("$X", printer.function(box_muller, "radius", "turn"))] if header.noise else []),
    ]
    constants = _weights(file, plan, words, printer, body)
    inner = [*(m.rstrip("\n") for m in members), *methods]
    if words.helpers:
        inner += ["\n".join(f"    {line}" for line in h.splitlines()) for h in words.helpers.values()]
    inner += ["\n".join(f"    {line}" for line in c.splitlines()) for c in constants]
    return (
        f"/* {name}: a policy without a runtime, C# 7.3 for .NET Standard 2.0: every Unity since 2018, Godot .NET.\n"
        f"   Made by export-model.\n\n{plan.contract}\n\nnamespace Policies\n{{\n\n"
        f"/// <summary>One agent: what it observes, keeps and does are its members. {NAN_SAID}</summary>\n"
        f"public sealed class {name}\n{{\n" + "\n\n".join(inner) + "\n}\n\n}\n"
    )


def _compute_lines(plan: Plan, printer: Printer) -> list[str]:
    """The lines of ``Compute``: arrays as locals, the loops, and what is handed on."""
    header, program = plan.header, plan.program
    statements = printer.body(program, depth=2)
    fields = [*printer.inputs(program), *(s.result.place for s in program.stages)]
    lines = [f"        {CS_TYPES[p.dtype.name]}[] {(n := printer.name(p))} = this.{n};" for p in fields]
    statics = [(printer.name(p), CS_TYPES[p.dtype.name]) for p in _read_whole(plan, printer, statements)]
    statics += [(name, "_Block") for name in printer.packed]
    lines += [f"        {kind}[] {n} = {header.class_name}.{n};" for n, kind in statics]  # looked up once
    lines += statements
    if plan.weights.file is not None:
        wrong = 'throw new global::System.InvalidOperationException("load the weights first");'
        lines.insert(0, f"        if (!_loaded) {wrong}")
    for f in header.answered:
        target = header.state if f is header.next_state and header.state else f
        source = printer.name(program.outputs[f.spec.name].place)
        lines.append(f"        global::System.Array.Copy({source}, this.{target.name}, {f.size});")
    return lines


def _read_whole(plan: Plan, printer: Printer, lines: Sequence[str]) -> list[Place]:
    """The constants that statements or outputs read as arrays, not in blocks alone."""
    words = {*re.findall(r"\w+", "\n".join(lines))}
    given = {id(t.place) for t in plan.program.outputs.values()}
    return [p for p in plan.program.constants if id(p) in given or printer.name(p) in words]


def _beginning(name: str, plan: Plan, *, draws: bool) -> list[str]:
    """The constructor and ``Reset``."""
    header = plan.header
    quiet = "".join(f"        global::System.Array.Clear(this.{f.name}, 0, {f.size});\n" for f in header.own_values)
    stream = "        stream = seed;\n" if draws else ""
    allowed = "".join(
        f"        for (int i = 0; i < {f.size}; i++) this.{f.name}[i] = {_one(f, '1')};\n" for f, _ in plan.masks
    )
    return [
        "    /// <summary>A new agent, whose draws begin with a seed.</summary>\n"
        f"    public {name}(ulong seed = 0)\n    {{\n{allowed}        Reset(seed);\n    }}",
        "    /// <summary>Begins an episode: no state, draws by a seed.</summary>\n"
        f"    public void Reset(ulong seed = 0)\n    {{\n{stream}{quiet}    }}",
    ]


def _copy_remark(plan: Plan) -> str:
    """What is left to the caller of ``Act``."""
    names = ", ".join(f.name for f in plan.header.inputs if f.spec.role is Role.PREV_ACTION)
    return f"    /// <remarks>It does not change {names}: copy there what was done.</remarks>\n" if names else ""


def _sizes(plan: Plan) -> str:
    """The contract's numbers as constants."""
    rows = [f"public const int {f.name} = {f.size};" for f in (*plan.header.fed, *plan.header.outputs)]
    branches = f"new int[] {{ {', '.join(map(str, plan.sizes))} }}" if plan.sizes else "new int[0]"
    return (
        "    /// <summary>How many numbers each member has.</summary>\n    public static class Sizes\n    {\n"
        + "".join(f"        {row}\n" for row in rows)
        + "    }\n\n    /// <summary>How many actions each branch has.</summary>\n"
        + f"    public static readonly int[] Branches = {branches};\n"
    )


def _weights(file: str, plan: Plan, words: CSharp, printer: Printer, body: Sequence[str]) -> list[str]:
    """The constants, and the method that loads those that are in the file."""
    whole = {id(p) for p in _read_whole(plan, printer, body)}
    here, members, lines = list[str](), list[str](), list[str]()
    for kept in plan.weights.kept:
        name, kind, text = printer.name(kept.place), CS_TYPES[kept.place.dtype.name], words.constant(kept)
        blocks = [(called, p) for called, p in printer.packed.items() if p.place is kept.place]
        stays = id(kept.place) in whole or len(blocks) > 1
        if kept.offsets:
            members += [f"static {kind}[] {name};"] * stays + [f"static _Block[] {called};" for called, _ in blocks]
            lines.append(f"    {'' if stays else f'{kind}[] '}{name} = {text};\n")
            lines += [f"    {called} = {words.blocks_of(p, name)};\n" for called, p in blocks]
        else:
            here += [f"static readonly {kind}[] {name} = {text};"] * stays
            array = name if stays else text
            here += [f"static readonly _Block[] {called} = {words.blocks_of(p, array)};" for called, p in blocks]
    if plan.weights.file is None:
        return here
    load = _LOAD.replace("$FILE", weights_name(file)).replace("$SIZE", str(len(plan.weights.file)))
    load = load.replace("$SUM", f"0x{plan.weights.checksum:08X}u").replace("$LINES", "".join(lines)).strip("\n")
    return [*here, "\n".join(["static bool _loaded;", *members]), load]


def _unusual(plan: Plan, words: CSharp) -> str:
    """The method that counts what training did not see."""
    kind, arrays, loops = np.dtype(np.float32), list[str](), list[str]()
    for guarded in plan.guarded:
        name = guarded.field.name
        for called, values in (("mean", guarded.mean), ("limit", guarded.limit)):
            literals = ", ".join(words.literal(x, kind) for x in values)
            arrays.append(f"    static readonly float[] _{called}_{name} = {{ {literals} }};\n")
        off = f"global::System.Math.Abs(this.{name}[i] - _mean_{name}[i])"
        loops.append(f"        for (int i = 0; i < {guarded.field.size}; i++)\n")
        loops.append(f"            if (!({off} <= _limit_{name}[i])) count++;\n")
    return (
        f"{''.join(arrays)}\n    /// <summary>How many observed numbers lie farther than {plan.code.guard:g} standard "
        "deviations from their mean in training; NaN does.</summary>\n"
        f"    public int Unusual()\n    {{\n        int count = 0;\n{''.join(loops)}        return count;\n    }}"
    )


def _member(field: Field) -> str:
    kind = CS_TYPES[field.spec.dtype]
    return f"    public readonly {kind}[] {field.name} = new {kind}[{field.size}]; // {field.about}\n"


def _choose(field: Field, sizes: Sequence[int], printer: Printer) -> str:
    """The method that draws classes by their log-probabilities, by the Gumbel trick."""
    return (
        f"    static readonly int[] _branches = {{ {', '.join(map(str, sizes))} }};\n\n"
        "    /// <summary>Draws a class for each branch.</summary>\n    public void Choose(int[] classes)\n    {\n"
        "        int start = 0;\n        for (int branch = 0; branch < _branches.Length; branch++) {\n"
        "            float best = float.NegativeInfinity;\n            classes[branch] = 0;\n"
        "            for (int i = 0; i < _branches[branch]; i++) {\n"
        "                float u = _Uniform();\n"
        f"                float drawn = {printer.function(gumbel, f'this.{field.name}[start + i]', 'u')};\n"
        "                if (best < drawn) { best = drawn; classes[branch] = i; }\n            }\n"
        "            start += _branches[branch];\n        }\n    }"
    )


def _selftest(plan: Plan, words: CSharp) -> str:
    """Golden rows: inputs by a formula, what the kernels make of them."""
    head = (
        "    /// <summary>How many numbers are not what the policy's own kernels computed: 0.</summary>\n"
        "    public int SelfTest()\n    {\n"
    )
    if not plan.golden:
        return f"{head}        return 0;\n    }}"
    numbers = ", ".join(words.literal(x, np.dtype(np.float32)) for x in plan.golden)
    fed = "".join(
        f"            for (int i = 0; i < {f.size}; i++) this.{f.name}[i] = "
        f"{_one(f, formula(f, '((i * 7 + row * 5) % 17 - 8) / 8f'))};\n"
        for f in plan.header.inputs
    )
    checks = "".join(f"            wrong += _Wrong(this.{f.name}, golden, ref at);\n" for f in plan.checked)
    return (
        f"{head}        float[] golden = {{ {numbers} }}; // NaN: not compared\n        int wrong = 0, at = 0;\n"
        f"        for (int row = 0; row < {ROWS}; row++) {{\n            Reset(0);\n{fed}"
        f"            Compute();\n{checks}"
        "        }\n        return wrong;\n    }\n\n"
        "    static int _Wrong(float[] answer, float[] golden, ref int at)\n    {\n        int wrong = 0;\n"
        "        foreach (float x in answer) {\n            float y = golden[at++];\n"
        f"            float most = {CLOSE}f * (1 + global::System.Math.Abs(y));\n"
        "            if (!float.IsNaN(y) && !(global::System.Math.Abs(x - y) <= most)) wrong++;\n"
        "        }\n        return wrong;\n    }"
    )


def _one(field: Field, text: str) -> str:
    return {"1": "true", "0": "false"}[text] if field.spec.dtype == "bool" else text
