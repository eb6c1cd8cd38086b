"""XML that others made, as elements: no document type, so no entities, and bounds of size, count and depth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from export_model.signatures.errors import DamagedFileError

MAX_XML_BYTES, MAX_ELEMENTS, MAX_DEPTH = 16 << 20, 100_000, 200


def read_xml(data: bytes, name: str) -> Element:
    """The root of a document. Raises DamagedFileError: not XML, a document type, or beyond the bounds."""
    tree, opened = TreeBuilder(), [0, 0]

    def begin(tag: str, attributes: Mapping[str, str]) -> None:
        opened[0] += 1
        opened[1] += 1
        if opened[0] > MAX_ELEMENTS or opened[1] > MAX_DEPTH:
            refuse(f"it has more than {MAX_ELEMENTS} elements, or deeper ones than {MAX_DEPTH}")
        tree.start(tag, dict(attributes))

    def end(tag: str) -> None:
        opened[1] -= 1
        tree.end(tag)

    def refuse(why: str) -> NoReturn:
        raise DamagedFileError("is not read", where=name, why=why, fix="write the robot's joints as YAML")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = lambda *_: refuse("it has a document type, which can hold entities")
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise DamagedFileError("is not XML", where=name, why=str(error), fix="copy or download it again") from error
    return tree.close()
