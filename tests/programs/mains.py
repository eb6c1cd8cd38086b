"""Programs around a policy's source code that print the bits of what it does, the same in every language."""

from __future__ import annotations

from collections.abc import Sequence

from converters.formats.programs.members import Field, Header
from converters.formats.programs.plan import formula

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


def _lines(statements: Sequence[str]) -> str:
    return "\n        ".join(statements)


def c_main(name: str, header: Header, classes: int = 0) -> str:
    """C99; ``classes`` are the branches that are drawn after each decision."""
    p, loop = header.prefix, "for (int i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "show(output.{n}[i])" if f.spec.dtype == "float32" else 'printf("%lld\\n", (long long)output.{n}[i])'
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = (
        f'{p}_choose(&memory, &output, classes);\n        {loop.format(n=classes)} printf("%d\\n", (int)classes[i]);'
    )
    return f"""#define {p.upper()}_IMPLEMENTATION
#include "{name}.h"
#include <stdio.h>
static {p}_memory memory;
static {p}_input input;
static {p}_output output;
static int32_t classes[{classes or 1}];
static void show(float x)
{{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    if (x != x) printf("nan\\n");
    else printf("%08lx\\n", (unsigned long)bits);
}}
int main(void)
{{
    {p}_reset(&memory, 5);
    (void)classes;
    (void)show;
    for (int row = 0; row < {STEPS}; row++) {{
        {_fills(header.inputs, loop, "input.", ".0f")}
        {p}_act(&input, &memory, &output);
        {_lines([*shows, *([drawn] if classes else [])])}
    }}
    return 0;
}}
"""


def csharp_main(name: str, header: Header, classes: int = 0) -> str:
    """C# 7."""
    loop = "for (int i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "Show(agent.{n}[i])" if f.spec.dtype == "float32" else "System.Console.WriteLine((long)agent.{n}[i])"
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = f"agent.Choose(classes);\n        {loop.format(n=classes)} System.Console.WriteLine(classes[i]);"
    return f"""static class Program
{{
    static void Show(float x)
    {{
        int bits = System.BitConverter.ToInt32(System.BitConverter.GetBytes(x), 0);
        System.Console.WriteLine(float.IsNaN(x) ? "nan" : bits.ToString("x8"));
    }}
    static void Main()
    {{
        var agent = new Policies.{header.class_name}(5);
        var classes = new int[{classes or 1}];
        for (int row = 0; row < {STEPS}; row++) {{
            {_fills(header.inputs, loop, "agent.", "f", ("false", "true"))}
            agent.Act();
            {_lines([*shows, *([drawn] if classes else [])])}
        }}
    }}
}}
"""


def js_main(name: str, header: Header, classes: int = 0) -> str:
    """An ES module."""
    loop = "for (let i = 0; i < {n}; i++)"
    shows = []
    for f in header.outputs:
        cast = "show(agent.{n}[i])" if f.spec.dtype == "float32" else "console.log(Number(agent.{n}[i]).toString())"
        shows.append(f"{loop.format(n=f.size)} {cast.format(n=f.name)};")
    drawn = f"agent.choose(classes);\n        {loop.format(n=classes)} console.log(String(classes[i]));"
    return f"""import {{ {header.class_name} }} from "./{name}.mjs";
const agent = new {header.class_name}(5), classes = new Int32Array({classes or 1});
function show(x) {{
    const bits = new Uint32Array(new Float32Array([x]).buffer)[0];
    console.log(Number.isNaN(x) ? "nan" : bits.toString(16).padStart(8, "0"));
}}
for (let row = 0; row < {STEPS}; row++) {{
    {_fills(header.inputs, loop, "agent.", "")}
    agent.act();
    {_lines([*shows, *([drawn] if classes else [])])}
}}
"""


#: Format → its program, and the file that it is.
MAINS = {"c": (c_main, "main.c"), "csharp": (csharp_main, "main.cs"), "js": (js_main, "main.mjs")}
