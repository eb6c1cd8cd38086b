"""Policy to one ES module: every stage a loop nest, weights as typed arrays, nothing to import."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.js.text import JS_ARRAYS, JavaScript
from export_model.converters.formats.programs.members import Field
from export_model.converters.formats.programs.plan import CLOSE, NAN_SAID, ROWS, Plan, formula, plan_of, write_program
from export_model.converters.formats.programs.weights import weights_name
from export_model.converters.graph.ops.loops.layers import box_muller, gumbel
from export_model.converters.graph.printer import Printer
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role

_UNIFORM = """
    /** The stream of draws, splitmix64: above 0, below 1. The same seed gives the same draws as in C and C#. */
    _uniform() {
        this.stream = BigInt.asUintN(64, this.stream + 0x9E3779B97F4A7C15n);
        let z = this.stream;
        z = BigInt.asUintN(64, (z ^ (z >> 30n)) * 0xBF58476D1CE4E5B9n);
        z = BigInt.asUintN(64, (z ^ (z >> 27n)) * 0x94D049BB133111EBn);
        z ^= z >> 31n;
        return (Number(z >> 41n) + 0.5) * 1.1920928955078125e-7;
    }
""".strip("\n")
_NORMAL = """
    /** Draws from N(0, 1), by Box and Muller. */
    _normal(out) {
        for (let i = 0; i < out.length; i++) {
            const radius = this._uniform(), turn = this._uniform();
            out[i] = $X;
        }
    }
