"""Programs around a policy's source code that print the bits of what it does, the same in every language."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.members import Field, Header
from export_model.converters.formats.programs.plan import formula, plan_of
from export_model.converters.formats.programs.weights import weights_name
from export_model.converters.policy.policy import Policy
from export_model.signatures.code import CodeOptions

#: Each has another observation, in every language by the same formula.
STEPS = 6
_NUMBER = "((i * 7 + row * 5) % 17 - 8) / 8{f}"


def _fills(fields: Sequence[Field], loop: str, member: str, suffix: str, truths: tuple[str, str] = ("0", "1")) -> str:
    lines = []
    for f in fields:
        value = formula(f, ("(float)" if suffix else "") + _NUMBER.format(f=suffix))
        value = truths[int(value)] if f.spec.dtype == "bool" else value
        lines.append(f"{loop.format(n=f.size)} {member}{f.name}[i] = {value};")
    return "\n        ".join(lines)


def _lines(statements: Sequence[str], indent: str = "        ") -> str:
    return f"\n{indent}".join(statements)


class Called(NamedTuple):
    """A policy in a program: its file's stem, its members, branches that are drawn after each decision, its weights."""

    name: str
    header: Header
    classes: int = 0
    weights: str = ""


def called(policy: Policy, code: CodeOptions | None = None) -> Called:
    """A policy as a program calls it."""
    code = code or CodeOptions()
    plan = plan_of(policy, WriteOptions("{}", code=code))
    file = weights_name(policy.name) if code.weights == "file" else ""
    return Called(policy.name, plan.header, len(plan.sizes) if plan.chosen else 0, file)


def c_main(*policies: Called) -> str:
    """C99."""
    parts = [_c_part(*each) for each in policies]
    upper = [f"#define {each.header.prefix.upper()}" for each in policies]
    includes = [
        f'{word}_IMPLEMENTATION\n{word}_SELFTEST\n#include "{each.name}.h"'
        for word, each in zip(upper, policies, strict=True)
    ]
    runs = "\n".join(f"    run_{each.header.prefix}();" for each in policies)
    return f"""{_lines(includes, "")}
#include <stdio.h>
static void show(float x)
{{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    if (x != x) printf("nan\\n");
    else printf("%08lx\\n", (unsigned long)bits);
}}
{_lines(parts, "")}
int main(void)
{{
    (void)show;
{runs}
    return 0;
}}
"""


def _c_part(name: str, header: Header, classes: int, weights: str) -> str:
    p, loop = header.prefix, "for (int i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "show(output.{n}[i])" if f.spec.dtype == "float32" else 'printf("%lld\\n", (long long)output.{n}[i])'
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = (
        f'{p}_choose(&memory, &output, classes);\n        {loop.format(n=classes)} printf("%d\\n", (int)classes[i]);'
    )
    load = (
        f"""static uint32_t weights[{p}_weights_size / 4 + 1];
    FILE *const file = fopen("{weights}", "rb");
    const size_t size = fread(weights, 1, sizeof weights, file);
    fclose(file);
    if ({p}_load(&memory, weights, size) != 0) printf("refused\\n");
    """
        if weights
        else ""
    )
    return f"""static void run_{p}(void)
{{
    static {p}_memory memory;
    static {p}_input input;
    static {p}_output output;
    static int32_t classes[{classes or 1}];
    {load}if ({p}_selftest(&memory) != 0) printf("missed\\n");
    {p}_reset(&memory, 5);
    (void)classes;
    for (int row = 0; row < {STEPS}; row++) {{
        {_fills(header.inputs, loop, "input.", ".0f")}
        {p}_act(&input, &memory, &output);
        {_lines([*shows, *([drawn] if classes else [])])}
    }}
}}"""


def csharp_main(*policies: Called) -> str:
    """C# 7."""
    return f"""static class Program
{{
    static void Show(float x)
    {{
        int bits = System.BitConverter.ToInt32(System.BitConverter.GetBytes(x), 0);
        System.Console.WriteLine(float.IsNaN(x) ? "nan" : bits.ToString("x8"));
    }}
    static void Main()
    {{
    {_lines([_csharp_part(*each) for each in policies], "    ")}
    }}
}}
"""


def _csharp_part(name: str, header: Header, classes: int, weights: str) -> str:
    loop = "for (int i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "Show(agent.{n}[i])" if f.spec.dtype == "float32" else "System.Console.WriteLine((long)agent.{n}[i])"
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = f"agent.Choose(classes);\n        {loop.format(n=classes)} System.Console.WriteLine(classes[i]);"
    load = f'Policies.{header.class_name}.Load(System.IO.File.OpenRead("{weights}"));\n        ' if weights else ""
    return f"""    {{
        {load}var agent = new Policies.{header.class_name}(5);
        if (agent.SelfTest() != 0) System.Console.WriteLine("missed");
        agent.Reset(5);
        var classes = new int[{classes or 1}];
        for (int row = 0; row < {STEPS}; row++) {{
            {_fills(header.inputs, loop, "agent.", "f", ("false", "true"))}
            agent.Act();
            {_lines([*shows, *([drawn] if classes else [])])}
        }}
    }}"""


def js_main(*policies: Called) -> str:
    """An ES module."""
    imports = [f'import * as module_{each.header.prefix} from "./{each.name}.mjs";' for each in policies]
    return f"""import {{ readFileSync }} from "node:fs";
{_lines(imports, "")}
function show(x) {{
    const bits = new Uint32Array(new Float32Array([x]).buffer)[0];
    console.log(Number.isNaN(x) ? "nan" : bits.toString(16).padStart(8, "0"));
}}
{_lines([_js_part(*each) for each in policies], "")}
"""


def _js_part(name: str, header: Header, classes: int, weights: str) -> str:
    loop = "for (let i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "show(agent.{n}[i])" if f.spec.dtype == "float32" else "console.log(Number(agent.{n}[i]).toString())"
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = f"agent.choose(classes);\n        {loop.format(n=classes)} console.log(String(classes[i]));"
    load = f'module_{header.prefix}.load(readFileSync("{weights}"));\n    ' if weights else ""
    return f"""{{
    {load}const agent = new module_{header.prefix}.{header.class_name}(5), classes = new Int32Array({classes or 1});
    if (agent.selftest() !== 0) console.log("missed");
    agent.reset(5);
    for (let row = 0; row < {STEPS}; row++) {{
        {_fills(header.inputs, loop, "agent.", "")}
        agent.act();
        {_lines([*shows, *([drawn] if classes else [])])}
    }}
}}"""


#: Format → its program, and the file that it is.
MAINS = {"c": (c_main, "main.c"), "csharp": (csharp_main, "main.cs"), "js": (js_main, "main.mjs")}
