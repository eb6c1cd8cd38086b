"""The expressions in skrl's settings: ``OBSERVATIONS``, ``concatenate([net, OBSERVATIONS])``, ``2 * tanh(ACTIONS)``.

skrl makes Python code of them and runs it; here they are parsed, and each part becomes a node.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping

from export_model.converters.trainers.pytorch.activations import activation_named
from export_model.converters.trainers.pytorch.network import Network
from export_model.signatures.errors import SourceError

MAX_EXPRESSION = 300
_Operation = Callable[[Network, str, str], str]
_OPERATIONS: Mapping[type[ast.operator], _Operation] = {
    ast.Add: lambda net, a, b: net.add("Add", [a, b]),
    ast.Sub: lambda net, a, b: net.add("Sub", [a, b]),
    ast.Mult: lambda net, a, b: net.add("Mul", [a, b]),
    ast.Div: lambda net, a, b: net.add("RealDiv", [a, b]),
}


def evaluate(net: Network, text: str, names: Callable[[str], str | None], refuse: Callable[[str], SourceError]) -> str:
    """Return the tensor of an expression. ``names`` gives the tensor of a name, None where it is not known.

    Raises what ``refuse`` makes of a part that is not known.
    """
    if len(text) > MAX_EXPRESSION:
        raise refuse(f"has {len(text)} characters; at most {MAX_EXPRESSION} are read")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise refuse(f"must be an expression: {text[:60]!r}") from error
    return _Expression(net, names, refuse).tensor(tree)


class _Expression:
    def __init__(self, net: Network, names: Callable[[str], str | None], refuse: Callable[[str], SourceError]) -> None:
        self._net, self._names, self._refuse = net, names, refuse

    def tensor(self, node: ast.expr) -> str:
        """Return the tensor of a part."""
        net = self._net
        if isinstance(node, ast.Name):
            found = self._names(node.id)
            if found is not None:
                return found
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return net.floats(float(node.value))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            return net.add("Neg", [self.tensor(node.operand)])
        elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATIONS:
            return _OPERATIONS[type(node.op)](net, self.tensor(node.left), self.tensor(node.right))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._call(node.func.id, node.args)
        raise self._refuse(f"has a part that is not known: {ast.unparse(node)[:60]}")

    def _call(self, name: str, arguments: list[ast.expr]) -> str:
        if name == "concatenate" and len(arguments) == 1 and isinstance(arguments[0], ast.List):
            return self._net.concat([self.tensor(part) for part in arguments[0].elts], 1)
        if name == "permute" and len(arguments) == 2 and ast.unparse(arguments[1]) == "(0, 3, 1, 2)":
            return self.tensor(arguments[0])  # images are NHWC inside: the axes are moved where PyTorch's order counts
        activation = activation_named(name) if len(arguments) == 1 else None
        if activation is None:
            raise self._refuse(f"calls {name[:60]}, which is not known there")
        return activation(self._net, self.tensor(arguments[0]))
