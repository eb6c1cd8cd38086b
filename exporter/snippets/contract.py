"""What the snippets say of a policy: its inputs with what to feed and their labels, its actions, its files."""

from __future__ import annotations

import json
import math
import re
import shlex
import textwrap
from collections.abc import Callable
from pathlib import Path
from string import Template

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.formats.bundle import bundle
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.registry import FROZEN_GRAPH
from export_model.converters.interfaces.text import ALL, loop_lines, term_lines
from export_model.exporter.meanings import feed_text
from export_model.exporter.tables import count_text
from export_model.signatures.contract import Contract
from export_model.signatures.errors import naming
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

#: The frames: a file each, under its own language's name, in the form of Python's string.Template.
_FRAMES = Path(__file__).resolve().parent / "templates"
#: Roles of actions that are odds: classes are drawn by them.
ODDS = (Role.LOG_PROBS, Role.PROBS)
#: How many steps a snippet plays where the policy remembers.
STEPS = 3
#: Comments are folded at about this many characters.
WIDTH = 100


class SnippetBundle(Struct, frozen=True):
    """A bundle as the snippets need it; ``folder`` is written into the code as it was given."""

    folder: Path
    name: str
    signature: PolicySignature
    files: frozenset[str]
    #: nodes of its .bytes: an old Unity asks for some that are neither inputs nor outputs
    nodes: frozenset[str] = frozenset()
    #: the consumer that it was made for (``--for``)
    made_for: str | None = None
    #: whether noise is drawn inside its files (``--noise keep``, ``--for``)
    draws_itself: bool = False

    def path(self, relative: str) -> str:
        """A file of the bundle, with slashes."""
        return (self.folder / relative).as_posix()

    def mount(self, relative: str) -> str:
        """A file of the bundle for a shell that wants it absolute."""
        path = self.path(relative)
        if self.folder.is_absolute():
            return shlex.quote(path)
        return f'"$(pwd)"/{shlex.quote(path)}'

    @property
    def remembers(self) -> bool:
        """Whether a step needs something of the step before."""
        return any(s.role in (Role.MEMORY_IN, Role.PREV_ACTION) for s in self.signature.inputs)

    @property
    def memories(self) -> list[tuple[TensorSpec, str, str]]:
        """(an input of the memory, the output that is fed back into it, the variable that a snippet keeps for it)."""
        return [
            (self.signature.input(taken), given, f"memory{number or ''}")
            for number, (taken, given) in enumerate(self.signature.recurrences)
        ]

    @property
    def memory(self) -> tuple[TensorSpec, str] | None:
        """(the input, the output that is fed back into it) of a memory in one tensor, None where there is none."""
        return self.memories[0][:2] if self.memories else None

    @property
    def previous(self) -> TensorSpec | None:
        """The input that takes the actions of the step before."""
        return next((s for s in self.signature.inputs if s.role is Role.PREV_ACTION), None)

    @property
    def kept_variables(self) -> dict[str, str]:
        """Input → the variable that a snippet keeps for it from step to step."""
        kept = {spec.name: variable for spec, _, variable in self.memories}
        return kept if self.previous is None else {**kept, self.previous.name: "previous"}

    def beginnings(self, line: str, value: Callable[[TensorSpec], str]) -> list[str]:
        """Lines that declare ``kept_variables``; ``line`` is given a variable, its first value and a comment."""
        says = {"memory": "the start of an episode; a row per agent", "previous": "no action yet"}
        return [
            line.format(name, value(self.signature.input(key)), says[name.rstrip("0123456789")])
            for key, name in self.kept_variables.items()
        ]

    @property
    def heads(self) -> tuple[TensorSpec, ...]:
        """The outputs that are the actions: one, or two of a hybrid."""
        return tuple(head.spec for head in self.signature.heads)

    @property
    def kinds(self) -> list[str]:
        """Of which kind each of ``heads`` is."""
        return ["continuous" if head.is_continuous else "discrete" for head in self.heads]

    @property
    def variables(self) -> list[str]:
        """What a snippet calls each of ``heads``."""
        return ["action"] if len(self.heads) == 1 else self.kinds

    @property
    def fetched_outputs(self) -> dict[str, TensorSpec]:
        """Variable → the output without chance."""
        return {name: self.plain(head) for name, head in zip(self.variables, self.heads, strict=True)}

    @property
    def discrete_variable(self) -> str:
        """The variable with the discrete actions, which the next step may be fed."""
        return "action" if len(self.heads) == 1 else "discrete"

    def plain(self, head: TensorSpec) -> TensorSpec:
        """The output with ``head``'s action without chance; the head itself where there is none."""
        return self.signature.companion_of(head.name) or head


