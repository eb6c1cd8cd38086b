"""TorchScript modules (``torch.jit.save``): legged_gym, unitree_rl_gym, Isaac Lab, and others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.torchscript import source as _source
else:
    (_source,) = defer_imports(__name__, "source")


def _sniff(file: Content) -> bool:
    """What torch.jit.save writes: an archive with a pickle, and code beside it."""
    names = file.entries
    return any(n.endswith("data.pkl") for n in names) and any("code/__torch__" in n for n in names)


FORMATS = (
    Format(
        key="torchscript",
        label="a TorchScript module (.pt, torch.jit.save)",
        sniff=_sniff,
        read=_source.read,
        takes=frozenset({"sensors"}),
        library="torch",
    ),
)
