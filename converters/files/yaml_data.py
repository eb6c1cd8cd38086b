"""A YAML file as data: untrusted, so nothing that its tags name is ever made, and its size is bounded before it is.

PyYAML (6.0) gives the events; the tree is put together here, since its own constructors recurse as deep as the file
says, and refuse what Isaac Lab writes (``!!python/tuple``, ``!!python/object/apply``). A tag beyond YAML's own is left
out: what is below it stays a mapping, a sequence or text. A node with an anchor is shared, and counted
wherever it is named.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from export_model.signatures.errors import DamagedFileError, RuntimeUnavailableError, SourceError

MAX_YAML_BYTES = 4 << 20
#: Nodes of the tree, an anchor's counted wherever it is named.
MAX_YAML_NODES = 200_000
MAX_YAML_DEPTH = 64
_CHECK_FILE = "check the file; if another tool reads it, please open an issue with it"


def read_yaml(data: bytes, name: str) -> Any:
    """Return the first document of a YAML file: dicts (keys as text), lists, text, numbers, booleans and None.

    ``name`` is for errors. A date stays text. Raises DamagedFileError where it is not YAML, SourceError beyond the
    bounds, RuntimeUnavailableError where PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise RuntimeUnavailableError(
            f"{name} is YAML, and PyYAML is not installed", fix="pip install 'export-model[robots]'"
        ) from error
    if len(data) > MAX_YAML_BYTES:
        raise SourceError(
            f"{name} has {len(data)} bytes; at most {MAX_YAML_BYTES} are read", fix="leave out what it need not say"
        )
    try:
        text = data.decode("utf-8")
        return _Tree(name, yaml).of(yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        why = " ".join(str(error).split())[:300]
        raise DamagedFileError(f"{name} must be a YAML file", why=why, fix=_CHECK_FILE) from error


class _Tree:
    """Nodes put together from events, with a stack of its own."""

    def __init__(self, name: str, yaml: Any) -> None:
        self._name, self._yaml = name, yaml
        self._resolver = yaml.resolver.Resolver()
        #: anchor → the node and the number of nodes in it; None while it is open
        self._anchors: dict[str, tuple[Any, int] | None] = {}
        self._nodes = 0

    def of(self, events: Iterator[Any]) -> Any:
        """Return the first document's root; None where there is none."""
        yaml = self._yaml
        root: list[Any] = []
        # Of each open collection: where its nodes go, its anchor, the count of nodes when it began.
        open_: list[tuple[list[Any], Any, str | None, int]] = [(root, root, None, 0)]
        for event in events:
            if isinstance(event, yaml.DocumentEndEvent):
                break
            if isinstance(event, yaml.AliasEvent):
                node = self._alias_target(event.anchor)
            elif isinstance(event, yaml.ScalarEvent):
                node = self._scalar(event)
                self._count(1)
                if event.anchor:
                    self._anchors[event.anchor] = (node, 1)
            elif isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
                if len(open_) > MAX_YAML_DEPTH:
                    raise self._error(f"is nested deeper than {MAX_YAML_DEPTH}")
                kind: Any = [] if isinstance(event, yaml.SequenceStartEvent) else {}
                if event.anchor:
                    self._anchors[event.anchor] = None
                open_.append(([], kind, event.anchor, self._nodes))
                self._count(1)
                continue
            elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
                content, node, anchor, before = open_.pop()
                node.extend(content) if isinstance(node, list) else node.update(self._pairs(content))
                if anchor:
                    self._anchors[anchor] = (node, self._nodes - before)
            else:
                continue
            open_[-1][0].append(node)
        return root[0] if root else None

    def _pairs(self, content: list[Any]) -> Iterator[tuple[str, Any]]:
        seen: set[str] = set()
        for key, value in zip(content[::2], content[1::2], strict=True):
            name = key if isinstance(key, str) else str(key) if not isinstance(key, list | dict) else ""
            if not name or name in seen:
                raise self._error(f"has the key {name[:60]!r} twice" if name else "has a key that is not text")
            seen.add(name)
            yield name, value

    def _alias_target(self, anchor: str) -> Any:
        found = self._anchors.get(anchor)
        if found is None:
            raise self._error(f"names the anchor {anchor[:60]!r}, which is not complete there")
        self._count(found[1])
        return found[0]

    def _count(self, nodes: int) -> None:
        self._nodes += nodes
        if self._nodes > MAX_YAML_NODES:
            raise self._error(f"has more than {MAX_YAML_NODES} nodes")

    def _scalar(self, event: Any) -> Any:
        tag, text = event.tag, event.value
        if tag is None:
            tag = self._resolver.resolve(self._yaml.ScalarNode, text, event.implicit)
        kind = tag.removeprefix("tag:yaml.org,2002:")
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() in ("yes", "true", "on")
        if kind in ("int", "python/int") and len(text) < 40:
            return self._integer(text)
        return _number(text) if kind in ("float", "python/float") else text

    def _integer(self, text: str) -> int | str:
        try:
            return int(text.replace("_", ""), 0 if text.lower().lstrip("+-").startswith(("0x", "0b")) else 10)
        except ValueError:
            return text  # 0o17 and 1:30 of YAML 1.1 stay as they are written

    def _error(self, what: str) -> SourceError:
        return SourceError(f"{self._name} {what}", why="no settings file of a training is so", fix=_CHECK_FILE)


def _number(text: str) -> float | str:
    plain = text.lower().replace("_", "").lstrip("+-")
    sign = -1.0 if text.startswith("-") else 1.0
    if plain in (".inf", ".nan"):
        return sign * (math.inf if plain == ".inf" else math.nan)
    try:
        return sign * float(plain)
    except ValueError:
        return text