def read_bundle(folder: Path) -> SnippetBundle:
    """A bundle by its policy.json. Raises BundleError, also where its .bytes is not the one that was written."""
    found, frozen = bundle.Bundle.open(folder), FROZEN_GRAPH
    nodes: frozenset[str] = frozenset()
    if found.has(frozen):
        found.verify_hashes(frozen)
        with naming(found.path(frozen)):
            nodes = frozenset(node.name for node in read_graph(found.path(frozen).read_bytes()).nodes)
    made_for, source = found.contract.tool.get("profile"), found.contract.source
    kept, files = source.noise_kept and bool(source.noise), frozenset(found.contract.files)
    return SnippetBundle(folder, found.name, _as_fed(found.contract), files, nodes, made_for, draws_itself=kept)


def _as_fed(contract: Contract) -> PolicySignature:
    """The policy as the bundle's files take it: for a number of agents where they were made for one (``--batch``)."""
    size = contract.tool.get("batch")
    if size is None:
        return contract.signature
    inputs = tuple(replace(s, shape=(size, *s.shape[1:])) if s.batched else s for s in contract.signature.inputs)
    return replace(contract.signature, inputs=inputs)


def example_shape(spec: TensorSpec) -> tuple[int, ...]:
    """The shape for one agent, or as many as the file takes; 1 for every other free axis, too."""
    return tuple(1 if n is None else n for n in spec.shape)


def example_size(spec: TensorSpec) -> int:
    """Numbers of one agent."""
    return math.prod(example_shape(spec))


def meaning(bundle: SnippetBundle, spec: TensorSpec) -> list[str]:
    """Comment lines on an input: what it takes, and what its numbers are called."""
    signature = bundle.signature
    names = signature.labels.get("observations", {}).get(spec.name, [])
    return [
        *wrap_items(f"{spec.name}: {feed_text(spec, signature)}", number_names(names)),
        *_interface_lines(signature, spec.name),
    ]


def action_meaning(bundle: SnippetBundle, head: TensorSpec, drawing: str = "") -> list[str]:
    """Comment lines on an action: how many numbers, what they are called, and what would draw it (``drawing``)."""
    chance = list(filter(None, [chance_text(bundle, head, drawing)]))
    if head.is_continuous:
        names = number_names(bundle.signature.labels.get("actions", []))
        return [
            *wrap_items(count_text(head.shape[-1] or 0, "continuous action"), names),
            *chance,
            *_interface_lines(bundle.signature, head.name),
            *(line for text in loop_lines(bundle.signature.interface, ALL) for line in textwrap.wrap(text, WIDTH)),
        ]
    return [*branch_lines(bundle), *chance]


def is_drawn_inside(bundle: SnippetBundle, head: TensorSpec) -> bool:
    """Whether the file draws ``head``'s action, and has none without chance."""
    drawn = head.role is Role.SAMPLED or (head.role is Role.CONTINUOUS and bundle.draws_itself)
    return drawn and bundle.plain(head) == head


