"""What training left: checkpoints with their graphs, and the folders of whole runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.checkpoint import listing as _listing
    from export_model.converters.formats.checkpoint import source as _source
else:
    _listing, _source = defer_imports(__name__, "listing", "source")


#: The last bytes of a table (tensorflow/core/lib/io/format.h), which a checkpoint's index is.
_TABLE_MAGIC = (0xDB4775248B80FB57).to_bytes(8, "little")
#: The op of a node (field 2 of NodeDef, with its length) that keeps its value in a checkpoint.
_VARIABLE = re.compile(rb"\x12(\x0aVariableV2|\x0bVarHandleOp|\x08Variable|\x12AutoReloadVariable)")
_DATA = re.compile(r".+\.data-\d{5}-of-\d{5}")
_LIST = ("model_checkpoint_path:", "all_model_checkpoint_paths:")


def _is_checkpoint(file: Content) -> bool:
    if file.text is not None:
        return file.text.startswith(_LIST)
    return file.data.endswith(_TABLE_MAGIC) or _DATA.fullmatch(file.name) is not None


def _is_prefix(path: Path) -> bool:
    return bool(path.name) and not path.exists() and path.with_name(path.name + ".index").is_file()


_STEPS = frozenset({"step"})


FORMATS = (
    Format(
        key="checkpoint",
        label="a TensorFlow checkpoint",
        sniff=_is_checkpoint,
        at=_is_prefix,
        read=_source.read,
        takes=_STEPS,
    ),
    Format(
        key="raw_graph",
        label="a graph with variables, as training begins with (raw_graph_def.pb)",
        sniff=lambda file: file.is_graph and _VARIABLE.search(file.data) is not None,
        read=_source.read,
        takes=_STEPS,
    ),
    Format(
        key="meta_graph",
        label="a checkpoint's graph (.meta)",
        sniff=lambda file: file.numbers >= {(1, 2), (2, 2)} and file.fields[0][:2] == (1, 2) and not file.is_graph,
        read=_source.read,
        takes=_STEPS,
    ),
    Format(
        key="run_folder",
        label="a folder that training left",
        at=lambda path: path.is_dir() and bool(_listing.behaviors(path)),
        members=_source.members,
        takes=frozenset({"step", "sensors"}),
    ),
)
