"""What a TensorFlow.js graph model takes and gives, by its signature."""

from __future__ import annotations

from pathlib import Path

from converters.format import Port, Ports
from converters.tfjs.reader import MODEL, read_signature


def ports(path: Path) -> Ports:
    """The ports of a folder, or of its model.json. Raises DamagedFileError."""
    file = path / MODEL if path.is_dir() else path
    signature, nodes = read_signature(file)
    inputs, outputs = signature.ports()
    if not inputs:  # the official converter writes none for a frozen graph: placeholders are fed
        inputs = tuple(Port(name) for name, op in nodes.items() if op == "Placeholder")
    return Ports(file.parent, inputs, outputs)
