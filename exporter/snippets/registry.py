"""All snippets by name, in the order they are printed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import partial
from string import Template
from typing import Any

from msgspec import Struct

from export_model.converters.formats.format import Code, Format
from export_model.converters.formats.registry import (
    BARRACUDA,
    CSHARP,
    FROZEN_GRAPH,
    LITERT,
    ONNX,
    SAVED_MODEL,
    TFJS,
    WRITTEN,
)
from export_model.exporter.snippets import agent, csharp, godot, javascript, px4, python, recorders, serving, unity
from export_model.exporter.snippets.contract import SnippetBundle, string_literal
from export_model.signatures.errors import BundleError, UsageError


class Caller(Struct, frozen=True):
    """One way to call a policy.

    ``name`` is the one for ``--for``; ``needs`` are the formats: any of them, or of several that it needs together.
    """

    name: str
    title: str
    language: str
    needs: tuple[Format | tuple[Format, ...], ...]
    render: Callable[[SnippetBundle], str]

    @property
    def alternatives(self) -> list[list[str]]:
        """The formats that it needs together, of which any choice will do."""
        return [[f.key for f in need] if isinstance(need, tuple) else [need.key] for need in self.needs]

    @property
    def formats_text(self) -> str:
        """The formats that it needs, for people."""
        return "any format" if self.needs == _ANY else self.lacking_text(frozenset())

    def lacking_text(self, has: Collection[str]) -> str:
        """Those of its formats that a bundle lacks."""
        return " or ".join(" and ".join(key for key in keys if key not in has) for keys in self.alternatives)


def _javascript(
    name: str,
    title: str,
    need: Format | tuple[Format, ...],
    render: Callable[[SnippetBundle, javascript.CodePlace], str],
    *,
    node: str = "",
) -> Iterator[Caller]:
    """A page with its runtime beside it, the same with it from a CDN, and a program for Node."""
    places = (
        (name, "A page", "html", javascript.CodePlace.PAGE),
        (f"{name}-cdn", "A page, runtime from a CDN", "html", javascript.CodePlace.CDN),
        (node or f"{name}-node", "Node", "js", javascript.CodePlace.NODE),
    )
    for called, where, language, place in places:
        yield Caller(called, f"{where}, {title}", language, (need,), partial(_render_at, render, place))


def _render_at(
    render: Callable[[SnippetBundle, javascript.CodePlace], str], place: javascript.CodePlace, bundle: SnippetBundle
) -> str:
    return render(bundle, place)


TARGETS: tuple[Caller, ...] = (
    Caller("load-policy", "Python, export_model", "python", (ONNX, FROZEN_GRAPH), python.load_policy),
    Caller("onnxruntime", "Python, onnxruntime", "python", (ONNX,), python.onnxruntime),
    Caller("saved-model", "Python, tf.saved_model.load", "python", (SAVED_MODEL,), python.saved_model),
    Caller("serving-docker", "TensorFlow Serving, the container", "sh", (SAVED_MODEL,), serving.docker),
    Caller("serving-rest", "TensorFlow Serving, REST with curl", "sh", (SAVED_MODEL,), serving.rest),
    Caller("serving-grpc", "TensorFlow Serving, gRPC from Python", "python", (SAVED_MODEL,), serving.grpc),
    *_javascript("policy-tfjs", "policy.mjs with TensorFlow.js", TFJS, javascript.acting_tfjs, node="policy-node"),
    *_javascript("policy-ort", "policy.mjs with onnxruntime-web", (TFJS, ONNX), javascript.acting_ort),
    *_javascript("tfjs", "tf.loadGraphModel", TFJS, javascript.plain_tfjs),
    *_javascript("onnxruntime-web", "onnxruntime-web", ONNX, javascript.plain_ort),
    Caller("tensorflowsharp", "C#, TensorFlowSharp", "csharp", (FROZEN_GRAPH,), csharp.tensorflowsharp),
    Caller(
        "internal-brain", "Unity, Internal Brain (ML-Agents 0.1 to 0.6)", "text", (FROZEN_GRAPH,), unity.internal_brain
    ),
    Caller("inference-engine", "Unity Inference Engine (Sentis), C#", "csharp", (ONNX,), csharp.inference_engine),
    Caller("godot", "Godot RL Agents, an AIController, GDScript", "gdscript", (ONNX,), godot.godot),
    Caller("px4", "PX4's neural control, a shell", "sh", (LITERT,), px4.px4),
    Caller("agent", "Unity, an ML-Agents Agent, C#", "csharp", (ONNX, BARRACUDA), agent.agent),
    Caller("source-agent", "Unity without a runtime, an Agent's Heuristic", "csharp", (CSHARP,), csharp.source_agent),
)


def _fill_code(found: Format, code: Code, bundle: SnippetBundle) -> str:
    play = python.play(bundle, ["outputs = policy(**feeds)"], narrow=found.narrow)
    return Template(code.text).substitute(path=string_literal(bundle.path(found.main_of(bundle.name))), play=play)


#: What people call the language of a snippet.
_CALLED = {
    "python": "Python",
    "html": "web pages",
    "js": "Node",
    "csharp": "C# (Unity)",
    "gdscript": "Godot",
    "sh": "TF Serving",
    "text": "Unity's Inspector",
}
#: What writes a log needs no file of the policy.
_ANY = tuple(WRITTEN.values())
TARGETS += (
    Caller("recorder-unity", "A log from Unity, beside an ML-Agents Agent, C#", "csharp", _ANY, recorders.unity),
    Caller("recorder-gymnasium", "A log from Gymnasium, Python", "python", _ANY, recorders.gymnasium),
    Caller("recorder-ros2", "A log from ROS 2, Python", "python", _ANY, recorders.ros2),
    Caller("recorder-isaac-lab", "A log from Isaac Lab, Python", "python", _ANY, recorders.isaac_lab),
)

# The snippets that formats bring themselves.
TARGETS += tuple(
    Caller(code.name, code.title, code.language, (found,), partial(_fill_code, found, code))
    for found in WRITTEN.values()
    for code in found.snippets
)


def languages(keys: Collection[str]) -> str:
    """What there is code for that calls a bundle of these formats; nothing where there is none."""
    callers = [t for t in TARGETS if t.needs != _ANY and any(set(keys).issuperset(need) for need in t.alternatives)]
    return ", ".join(dict.fromkeys(_CALLED[t.language] for t in callers))


class Snippet(Struct, frozen=True):
    """The code of a target for one bundle."""

    target: Caller
    code: str

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "name": self.target.name,
            "title": self.target.title,
            "language": self.target.language,
            "code": self.code,
        }


def snippets(bundle: SnippetBundle, name: str | None = None) -> tuple[list[Snippet], dict[str, str]]:
    """(snippets, target → the format it lacks). ``name`` chooses one, all that begin so (``serving``), or the consumer.

    Raises UsageError for an unknown target, BundleError where the bundle lacks the format of all chosen, or was
    made for another consumer.
    """
    name = _for_consumer(bundle, name)
    chosen = [t for t in TARGETS if name in (None, t.name)] or [t for t in TARGETS if t.name.startswith(f"{name}-")]
    if not chosen:
        raise UsageError(f"--for {name}: unknown target", fix=f"one of: help, {', '.join(t.name for t in TARGETS)}")
    has = {key for key, found in WRITTEN.items() if found.first_file_of(bundle.name) in bundle.files}
    able = {t.name for t in chosen if any(has.issuperset(keys) for keys in t.alternatives)}
    lacking = {t.name: t.lacking_text(has) for t in chosen if t.name not in able}
    if len(lacking) == len(chosen):
        needed = next(iter(lacking.values()))
        raise BundleError(
            f"has no {needed}, which --for {chosen[0].name} needs",
            where=str(bundle.folder),
            fix="export the policy again with all formats (the default of --to)"
            if bundle.made_for is None
            else f"it was made for {bundle.made_for}: --for {bundle.made_for}, or export the policy again for another",
        )
    return [Snippet(t, t.render(bundle)) for t in chosen if t.name not in lacking], lacking


def _for_consumer(bundle: SnippetBundle, name: str | None) -> str | None:
    """The target of a word of ``--for``, a profile's too; raises BundleError where the bundle is not for that one."""
    from export_model.converters.consumers.profiles import PROFILES

    wanted = next((p for p in PROFILES if name in (p.name, *p.aliases) and name not in {t.name for t in TARGETS}), None)
    if wanted is None:
        return name
    if bundle.made_for != wanted.name and not any(
        WRITTEN[f].first_file_of(bundle.name) in bundle.files for f in wanted.own_names
    ):
        made = "its names are this tool's own" if bundle.made_for is None else f"it was made for {bundle.made_for}"
        raise BundleError(
            f"was not made for {wanted.name}",
            where=str(bundle.folder),
            why=made,
            fix=f"export-model SOURCE --for {wanted.name}",
        )
    return wanted.code
