"""What source code calls a policy's inputs, outputs and memory: asked by writers and by the judges that run it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from msgspec import Struct

from export_model.converters.graph.language import identifier, in_comment
from export_model.converters.graph.nodes import NameScope
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

#: What the actor does not need.
_REST = frozenset((Role.VALUE, Role.ACTION_PROBS, Role.LOG_PROB, Role.STD, Role.LOG_STD))
#: Words that no member or class can have: of C, C++, C# and JavaScript, what programs offer, and what they take of
#: JavaScript. What else they name begins with ``_``, ``t_`` or ``w_``, or is local to what does not name members.
_KEYWORDS = tuple(
    """auto break case char const continue default do double else enum extern float for goto if inline int long
    register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while class
    new delete this operator template typename public private protected virtual bool true false namespace using try
    catch throw friend explicit export and or not xor
    abstract as base byte checked decimal delegate event finally fixed foreach implicit in interface internal is lock
    null object out override params readonly ref sbyte sealed stackalloc string typeof uint ulong unchecked unsafe
    ushort await debugger extends function import instanceof let package super var with yield arguments eval undefined
    fround constructor floats ints longs math_errhandling stream unix linux
    Act Branches Choose Compute Load Reset SelfTest Sizes Unusual act choose compute load ports reset selftest unusual
    ArrayBuffer BigInt Error Float32Array Float64Array Infinity Int16Array Int32Array Int8Array Math NaN Number
    RangeError Uint16Array Uint8Array""".split()  # noqa: SIM905  a list of eighty lines otherwise
)


#: What is to be known of a member's numbers.
_MEANINGS = {
    Role.MASKS: "1: allowed, 0: forbidden",
    Role.PREV_ACTION: "the caller copies here what was done, after each decision",
    Role.NOISE: "drawn by each decision",
    Role.MEMORY_IN: "kept from decision to decision",
    Role.LOG_PROBS: "what classes are drawn by",
    Role.DETERMINISTIC: "the action without chance",
}


class Field(Struct, frozen=True):
    """A member of one of the header's structs: ``size`` elements of a tensor of the policy."""

    name: str
    spec: TensorSpec
    size: int

    @property
    def about(self) -> str:
        """What it is for, its shape for one agent, what its numbers mean, and what the source calls it."""
        shape, source = self.spec.shape[1:] if self.spec.batched else self.spec.shape, self.spec.source
        names = [n.removesuffix(":0") for n in ([source] if isinstance(source, str) else source or ())]
        said = f"in the source {in_comment(', '.join(names)[:120])}" if names and names != [self.spec.name] else ""
        words = (_MEANINGS.get(self.spec.role, ""), said)
        return "; ".join(filter(None, (f"{self.spec.role.value}, {' x '.join(map(str, shape)) or '1'}", *words)))


class Header(Struct, frozen=True):
    """The members: what is observed, what the memory keeps (the state, draws), what is answered."""

    prefix: str
    inputs: tuple[Field, ...]
    noise: tuple[Field, ...]
    state: Field | None
    next_state: Field | None
    outputs: tuple[Field, ...]

    @property
    def class_name(self) -> str:
        """The name of a class."""
        return _class_name(self.prefix)

    @property
    def own_values(self) -> tuple[Field, ...]:
        """What an agent keeps: noise, its state."""
        return (*self.noise, *((self.state,) if self.state else ()))

    @property
    def fed(self) -> tuple[Field, ...]:
        """All that a decision is made of."""
        return (*self.inputs, *self.own_values)

    def choice_field(self, branches: Sequence[int]) -> Field | None:
        """The output that classes are drawn by, where there is one of so many branches."""
        found = next((f for f in self.outputs if f.spec.role is Role.LOG_PROBS), None)
        return found if found is not None and sum(branches) == found.size else None

    @property
    def answered(self) -> tuple[Field, ...]:
        """All that comes of it; the next state last."""
        return (*self.outputs, *((self.next_state,) if self.next_state else ()))


def answers(signature: PolicySignature, code: CodeOptions | None = None) -> list[str]:
    """The outputs that a header answers: the actor's, or all."""
    heads = {head.name for head in signature.heads}
    everything = code is not None and code.outputs == "all"
    return [s.name for s in signature.outputs if everything or s.name in heads or s.role not in _REST]


def header_of(name: str, signature: PolicySignature, code: CodeOptions | None = None) -> Header:
    """What the header of the policy ``name`` calls what. Raises UnsupportedOpError where a member is empty."""
    word = identifier(name)
    prefix = word if not word[0].isdigit() else f"policy_{word}"
    memory_in, memory_out = signature.recurrence or ("", "")
    wanted = answers(signature, code)
    scope = NameScope((*_KEYWORDS, _class_name(prefix)))
    fields = _fields(signature.inputs, scope)
    outputs = [f for f in _fields(signature.outputs, scope) if f.spec.name in wanted]
    return Header(
        prefix,
        tuple(f for f in fields if f.spec.role is not Role.NOISE and f.spec.name != memory_in),
        tuple(f for f in fields if f.spec.role is Role.NOISE),
        next((f for f in fields if f.spec.name == memory_in), None),
        next((f for f in outputs if f.spec.name == memory_out), None),
        tuple(f for f in outputs if f.spec.name != memory_out),
    )


def _class_name(prefix: str) -> str:
    name = prefix[0].upper() + prefix[1:]
    return f"Policy_{name}" if name in _KEYWORDS else name


def _member_name(name: str) -> str:
    """As a tensor is called, but for what C's own headers, whose macros are in capitals, may make of it."""
    word = identifier(name)
    return f"x{word}" if word[0].isdigit() or word.isupper() else word


def _fields(specs: Iterable[TensorSpec], scope: NameScope) -> list[Field]:
    found = []
    for spec in specs:
        size = 1
        for length in spec.shape[1:] if spec.batched else spec.shape:
            size *= 1 if length is None else length
        if not size:
            raise UnsupportedOpError(
                f"{spec.name!r} ({spec.role}) cannot be written as source code: it has the shape {list(spec.shape)}",
                why="a member of a structure holds at least one number",
                fix="leave that input out of the source, or export to onnx, saved_model, tfjs or bytes",
            )
        found.append(Field(scope.fresh(_member_name(spec.name)), spec, size))
    return found
