"""``.nn``: a policy for Unity's Barracuda, in the version that all of them load.

The contract lies behind the weights, as version 18 of the format keeps metadata: loaders stop before it in a file of
version 16 (ModelLoader.cs of 0.2 to 3.0 reads three strings and a list of warnings after the weights, no more). Strings
are counted in UTF-16 units and written in UTF-8, as C#'s BinaryReader reads them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.barracuda.format import (
    ALIGNED,
    ALIGNMENT,
    METADATA,
    TYPED_WEIGHTS,
    Dataset,
    Layer,
    NnModel,
    Trailer,
    parse,
)
from export_model.converters.formats.barracuda.lower import policy_model
from export_model.converters.formats.format import WriteOptions
from export_model.converters.policy.policy import Policy
from export_model.signatures.contract import EMBEDDED, json_of, parse_signature
from export_model.signatures.errors import DamagedFileError
from export_model.signatures.fields import FieldError
from export_model.signatures.spec import PolicySignature

#: What Barracuda has for a model that no file was imported for.
_NO_SOURCE, _NO_VERSION = "Script", "NA"
PRODUCER = "export-model"


def write(policy: Policy, options: WriteOptions) -> Mapping[str, Pieces]:
    """The ``.nn``. Raises UnsupportedOpError or SignatureError that names what the format cannot hold."""
    trailer = Trailer(_NO_SOURCE, _NO_VERSION, PRODUCER, metadata=((EMBEDDED, options.contract),))
    return {f"{policy.name}.nn": Pieces(encode(replace(policy_model(policy), trailer=trailer)))}


def embedded_contract(path: Path) -> str | None:
    """The contract that a ``.nn`` carries, None where it has none. Raises OSError, DamagedFileError."""
    return parse(path.read_bytes()).metadata(EMBEDDED)


def contract_of(model: NnModel) -> PolicySignature:
    """The contract that the writer left in the file. Raises DamagedFileError where there is none."""
    try:
        return parse_signature(json_of(model.metadata(EMBEDDED) or ""))
    except FieldError as error:
        raise DamagedFileError(
            "the .nn carries no contract of export-model",
            why="only files of this tool say which input and output is which",
            fix="export it: export-model FILE.nn",
        ) from error


def encode(model: NnModel) -> bytes:
    """The bytes of ``model``, in every version: what ``parse`` reads from them equals it."""
    head = b"".join(
        (
            struct.pack("<q", model.version),
            _encode_list(_text(i.name) + _ints(i.shape) for i in model.inputs),
            _encode_list(_text(name) for name in model.outputs),
            _encode_list(_ints(m.shape) + _text(m.input) + _text(m.output) for m in model.memories),
            _encode_list(map(_layer, model.layers)),
        )
    )
    if model.version >= TYPED_WEIGHTS:
        head += _int(int(model.half))
    if model.version >= ALIGNED:
        head += bytes(ALIGNMENT - len(head) % ALIGNMENT)
    weights = model.weights.astype("<f2" if model.half else "<f4", copy=False).tobytes()
    return head + weights + (b"" if model.trailer is None else _trailer(model.trailer, model.version))


def _layer(layer: Layer) -> bytes:
    return b"".join(
        (
            _text(layer.name),
            _int(layer.type),
            _int(layer.activation),
            _int(0) * 2,  # two arrays that every writer leaves empty
            _ints(layer.pad),
            _ints(layer.stride),
            _ints(layer.pool),
            _int(layer.axis),
            struct.pack("<ff", layer.alpha, layer.beta),
            _int(0),  # a third
            _encode_list(_text(name) for name in layer.inputs),
            _encode_list(map(_dataset, layer.datasets)),
        )
    )


def _dataset(dataset: Dataset) -> bytes:
    place = struct.pack("<qii", dataset.offset, dataset.item_size, dataset.length)
    return _text(dataset.name) + _ints(dataset.shape) + place


def _trailer(trailer: Trailer, version: int) -> bytes:
    data = b"".join(map(_text, (trailer.ir_source, trailer.ir_version, trailer.producer)))
    data += _encode_list(_text(layer) + _text(message) for layer, message in trailer.warnings)
    if version >= METADATA or trailer.metadata:
        data += _encode_list(_text(key) + _text(value) for key, value in trailer.metadata)
    return data


# ------------------------------------------------------------------ the primitives


def _int(number: int) -> bytes:
    return struct.pack("<i", number)


def _ints(values: Sequence[int]) -> bytes:
    return struct.pack(f"<{len(values) + 1}i", len(values), *values)


def _text(words: str) -> bytes:
    return _int(len(words.encode("utf-16-le")) // 2) + words.encode()


def _encode_list(items: Iterable[bytes]) -> bytes:
    found = list(items)
    return _int(len(found)) + b"".join(found)