""".strip("\n")


_LOAD = """
/** Takes the weights: the content of $FILE, an ArrayBuffer or a Uint8Array. Throws where it is another file's. */
export function load(content) {
    const bytes = content instanceof ArrayBuffer ? new Uint8Array(content) : Uint8Array.from(content);
    let crc = -1;
    for (const byte of bytes) {
        crc ^= byte;
        for (let bit = 0; bit < 8; bit++) crc = crc >>> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    if (bytes.length !== $SIZE) throw new RangeError(`the weights are ${bytes.length} bytes, not $SIZE`);
    if (~crc >>> 0 !== $SUM) throw new RangeError("the weights have another checksum");
$LINES    _loaded = true;
}
"""


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The module. Raises UnsupportedOpError."""
    return write_program(policy, options, ".mjs", _text)


class WrittenModule(Struct, frozen=True):
    """A module: its text, its class, the content of its file of weights, the shape of each float32 constant by name."""

    text: str
    class_name: str
    file: bytes
    weights: Mapping[str, tuple[int, ...]]


def write_module(policy: Policy, options: WriteOptions) -> WrittenModule:
    """Write the module of a policy for who looks into it. Raises UnsupportedOpError."""
    plan = plan_of(policy, options)
    text, printer = _module(policy.name, plan)
    places = [kept.place for kept in plan.weights.kept if kept.place.dtype == np.float32]
    shapes = {printer.name(p): p.value.shape for p in places if p.value is not None}
    return WrittenModule(text, plan.header.class_name, plan.weights.file or b"", shapes)


def _text(name: str, plan: Plan) -> str:
    return _module(name, plan)[0]


def _module(name: str, plan: Plan) -> tuple[str, Printer]:
    """The module, and what printed it: it knows the names of constants."""
    header, program = plan.header, plan.program
    taken = ("fround", header.class_name, *sorted({f.name for f in (*header.fed, *header.answered)}))
    words = JavaScript(plan.code.math == "own")
    printer = Printer(words, "w_", taken)
    by_name = {f.spec.name: f.name for f in header.fed}
    for key, tensor in program.inputs.items():
        printer.called(tensor.place, by_name[key])
    body = _compute_lines(plan, printer)
    weights = _weights(name, plan, words, printer)
    places = [stage.result.place for stage in program.stages]
    draws = plan.draws(printer)
    drawn = "".join(f"        this._normal(this.{f.name});\n" for f in header.noise)
    methods = [
        "    /** A new agent, whose draws begin with a seed. */\n    constructor(seed = 0) {\n"
        + "".join(_member(f) for f in (*header.fed, *header.outputs))
        + "".join(f"        this.{printer.name(p)} = new {JS_ARRAYS[p.dtype.name]}({p.size});\n" for p in places)
        + "        this.reset(seed);\n    }",
        "    /** Begins an episode: no state, draws by a seed. */\n    reset(seed = 0) {\n"
        + "        this.stream = BigInt.asUintN(64, BigInt(seed));\n"
        + "".join(f"        this.{f.name}.fill(0);\n" for f in header.own_values)
        + "    }",
        "    /** Decides: draws the noise where there is some, then computes. */\n    act() {\n"
        + f"{drawn}        this.compute();\n    }}",
        f"    /** Computes {plan.chance(printer, 'its members')}.\n"
        "     *  Throws a RangeError where an observed index lies outside of its table. */\n    compute() {\n"
        + "\n".join(body)
        + "\n    }",
        *([_choose(plan.chosen, plan.sizes, printer)] if plan.chosen else []),
        *([_unusual(plan, words)] if plan.guarded else []),
        _selftest(plan, words),
        *([_UNIFORM] if draws else []),
        *([_NORMAL.replace("$X", printer.function(box_muller, "radius", "turn"))] if header.noise else []),
    ]
    parts = [
        f"/* {header.class_name}: a policy without a runtime, for browsers, Node and others that have ES modules:\n"
        f'       import {{ {header.class_name} }} from "./{name}.mjs";\n'
        f"   Made by export-model.\n\n{plan.contract}",
        "const { fround } = Math;",
        *words.helpers.values(),
        *weights,
        f"/** One agent: what it observes, keeps and does are its members, arrays that live as long as it.\n"
        f" *  {NAN_SAID} */\n"
        f"export class {header.class_name} {{\n" + "\n\n".join(methods) + "\n}",
        "/** Names of the contract: [member, dtype, shape]; the state's member, and the name of its next value. */\n"
        f"export const ports = {json.dumps(_ports(plan))};",
        f"export default {header.class_name};",
    ]
    return "\n\n".join(parts) + "\n", printer


def _compute_lines(plan: Plan, printer: Printer) -> list[str]:
    """The lines of ``compute``: the loops, and what is handed on."""
    header, program = plan.header, plan.program
    statements = printer.body(program, depth=2)
    results = (printer.name(stage.result.place) for stage in program.stages)
    aliases = sorted({*(printer.name(p) for p in printer.inputs(program)), *results})
    lines = [f"        const {{ {', '.join(aliases)} }} = this;"] if aliases else []
    if plan.weights.file is not None:
        lines.insert(0, '        if (!_loaded) throw new Error("load the weights first");')
    lines += statements
    for f in header.answered:
        target = header.state if f is header.next_state and header.state else f
        source = printer.name(program.outputs[f.spec.name].place)
        lines.append(f"        this.{target.name}.set({source});")
    return lines


def _ports(plan: Plan) -> dict[str, Any]:
    """Names of the contract, the branches and the state, as the module exports them."""
    header = plan.header
    ports: dict[str, Any] = {
        kind: {f.spec.name: [f.name, f.spec.dtype, list(f.spec.shape)] for f in some}
        for kind, some in (("inputs", header.fed), ("outputs", header.outputs))
    }
    state = [header.state.name, header.next_state.spec.name] if header.state and header.next_state else None
    return {**ports, "branches": list(plan.sizes), "state": state}


def _weights(name: str, plan: Plan, words: JavaScript, printer: Printer) -> list[str]:
    """The constants, and the function that loads those that are in the file."""
    named = [(printer.name(kept.place), kept) for kept in plan.weights.kept]
    parts = [f"const {n} = {words.constant(kept)};" for n, kept in named if not kept.offsets]
    if plan.weights.file is None:
        return parts
    inside = [(n, kept) for n, kept in named if kept.offsets]
    lines = "".join(f"    {n} = {words.constant(kept)};\n" for n, kept in inside)
    load = _LOAD.replace("$FILE", weights_name(name)).replace("$SIZE", str(len(plan.weights.file)))
    load = load.replace("$SUM", f"0x{plan.weights.checksum:08X}").replace("$LINES", lines).strip("\n")
    return [*parts, "\n".join(["let _loaded = false;", *(f"let {n};" for n, _ in inside)]), load]


def _unusual(plan: Plan, words: JavaScript) -> str:
    """The method that counts what training did not see."""
    kind, lines = np.dtype(np.float32), list[str]()
    for guarded in plan.guarded:
        mean, limit = (", ".join(words.literal(x, kind) for x in v) for v in (guarded.mean, guarded.limit))
        one = f"this.{guarded.field.name}"
        lines.append(f"        {{\n            const mean = [{mean}], limit = [{limit}];\n")
        lines.append(
            f"            {one}.forEach((x, i) => {{ if (!(Math.abs(x - mean[i]) <= limit[i])) count++; }});\n"
        )
        lines.append("        }\n")
    return (
        f"    /** How many observed numbers lie farther than {plan.code.guard:g} standard deviations from their mean\n"
        "     *  in training; NaN does. */\n    unusual() {\n        let count = 0;\n"
        f"{''.join(lines)}        return count;\n    }}"
    )


def _member(field: Field) -> str:
    allowed = ".fill(1)" * (field.spec.role is Role.MASKS)
    return f"        this.{field.name} = new {JS_ARRAYS[field.spec.dtype]}({field.size}){allowed}; // {field.about}\n"


def _choose(field: Field, sizes: Sequence[int], printer: Printer) -> str:
    """The method that draws classes by their log-probabilities, by the Gumbel trick."""
    return (
        "    /** Draws a class for each branch. */\n    choose(action) {\n"
        f"        let start = 0;\n        [{', '.join(map(str, sizes))}].forEach((size, branch) => {{\n"
        "            let best = -Infinity;\n            action[branch] = 0;\n"
        "            for (let i = 0; i < size; i++) {\n"
        f"                const u = this._uniform();\n"
        f"                const drawn = {printer.function(gumbel, f'this.{field.name}[start + i]', 'u')};\n"
        "                if (best < drawn) { best = drawn; action[branch] = i; }\n            }\n"
        "            start += size;\n        });\n        return action;\n    }"
    )


def _selftest(plan: Plan, words: JavaScript) -> str:
    """Golden rows: inputs by a formula, what the kernels make of them."""
    numbers = ", ".join(words.literal(x, np.dtype(np.float32)) for x in plan.golden)
    head = (
        "    /** How many numbers are not what the policy's own kernels computed at export: 0. */\n    selftest() {\n"
    )
    if not plan.golden:
        return f"{head}        return 0;\n    }}"
    fed = "".join(
        f"            for (let i = 0; i < {f.size}; i++) this.{f.name}[i] = "
        f"{formula(f, '((i * 7 + row * 5) % 17 - 8) / 8')};\n"
        for f in plan.header.inputs
    )
    names = ", ".join(f"...this.{f.name}" for f in plan.checked)
    return (
        f"{head}        const golden = [{numbers}]; // NaN: not compared\n        let wrong = 0, at = 0;\n"
        f"        for (let row = 0; row < {ROWS}; row++) {{\n            this.reset(0);\n{fed}"
        f"            this.compute();\n            for (const x of [{names}]) {{\n"
        "                const y = golden[at++];\n"
        f"                if (y === y && !(Math.abs(x - y) <= {CLOSE} * (1 + Math.abs(y)))) wrong++;\n            }}\n"
        "        }\n        return wrong;\n    }"
    )
