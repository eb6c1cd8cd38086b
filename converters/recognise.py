"""What a file is, by its content. File names lie: public ``.bytes`` are ``.nn``, Unity assets, Git LFS pointers."""

from __future__ import annotations

import codecs
import json
import re
import stat
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

from converters.checkpoint import listing
from signatures.errors import DamagedFileError, NotAPolicyError, SourceError

_HEAD = 4096
#: Protobuf's own limit; no policy comes near it.
MAX_BYTES = (2 << 30) - 1
_TABLE_MAGIC = struct.pack("<Q", 0xDB4775248B80FB57)
#: The op of a node (field 2 of NodeDef, with its length) that keeps its value in a checkpoint.
_VARIABLE = re.compile(rb"\x12(\x0aVariableV2|\x0bVarHandleOp|\x08Variable|\x12AutoReloadVariable)")


@dataclass(frozen=True, slots=True)
class FileKind:
    """A kind of file: a short key, what people call it, and what to do with it when no reader takes it."""

    key: str
    label: str
    advice: str = ""


FROZEN_GRAPH = FileKind("frozen_graph", "a TensorFlow graph (GraphDef)")
KINDS = {
    kind.key: kind
    for kind in (
        FROZEN_GRAPH,
        FileKind("nn", "a Barracuda .nn model"),
        FileKind("onnx", "an ONNX model"),
        FileKind("saved_model", "a SavedModel"),
        FileKind("meta_graph", "a checkpoint's graph (.meta)"),
        FileKind("raw_graph", "a graph with variables, as training begins with (raw_graph_def.pb)"),
        FileKind("checkpoint", "a TensorFlow checkpoint"),
        FileKind("run_folder", "a folder that training left"),
        FileKind("bundle", "a bundle of export-model"),
        FileKind(
            "lfs_pointer",
            "a Git LFS pointer, not the model itself",
            "run 'git lfs pull' in the repository it came from, or download the file through the web page",
        ),
        FileKind("torch_checkpoint", "a PyTorch checkpoint (.pt)"),
        FileKind("keras", "a Keras model"),
        FileKind("hdf5", "a Keras model in HDF5 (.h5)"),
        FileKind("tflite", "a TensorFlow Lite model", "give the graph it was converted from"),
        FileKind(
            "sentis",
            "a Unity Sentis / Inference Engine model (.sentis)",
            "Unity's runtime format cannot be read back; give the .onnx it was imported from",
        ),
        FileKind(
            "unity_asset",
            "a Unity asset, which only refers to a model or wraps it",
            "give the .nn, .onnx or .bytes file itself, as it lies in the project's Assets folder",
        ),
        FileKind("tfjs", "a TensorFlow.js model"),
        FileKind(
            "text_graph", "a graph in text form (.pbtxt)", "save it in binary: tf.io.write_graph(..., as_text=False)"
        ),
        FileKind("json", "JSON", "give a model file"),
        FileKind("zip", "a ZIP archive", "unpack it and give the model inside"),
        FileKind("gzip", "a gzip archive", "unpack it and give the model inside"),
        FileKind("html", "a web page", "download the raw file instead of the page that shows it"),
        FileKind("text", "a text file", "give a model file"),
        FileKind("unknown", "not a model in any form this tool knows", "give a .bytes or frozen_graph_def.pb file"),
    )
}


