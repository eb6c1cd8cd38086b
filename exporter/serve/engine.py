"""What a page runs a bundle's policy by: the module of ``--to js``, as a function that makes it.

Each policy that plays has a module of its own, so that another's weights can be drawn anew.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from msgspec import Struct

from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.js.writer import write_module
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.code import CodeOptions

_EXPORTED = re.compile(r"^export (?=class|function|const)", re.M)
_DEFAULT = re.compile(r"^export default .*;\n", re.M)


class PageEngine(Struct, frozen=True):
    """``module`` exports ``make``, which returns ``{ Agent, ports, load, matrices }``; ``load`` takes ``weights``.

    ``matrices()`` gives [array, columns] of each weight that training began with a draw for.
    """

    module: bytes
    weights: bytes


def engine_of(bundle: Bundle, graph: Graph) -> PageEngine:
    """Return the engine of a bundle whose graph the numpy kernels run. Raises UnsupportedOpError."""
    signature = bundle.signature
    feeds, fetches = ({s.name: s.name for s in specs} for specs in (signature.inputs, signature.outputs))
    policy = Policy(bundle.name, graph, signature, feeds, fetches)
    weights = bundle.contract.tool.get("weights", "float32")
    options = WriteOptions("{}", weights=weights, code=CodeOptions(weights="file", outputs="all"))
    written = write_module(policy, options)
    body = _EXPORTED.sub("", _DEFAULT.sub("", written.text))
    matrices = ", ".join(
        f"[{name}, {shape[-1]}]" for name, shape in written.weights.items() if len(shape) > 1 and min(shape[-2:]) > 1
    )
    made = f"{{ Agent: {written.class_name}, ports, load, matrices: () => [{matrices}] }}"
    return PageEngine(f"export const make = () => {{\n{body}return {made};\n}};\n".encode(), written.file)


def makers_module(names: Mapping[str, str]) -> bytes:
    """Return ``makers.mjs``: the functions that make engines, by the names of policies. ``names`` has their modules."""
    imports = "".join(f'import {{ make as {name} }} from "./{path}";\n' for name, path in names.items())
    return f"{imports}export const makers = {{ {', '.join(names)} }};\n".encode()