def chance_text(bundle: SnippetBundle, head: TensorSpec, drawing: str = "") -> str:
    """Say that ``head``'s action is the deterministic one, and what draws it; nothing where there is no chance."""
    signature = bundle.signature
    spread = next((s.name for s in signature.outputs if s.role in (Role.STD, Role.LOG_STD)), None)
    if is_drawn_inside(bundle, head):
        return "drawn inside the file, which has no deterministic action"
    if head.role in ODDS:
        drawn = f"by the {'log-' if head.role is Role.LOG_PROBS else ''}probabilities in {head.name}"
    elif bundle.plain(head) != head:
        drawn = head.name
    elif head.is_continuous and signature.noise:
        drawn = f"feed N(0, 1) as {', '.join(s.name for s in signature.noise)}"
    elif head.is_continuous and spread is not None:
        drawn = f"N({head.name}, {spread})"
    else:
        return ""
    return f"deterministic; drawn: {drawing or drawn}"


def agent_text(bundle: SnippetBundle) -> str:
    """What the policy does and what its agents keep, in words, for the comment above ``policy.agent``."""
    acts = [
        count_text(head.shape[-1] or 0, "continuous action")
        if head.is_continuous
        else count_text(len(bundle.signature.branches), "discrete action")
        for head in bundle.heads
    ]
    kept = "a memory: agents.reset() where an episode begins" if bundle.remembers else "no memory"
    return f"{' and '.join(acts)}, {kept}"


def _interface_lines(signature: PolicySignature, name: str) -> list[str]:
    """Comment lines on what is stated of a tensor's numbers."""
    lines = term_lines(signature, name)
    return [part for line in lines for part in textwrap.wrap(line, WIDTH, subsequent_indent="  ")]


def branch_lines(bundle: SnippetBundle) -> list[str]:
    """A comment line per branch of discrete actions."""
    labels = bundle.signature.labels.get("branches", [])
    lines: list[str] = []
    for i, size in enumerate(bundle.signature.branches):
        names = number_names(labels[i]) if i < len(labels) else []
        lines += wrap_items(f"branch {i}: {count_text(size, 'action')}", names)
    return lines


def number_names(names: list[str]) -> list[str]:
    """``["0 left", "1 right"]``."""
    return [f"{i} {name}" for i, name in enumerate(names)]


def wrap_items(head: str, items: list[str]) -> list[str]:
    """``head: item, item`` on lines of at most ``WIDTH`` characters (longer where one item is)."""
    if not items:
        return [head]
    lines, line = [], f"{head}:"
    for i, item in enumerate(items):
        text = item + ("," if i < len(items) - 1 else "")
        if len(line) + len(text) > WIDTH:
            lines.append(line)
            line = "  " + text
        else:
            line += f" {text}"
    return [*lines, line]


def string_literal(text: str) -> str:
    """A string literal of Python, JavaScript, C# and JSON alike, also inside of a page's script.

    Characters beyond U+FFFF stand as they are: as a pair of escapes they would be two characters in Python.
    """
    escaped = (
        c if c.isprintable() and c not in "<>&" else f"\\u{ord(c):04x}" for c in json.dumps(text, ensure_ascii=False)
    )
    return "".join(escaped)


def identifier(name: str) -> str:
    """A name for a variable."""
    word = re.sub(r"\W", "_", name, flags=re.ASCII)
    return word if word[:1].isalpha() else f"input_{word}"


def class_name(name: str) -> str:
    """A name for a class."""
    words = "".join(w[:1].upper() + w[1:] for w in re.findall("[A-Za-z0-9]+", name)) or "Exported"
    return f"{words}Policy" if words[0].isalpha() else f"Policy{words}"


def fill_template(template: str, /, **parts: str) -> str:
    """The frame called ``template`` with its parts put in; it ends with one line break."""
    text = Template((_FRAMES / f"{template}.tmpl").read_text(encoding="utf-8")).substitute(parts)
    return text.rstrip("\n") + "\n"
