"""Snippets in C#: TensorFlowSharp with the ``.bytes``, Unity Inference Engine (Sentis) with the ``.onnx``."""

from __future__ import annotations

from export_model.converters.formats.programs.members import header_of
from export_model.exporter.snippets.contract import (
    ODDS,
    STEPS,
    SnippetBundle,
    action_meaning,
    class_name,
    example_shape,
    example_size,
    fill_template,
    identifier,
    meaning,
    string_literal,
)
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

_TYPES = {
    "float16": "Half",
    "float32": "float",
    "float64": "double",
    "bool": "bool",
    "int8": "sbyte",
    "int16": "short",
    "int32": "int",
    "int64": "long",
    "uint8": "byte",
    "uint16": "ushort",
    "uint32": "uint",
    "uint64": "ulong",
}


# ------------------------------------------------------------------ TensorFlowSharp


def tensorflowsharp(bundle: SnippetBundle) -> str:
    """TFGraph and TFSession."""
    before, lines = bundle.beginnings("var {} = {};  // {}", _array), ["var runner = session.GetRunner();"]
    memory, previous = bundle.memory, bundle.previous
    for spec in bundle.signature.inputs:
        lines += [f"// {line}" for line in meaning(bundle, spec)]
        value = bundle.kept_variables.get(spec.name) or _array(spec)
        lines.append(f"runner.AddInput(graph[{string_literal(spec.name)}][0], {value});")
    fetched = bundle.fetched_outputs
    outputs = [*fetched.values()] if memory is None else [*fetched.values(), bundle.signature.output(memory[1])]
    lines += [f"runner.Fetch(graph[{string_literal(spec.name)}][0]);" for spec in outputs]
    lines.append("TFTensor[] output = runner.Run();")
    for i, (name, spec) in enumerate(fetched.items()):
        lines += [f"// {line}" for line in action_meaning(bundle, bundle.heads[i])]
        value = f"({_kind(spec)})output[{i}].GetValue()"
        lines += _likeliest(bundle, name, value, "1, ", "0, ") if spec.role in ODDS else [f"var {name} = {value};"]
    if memory is not None:
        lines.append(f"memory = ({_kind(bundle.signature.output(memory[1]))})output[{len(fetched)}].GetValue();")
    if previous is not None:
        place = "[branch]" if len(previous.shape) == 1 else "[0, branch]"
        lines += [
            f"for (var branch = 0; branch < {bundle.discrete_variable}.GetLength(1); branch++)",
            f"    previous{place} = ({_TYPES[previous.dtype]}){bundle.discrete_variable}[0, branch];",
        ]
    lines += [
        f"for (var i = 0; i < {name}.GetLength(1); i++)\n    Console.WriteLine({name}[0, i]);" for name in fetched
    ]
    lines = [part for line in lines for part in line.split("\n")]
    if bundle.remembers:
        lines = [f"for (var step = 0; step < {STEPS}; step++)", "{", *(f"    {line}" for line in lines), "}"]
    play = "\n".join(f"            {line}" for line in [*before, *lines])
    return fill_template(
        "tensorflowsharp.cs",
        type=class_name(bundle.name),
        path=string_literal(bundle.path(f"{bundle.name}.bytes")),
        play=play,
    )


def _likeliest(bundle: SnippetBundle, name: str, value: str, rows: str = "", row: str = "") -> list[str]:
    """Lines that take the likeliest class of each branch, of odds [1, ΣB] (``rows`` and ``row``) or [ΣB]."""
    return [
        f"var odds = {value};",
        f"int[] sizes = {{ {', '.join(map(str, bundle.signature.branches))} }};",
        f"var {name} = new int[{rows}sizes.Length];",
        "for (int branch = 0, start = 0; branch < sizes.Length; start += sizes[branch++])",
        "    for (var i = 1; i < sizes[branch]; i++)",
        f"        if (odds[{row}start + i] > odds[{row}start + {name}[{row}branch]]) {name}[{row}branch] = i;",
    ]


def _kind(spec: TensorSpec) -> str:
    """The C# type of an array: ``float[,]``."""
    return f"{_TYPES[spec.dtype]}[{',' * (len(spec.shape) - 1)}]"


def _array(spec: TensorSpec) -> str:
    shape, kind = example_shape(spec), _TYPES[spec.dtype]
    if not shape:
        return f"new TFTensor(({kind})0)"
    if spec.role is not Role.MASKS:
        return f"new {kind}[{', '.join(map(str, shape))}]"
    one = {"float": "1f", "bool": "true"}.get(kind, "1")
    return f"new {kind}[,] {{ {{ {', '.join([one] * shape[-1])} }} }}"


# ------------------------------------------------------------------ Inference Engine


