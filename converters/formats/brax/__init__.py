"""Parameters of brax and MuJoCo Playground: a pickle (``brax.io.model.save_params``), or a folder of orbax."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.files.file_probe import PICKLES
from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.brax import source as _source
else:
    (_source,) = defer_imports(__name__, "source")


def _sniff(file: Content) -> bool:
    """Whether it is a pickle whose first class is the normaliser's, which stands first in brax's parameters."""
    return file.starts(*PICKLES) and b"brax.training.acme" in file.head[:128]


_TAKES = frozenset({"activation", "script"})
FORMATS = (
    Format(key="brax", label="parameters of brax", sniff=_sniff, read=_source.read, takes=_TAKES),
    Format(
        key="brax_checkpoint",
        label="a checkpoint of brax (orbax)",
        at=_source.is_checkpoint,
        read=_source.read_folder,
        takes=_TAKES,
    ),
)
