"""What a file is, by its content. File names lie: public ``.bytes`` are ``.nn``, Unity assets, Git LFS pointers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from export_model.converters.files.fetch import Fetched, unreadable
from export_model.converters.files.file_probe import PICKLES, Content
from export_model.converters.formats.checkpoint import listing
from export_model.converters.formats.format import Format
from export_model.converters.formats.other_json import KINDS, is_kind, keys_of
from export_model.converters.formats.registry import FORMATS
from export_model.signatures.errors import NotAPolicyError, SourceError

_UNITY_ASSET = (b"UnityFS", b"UnityRaw", b"UnityWeb", b"%YAML 1.1\n%TAG !u!")
_UNPACK = "unpack it and give the model inside"
_NOT_A_MODEL = "give a model file"


def _has_mark(at: int, marks: Sequence[bytes], file: Content) -> bool:
    return any(file.head[at : at + len(mark)] == mark for mark in marks)


#: What is to be done with weights whose network is in the code of a library.
_NETWORK = "load it in its library, export the policy there (torch.onnx.export), and give the .onnx"


def _is_safetensors(file: Content) -> bool:
    """Whether it begins with the length of a JSON header, eight bytes, and that header."""
    return file.head[8:10] == b'{"' and 2 <= int.from_bytes(file.head[:8], "little") <= _MOST_HEADER


#: The longest header that safetensors reads (100 MB).
_MOST_HEADER = 100_000_000


#: Key, name, advice, where the mark stands, and the marks.
_OTHERS: tuple[tuple[str, str, str, int, *tuple[bytes, ...]], ...] = (
    ("png", "a PNG picture", _NOT_A_MODEL, 0, b"\x89PNG\r\n"),
    ("jpeg", "a JPEG picture", _NOT_A_MODEL, 0, b"\xff\xd8\xff"),
    ("gif", "a GIF picture", _NOT_A_MODEL, 0, b"GIF87a", b"GIF89a"),
    ("pdf", "a PDF document", _NOT_A_MODEL, 0, b"%PDF-"),
    ("video", "a video", _NOT_A_MODEL, 4, b"ftyp"),
    ("npy", "a NumPy array", "give the model that it belongs to", 0, b"\x93NUMPY"),
    ("xz", "an xz archive", _UNPACK, 0, b"\xfd7zXZ"),
    ("bzip2", "a bzip2 archive", _UNPACK, 0, b"BZh"),
    ("7z", "a 7z archive", _UNPACK, 0, b"7z\xbc\xaf\x27\x1c"),
    ("rar", "a RAR archive", _UNPACK, 0, b"Rar!\x1a"),
    ("zstd", "a Zstandard archive", _UNPACK, 0, b"\x28\xb5\x2f\xfd"),
    ("tar", "a tar archive", _UNPACK, 257, b"ustar"),
    ("program", "a program or library", _NOT_A_MODEL, 0, b"\x7fELF", b"MZ\x90", b"\xcf\xfa\xed\xfe"),
    ("sqlite", "an SQLite database", _NOT_A_MODEL, 0, b"SQLite format 3"),
)
#: What people give and no reader takes, the particular before the general.
REFUSED = (
    Format(
        key="lfs_pointer",
        label="a Git LFS pointer, not the model itself",
        advice="run 'git lfs pull' in the repository it came from, or download the file through the web page",
        sniff=lambda file: file.starts(b"version https://git-lfs"),
    ),
    Format(
        key="unity_asset",
        label="a Unity asset, which only refers to a model or wraps it",
        advice="give the .nn, .onnx or .bytes file itself, from the project's Assets folder",
        sniff=lambda file: file.starts(*_UNITY_ASSET) or b"%TAG !u!" in file.head[:64],
    ),
    Format(
        key="text_graph",
        label="a graph in text form (.pbtxt)",
        advice="save it in binary: tf.io.write_graph(..., as_text=False)",
        sniff=lambda file: (file.text or "").startswith(("node {", "node{")),
    ),
    Format(
        key="html",
        label="a web page",
        advice="download the raw file instead of the page that shows it",
        sniff=lambda file: (file.text or "").lower().startswith(("<!doctype", "<html")),
    ),
    *(
        Format(
            key=key,
            label=label,
            advice=advice,
            sniff=partial(_has_mark, at, marks),
        )
        for key, label, advice, at, *marks in _OTHERS
    ),
    Format(
        key="safetensors",
        label="weights without their network (safetensors), as LeRobot and other libraries save them",
        advice=_NETWORK,
        sniff=_is_safetensors,
    ),
    *(Format(key=k.key, label=k.label, advice=k.advice, sniff=partial(is_kind, k)) for k in KINDS),
    Format(
        key="json",
        label="JSON, and not of a model",
        advice="give the model itself: a TensorFlow.js model.json has modelTopology, a bundle is a folder",
        sniff=lambda file: file.json is not None,
    ),
    Format(
        key="pickle",
        label="a pickle that PyTorch did not write",
        advice="give the checkpoint itself (.pt, .pth, .zip): statistics next to it are read, settings and "
        "replay buffers are not needed",
        sniff=lambda file: file.starts(*PICKLES),
    ),
    Format(key="zip", label="a ZIP archive", advice=_UNPACK, sniff=lambda file: file.starts(b"PK\x03\x04")),
    Format(key="gzip", label="a gzip archive", advice=_UNPACK, sniff=lambda file: file.starts(b"\x1f\x8b")),
    Format(
        key="sentis",
        label="a Unity Sentis / Inference Engine model (.sentis)",
        advice="Unity's runtime format cannot be read back; give the .onnx it was imported from",
        sniff=lambda file: file.text is None and file.name.lower().endswith(".sentis"),
    ),
    Format(
        key="text",
        label="a text file",
        advice="give a model file, or a .txt with the path of one on each line",
        sniff=lambda file: file.text is not None,
    ),
)
UNKNOWN = Format(
    key="unknown",
    label="not a model in any form this tool knows",
    advice="give a .bytes or frozen_graph_def.pb file",
)


def recognise(data: bytes, name: str = "") -> Format:
    """The format that ``data`` is in; ``name`` only decides where the bytes cannot (Sentis)."""
    content = Content(data, name)
    return next((f for f in (*FORMATS, *REFUSED) if f.sniff is not None and f.sniff(content)), UNKNOWN)


def recognise_path(given: Fetched) -> Format:
    """The format of a file (by content) or a folder (by what lies in it). Raises SourceError, DamagedFileError.

    A checkpoint's prefix (``model-1000.cptk``) is no file; it is recognised by its index.
    """
    path = given.path
    try:
        folder = path if path.is_dir() or not path.exists() else path.parent
        marked = [f for f in FORMATS if f.marker and (folder / f.marker).is_file()]
        if folder == path:
            found = next(iter(marked), None) or next((f for f in FORMATS if f.at is not None and f.at(path)), None)
        else:  # a file of several that are one model
            found = next((f for f in marked if f.at is not None and f.at(path)), None)
        if found is not None:
            return found
        if path.is_dir():
            raise _nothing_in(path)
    except OSError as error:
        raise unreadable(path, error) from error
    return recognise(given.data, path.name)


def _nothing_in(folder: Path) -> SourceError:
    """There is no model in a folder: what there is instead, and where one may be."""
    inside = sorted(p.name + ("/" if p.is_dir() else "") for p in folder.iterdir())
    shown = ", ".join(inside[:10]) + (f" and {len(inside) - 10} more" if len(inside) > 10 else "")
    nested = listing.runs(folder)
    if nested:
        fix = f"give one of the folders in it: {', '.join(map(str, nested[:5]))}" + (", …" if nested[5:] else "")
    elif any(n.startswith("rllib_checkpoint.") for n in inside):
        fix = (
            "it is a checkpoint of RLlib without rl_module/<name>/module_state.pkl (the old API stack, or another "
            "framework): load it there, export its module (torch.onnx.export), and give the .onnx"
        )
    elif {"config.json", "model.safetensors"} <= {*inside}:
        fix = f"it is a policy of LeRobot or a model of another library, weights without their network: {_NETWORK}"
    else:
        fix = "give a run's folder (models/<run>, results/<run>), a SavedModel, a TensorFlow.js model, or a model file"
    return SourceError(
        "no model found in this folder",
        where=str(folder),
        why=f"it holds {shown}" if inside else "it is empty",
        fix=fix,
    )


def not_readable(found: Format, path: Path, data: bytes = b"") -> NotAPolicyError:
    """The refusal of a file that no reader takes: what it looks like instead, and what to do."""
    why = "its content says so, whatever its name is" if found.key not in ("unknown", "sentis") else None
    return NotAPolicyError(
        f"is {found.label}" if found is not UNKNOWN else found.label,
        where=str(path),
        why=keys_of(Content(data)) if found.key == "json" else why,
        fix=found.advice or None,
    )