def inference_engine(bundle: SnippetBundle) -> str:
    """ModelLoader and Worker. The engine has float and int tensors; int64 becomes int."""
    previous, kept = bundle.previous, bundle.kept_variables
    fields = [
        f"    float[] {variable} = new float[{example_size(taken)}];  // the start of an episode"
        for taken, _, variable in bundle.memories
    ]
    if previous is not None:
        fields.append(f"    int[] previous = new int[{example_size(previous)}];  // no action yet")
    parameters, body = [], []
    for spec in bundle.signature.inputs:
        variable = kept.get(spec.name) or identifier(spec.name)
        kind = "float" if spec.dtype == "float32" else "int"
        body += [f"// {line}" for line in meaning(bundle, spec)]
        shape = f"new TensorShape({', '.join(map(str, example_shape(spec)))})"
        tensor = f"{identifier(spec.name)}Tensor"
        if spec.role is Role.NOISE:
            body.append(f"using var {tensor} = new Tensor<{kind}>({shape}, new {kind}[{example_size(spec)}]);")
        else:
            body.append(f"using var {tensor} = new Tensor<{kind}>({shape}, {variable});")
            if spec.name not in kept:
                parameters.append(f"{kind}[] {variable}")
        body.append(f"worker.SetInput({string_literal(spec.name)}, {tensor});")
    body.append("worker.Schedule();")
    fetched = bundle.fetched_outputs
    for (name, spec), head in zip(fetched.items(), bundle.heads, strict=True):
        body += [f"// {line}" for line in action_meaning(bundle, head)]
        body.append(_read(spec, f"{name}Tensor"))
        value = f"{name}Tensor.DownloadToArray()"
        body += _likeliest(bundle, name, value) if spec.role in ODDS else [f"var {name} = {value};"]
    for _, given, variable in bundle.memories:
        body.append(_read(bundle.signature.output(given), f"{variable}Tensor"))
        body.append(f"{variable} = {variable}Tensor.DownloadToArray();")
    if previous is not None:
        body.append(f"previous = {bundle.discrete_variable};")
    kinds = ["float[]" if s.is_continuous else "int[]" for s in bundle.heads]
    if len(fetched) == 1:
        result, answer = kinds[0], next(iter(fetched))
    else:
        result = f"({', '.join(f'{kind} {name}' for kind, name in zip(kinds, fetched, strict=True))})"
        answer = f"({', '.join(fetched)})"
    body.append(f"return {answer};")
    methods = [f"public {result} Decide({', '.join(parameters)})", "{", *(f"    {line}" for line in body), "}", ""]
    if kept:
        reset = [f"    {line.split('  //')[0].strip().split(' ', 1)[1]}" for line in fields]
        methods += ["public void BeginEpisode()", "{", *reset, "}", ""]
    return fill_template(
        "inference_engine.cs",
        type=class_name(bundle.name),
        file=f"{bundle.name}.onnx",
        fields="".join(f"{line}\n" for line in fields),
        methods="\n".join(f"    {line}" if line else "" for line in methods),
    )


def _read(spec: TensorSpec, variable: str) -> str:
    kind = "float" if spec.dtype == "float32" else "int"
    return (
        f"using var {variable} = (worker.PeekOutput({string_literal(spec.name)}) as Tensor<{kind}>).ReadbackAndClone();"
    )


# ------------------------------------------------------------------ source code


def source_agent(bundle: SnippetBundle) -> str:
    """Return an ML-Agents Agent whose Heuristic is the policy's C# class: no Model, no package but ML-Agents."""
    signature = bundle.signature
    header = header_of(bundle.name, signature)
    filled, vectors = list[str](), 0
    for f in header.inputs:
        vectors += f.spec.role is Role.VECTOR
        if f.spec.role is Role.VECTOR and vectors == 1:
            filled.append(f"GetObservations().CopyTo(policy.{f.name}, 0);")
        elif f.spec.role is Role.MASKS:
            value = "true" if f.spec.dtype == "bool" else "1"
            filled.append("// false or 0 where an action is forbidden")
            filled.append(f"for (int i = 0; i < policy.{f.name}.Length; i++) policy.{f.name}[i] = {value};")
        elif f.spec.role is not Role.PREV_ACTION:
            filled.append(f"// fill policy.{f.name}: {', '.join(meaning(bundle, f.spec))}")
    members = {f.spec.name: f.name for f in header.outputs}
    given = list[str]()
    for head in bundle.heads:
        name = members[bundle.plain(head).name]
        given += [f"// {line}" for line in action_meaning(bundle, head)]
        if head.is_continuous:
            given += [
                "var continuous = actionsOut.ContinuousActions;",
                f"for (int i = 0; i < continuous.Length; i++) continuous[i] = policy.{name}[i];",
            ]
        else:
            given += [
                "var discrete = actionsOut.DiscreteActions;",
                f"for (int i = 0; i < discrete.Length; i++) discrete[i] = (int)policy.{name}[i];",
            ]
    previous = next((f for f in header.inputs if f.spec.role is Role.PREV_ACTION), None)
    if previous is not None:
        one = f"policy.{previous.name}"
        given.append(f"for (int i = 0; i < {one}.Length; i++) {one}[i] = discrete[i];")
    return fill_template(
        "source_agent.cs",
        file=f"{bundle.name}.cs",
        type=f"{header.class_name}Agent",
        policy=header.class_name,
        filled="".join(f"        {line}\n" for line in filled),
        given="".join(f"        {line}\n" for line in given),
    )