def read_bytes(path: Path) -> bytes:
    """The file's bytes; SourceError when it is missing, a folder or unreadable, DamagedFileError when empty."""
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise SourceError(
                "is a folder", where=str(path), why="a single model file is expected", fix="give a file in it"
            )
        if not stat.S_ISREG(status.st_mode):
            raise SourceError("is a pipe or a device", where=str(path), fix="copy it to a file first, and give that")
        if status.st_size > MAX_BYTES:
            raise SourceError(
                f"has {status.st_size} bytes, and no model of 2 GiB or more is read",
                where=str(path),
                fix="give the frozen graph of the policy; it has some hundred kilobytes",
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise SourceError("no such file", where=str(path), fix=_neighbours(path)) from error
    except OSError as error:
        raise SourceError(
            "cannot be read", where=str(path), why=error.strerror, fix="check the path and its permissions"
        ) from error
    except ValueError as error:  # a null character in the path
        raise SourceError("is no path", where=repr(str(path)), why=str(error), fix="check the path") from error
    if not data:
        raise DamagedFileError("the file is empty", where=str(path), fix="copy or download it again")
    return data


def _neighbours(path: Path) -> str:
    import difflib

    try:
        names = sorted(p.name for p in path.parent.iterdir())
    except OSError:  # there is no such folder, or it may not be listed
        names = []
    close = difflib.get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the path"


def recognise_path(path: Path) -> FileKind:
    """The kind of a file (by content) or folder (by what lies in it). Raises SourceError, DamagedFileError.

    A checkpoint's prefix (``model-1000.cptk``) is no file; it is recognised by its index.
    """
    try:
        if path.is_dir():
            return KINDS[_folder_key(path)]
        if path.name and not path.exists() and path.with_name(path.name + ".index").is_file():
            return KINDS["checkpoint"]
    except OSError as error:
        raise SourceError(
            "cannot be read", where=str(path), why=error.strerror, fix="check the path and its permissions"
        ) from error
    return recognise(read_bytes(path), path.name)


def _folder_key(folder: Path) -> str:
    for file, key in (("policy.json", "bundle"), ("saved_model.pb", "saved_model"), ("model.json", "tfjs")):
        if (folder / file).is_file():
            return key
    if listing.behaviors(folder):
        return "run_folder"
    inside = sorted(p.name + ("/" if p.is_dir() else "") for p in folder.iterdir())
    shown = ", ".join(inside[:10]) + (f" and {len(inside) - 10} more" if len(inside) > 10 else "")
    nested = listing.runs(folder)
    if nested:
        fix = f"give one of the folders in it: {', '.join(map(str, nested[:5]))}" + (", …" if nested[5:] else "")
    else:
        fix = "give a run's folder (models/<run>, results/<run>), a SavedModel, a TensorFlow.js model, or a model file"
    raise SourceError(
        "there is no model in this folder",
        where=str(folder),
        why=f"it holds {shown}" if inside else "it is empty",
        fix=fix,
    )


def recognise(data: bytes, name: str = "") -> FileKind:
    """The kind of file that ``data`` is; ``name`` only decides where the bytes cannot (Sentis)."""
    return KINDS[_key(data, name)]


def _key(data: bytes, name: str) -> str:
    head = data[:_HEAD]
    if head.startswith(b"version https://git-lfs"):
        return "lfs_pointer"
    if len(data) >= 8 and 15 <= struct.unpack_from("<q", data)[0] <= 20:
        return "nn"
    if head.startswith(b"PK\x03\x04"):
        return _zip_key(data)
    if head.startswith(b"\x1f\x8b"):
        return "gzip"
    if head.startswith(b"\x89HDF"):
        return "hdf5"
    if head[4:8] == b"TFL3":
        return "tflite"
    if head.startswith((b"UnityFS", b"UnityRaw", b"UnityWeb", b"%YAML 1.1\n%TAG !u!")) or b"%TAG !u!" in head[:64]:
        return "unity_asset"
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")):
        return "torch_checkpoint"
    if data.endswith(_TABLE_MAGIC):
        return "checkpoint"
    text = _text_key(data, head)
    if text:
        return text
    if name.lower().endswith(".sentis"):
        return "sentis"
    return _protobuf_key(data) or ("checkpoint" if ".data-" in name else "unknown")


def _zip_key(data: bytes) -> str:
    import io

    try:
        names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, struct.error):  # a damaged one
        return "zip"
    if any(n.endswith("data.pkl") for n in names):
        return "torch_checkpoint"
    if "model.weights.h5" in names or "config.json" in names:
        return "keras"
    return "zip"


def _text_key(data: bytes, head: bytes) -> str | None:
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(head)  # the head may end inside a character
    except UnicodeDecodeError:
        return None
    if any(ord(c) < 9 or 13 < ord(c) < 27 for c in text):
        return None
    start = text.lstrip()
    if start.startswith(("node {", "node{")):
        return "text_graph"
    if start.startswith(("model_checkpoint_path:", "all_model_checkpoint_paths:")):
        return "checkpoint"
    if start.lower().startswith(("<!doctype", "<html")):
        return "html"
    if start.startswith("{"):
        try:
            return "tfjs" if "modelTopology" in json.loads(data) else "json"
        except (ValueError, TypeError, RecursionError):
            return "text"
    return "text"


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 64:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
        shift += 7
    return -1, at


def _fields(data: bytes, limit: int = 64) -> list[tuple[int, int, bytes]]:
    """(number, wire type, payload) of the first fields of a protobuf message; [] where it is none."""
    found: list[tuple[int, int, bytes]] = []
    at = 0
    while at < len(data) and len(found) < limit:
        tag, at = _varint(data, at)
        number, wire = tag >> 3, tag & 7
        if tag < 0 or number == 0 or wire not in (0, 1, 2, 5):
            return found if at >= len(data) else []
        if wire == 0:
            start = at
            _, at = _varint(data, at)
            found.append((number, wire, data[start:at]))
        else:
            length, at = _varint(data, at) if wire == 2 else ({1: 8, 5: 4}[wire], at)
            if length < 0:
                return []
            found.append((number, wire, data[at : at + length]))
            at += length
    return found


def _protobuf_key(data: bytes) -> str | None:
    """Tell GraphDef, MetaGraphDef, SavedModel and ONNX apart by their first fields."""
    fields = _fields(data)
    if not fields:
        return None
    numbers = {(n, w) for n, w, _ in fields}
    if fields[0][:2] == (1, 0):  # both SavedModel and ONNX begin with an integer
        if (8, 2) in numbers or (7, 2) in numbers:
            return "onnx"
        if fields[0][2] == b"\x01" and len(fields) > 1 and fields[1][:2] == (2, 2):
            return "saved_model"
        return None
    if fields[0][:2] == (1, 2):
        first = _fields(fields[0][2], 3)
        if [(n, w) for n, w, _ in first[:2]] == [(1, 2), (2, 2)] and _is_op_name(first[1][2]):
            return "raw_graph" if _VARIABLE.search(data) else "frozen_graph"
        return "meta_graph" if (2, 2) in numbers else None
    return None


def _is_op_name(data: bytes) -> bool:
    return bool(data) and data[:1].isalpha() | data.startswith(b"_") and all(c < 128 for c in data) and len(data) < 100


def not_readable(kind: FileKind, path: Path) -> NotAPolicyError:
    """The refusal of a file whose kind no reader takes: what it looks like instead, and what to do."""
    return NotAPolicyError(
        f"is {kind.label}" if kind.key != "unknown" else kind.label,
        where=str(path),
        why="its content says so, whatever its name is" if kind.key not in ("unknown", "sentis") else None,
        fix=kind.advice or None,
    )
