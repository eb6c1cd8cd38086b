"""The messages as we describe them, held against those of the package ``onnx``."""

from __future__ import annotations

import onnx
import pytest
from google.protobuf.descriptor import FieldDescriptor

from export_model.converters.formats.onnx.messages import ModelProto

#: Where ours is called otherwise: messages that are nested in another, and an enum is a number.
THEIRS = {"Dimension": "TensorShapeProto.Dimension"} | {
    name: f"TypeProto.{name}" for name in ("Tensor", "Sequence", "Map")
}
OURS = ModelProto.DESCRIPTOR.file.message_types_by_name
#: Types that are the same to us, or are laid out alike.
ALIKE = {"Optional": "Sequence", "SparseTensor": "Tensor"}


def described(field: FieldDescriptor) -> tuple[object, ...]:
    kind = FieldDescriptor.TYPE_INT32 if field.type == FieldDescriptor.TYPE_ENUM else field.type
    message = field.message_type.name if field.message_type is not None else ""
    oneof = field.containing_oneof is not None
    return field.number, kind, field.is_repeated, ALIKE.get(message, message), oneof


@pytest.mark.parametrize("name", sorted(OURS))
def test_a_message_is_what_onnx_says(name: str) -> None:
    theirs = onnx.ModelProto.DESCRIPTOR.file.message_types_by_name
    first, _, nested = THEIRS.get(name, name).partition(".")
    message = theirs[first].nested_types_by_name[nested] if nested else theirs[first]
    for field in OURS[name].fields:
        assert described(field) == described(message.fields_by_name[field.name]), field.name
