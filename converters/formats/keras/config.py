"""What a Keras file says it is made of: the layers by name, and whether any of them is code.

Keras builds whatever class or function its configuration names, so a file can name ``os.system`` (or a Lambda layer
with a marshalled function in it). The configuration is data: it is read here before Keras sees it, and what is not a
layer, an initialiser or the like of Keras itself is refused, whatever the version of Keras would do with it.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.file_probe import json_in
from export_model.converters.files.zip_archives import ZIP_ERRORS, entry_of, open_archive
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError

#: Bytes of a configuration; Keras' largest models have one of 2 MB.
MAX_CONFIG = 16 << 20
_MAX_DEPTH = 64
#: The packages whose classes a policy may be made of, by the first parts of a module's name.
_PACKAGES = (
    *("keras", "keras.src", "tf_keras", "tf_keras.src", "tensorflow.keras", "tensorflow.python.keras"),
    *("keras.api", "keras.api._v2.keras", "keras.engine"),
)
_ROOMS = frozenset(
    (
        *("layers", "models", "initializers", "regularizers", "constraints", "dtype_policies", "quantizers"),
        *("ops", "engine", "mixed_precision"),
    )
)
#: What training alone uses, which Keras builds too for a model inside of another.
_TRAINING = frozenset(("optimizers", "losses", "metrics"))
#: Classes that run what the file gives them, load what it names, or read files.
_CODE = frozenset(
    (
        *("Lambda", "TFOpLambda", "SlicingOpLambda", "TFClassMethodDispatch", "InstanceMethod", "InstanceProperty"),
        *("TensorFlowOpLayer", "AddLoss", "AddMetric", "TFSMLayer", "TorchModuleWrapper", "JaxLayer", "FlaxLayer"),
        *("HubLayer", "KerasLayer", "Map", "Scan", "AssociativeScan", "VectorizedMap", "WhileLoop", "ForiLoop", "Cond"),
        *("Switch", "CustomGradient", "Function", "ClassVariable"),
        *("StringLookup", "IntegerLookup", "IndexLookup", "TextVectorization"),
    )
)
#: Marks of a serialised value that is no class: what they hold is looked into.
_VALUES = frozenset(("__keras_tensor__", "__tensor__", "__numpy__", "__tuple__", "__ellipsis__", "__slice__"))


def config_of(path: Path, name: str = "config.json") -> Any:
    """The configuration in a ``.keras`` file (a zip), or another part of it in JSON. Raises DamagedFileError."""
    try:
        with open_archive(read_bytes(path)) as archive:
            return json_in(entry_of(archive, name, MAX_CONFIG))
    except (*ZIP_ERRORS, RecursionError) as error:
        raise DamagedFileError(
            "its configuration cannot be read",
            why=f"{type(error).__name__}: {error}"[:200],
            fix="save the model again: model.save('policy.keras')",
        ) from error


def config_inside(path: str) -> Any:
    """The configuration that Keras would take from a file, in a child that has h5py. Raises DamagedFileError.

    A file may be a ZIP archive and HDF5 at once (HDF5 may begin at byte 512): which it is for Keras, its name says.
    Weights that are links to other files are refused.
    """
    if path.endswith(".keras") and zipfile.is_zipfile(path):
        config = config_of(Path(path))
        if isinstance(config, dict):
            config.pop("compile_config", None)  # so does Keras, of the model itself, where it is not to be compiled
        return config
    import h5py

    with h5py.File(path, "r") as file:
        _refuse_links(file, h5py)
        text = file.attrs.get("model_config")
    if text is None or len(text) > MAX_CONFIG:
        raise no_configuration()
    return json_in(text)


#: What the arrays of a data set are called: d4rl (actions, observations, rewards), Minari (episode_0), robomimic and
#: LIBERO (data/demo_0), and those of supervised learning.
_DATA_SETS = re.compile(
    r"actions?|observations|next_observations|rewards|terminals|episode_\d+|data|demo_\d+|obs|x_train"
)


def no_configuration(names: Sequence[str] = ()) -> SourceError:
    """The error of an HDF5 file that does not say what it is made of; ``names`` are those that it holds."""
    shown = ", ".join(n[:40] for n in names[:6]) + (", …" if len(names) > 6 else "")
    if any(_DATA_SETS.fullmatch(n) for n in names):
        return NotAPolicyError(
            "is a data set, and holds no model",
            why=f"it has {shown}",
            fix="give the policy that was trained on it: .keras, .h5, .onnx, .pt",
        )
    return DamagedFileError(
        "it has no configuration of a model",
        why=f"it holds weights alone, or something else: {shown}" if shown else "it holds weights alone, or nothing",
        fix="save the whole model: model.save('policy.keras')",
    )


def _refuse_links(group: Any, h5py: Any, depth: int = 0) -> None:
    """Raise DamagedFileError where a group of an HDF5 file holds what is in another file."""
    for key in group:
        link = group.get(key, getlink=True)
        if isinstance(link, h5py.ExternalLink) or depth > _MAX_DEPTH:
            raise DamagedFileError(f"its {key!r} is in another file", fix="save the model again, in one file")
        if isinstance(link, h5py.SoftLink):
            continue
        value = group[key]
        if isinstance(value, h5py.Group):
            _refuse_links(value, h5py, depth + 1)
        elif getattr(value, "external", None):
            raise DamagedFileError(f"its {key!r} is in another file", fix="save the model again, in one file")


def stateful_layer(config: Any) -> str | None:
    """The first layer that keeps its state in itself from call to call."""
    inner = (entry.get("config") for _, entry in _objects(config))
    named = (str(c.get("name")) for c in inner if isinstance(c, dict) and c.get("stateful") is True)
    return next(named, None)


def refuse_code(config: Any, *, built: bool = False) -> None:
    """Raise NotAPolicyError where a configuration names anything but layers and settings of Keras itself.

    Where Keras itself is to build it (``built``), what training uses is looked at, too.
    """
    rooms = _ROOMS | _TRAINING if built else _ROOMS
    for place, named in _objects(config, built=built):
        if (own := _own_function(named)) is not None:
            raise _function(place, own)
        name = named.get("class_name")
        module, registered = named.get("module"), named.get("registered_name")
        if isinstance(name, str) and name in _VALUES:
            continue
        whole = ".".join(str(part) for part in (module, name) if part)
        if not isinstance(name, str) or name in _CODE or "lambda" in name.lower() or not name[:1].isupper():
            raise _code(whole)
        if not (module is None or isinstance(module, str)) or (module is not None and not _of_keras(module, rooms)):
            raise _code(whole)
        if ">" in name or (registered is not None and (not isinstance(registered, str) or ">" in registered)):
            raise _code(str(registered or whole))


def _of_keras(module: str, rooms: frozenset[str]) -> bool:
    """Whether a module is one of Keras' that hold layers and their settings."""
    inside = (module.removeprefix(f"{package}.") for package in _PACKAGES if module.startswith(f"{package}."))
    return module in _PACKAGES or any(rest.partition(".")[0] in rooms for rest in inside)


def _objects(config: Any, *, built: bool = False) -> Iterator[tuple[str, dict[str, Any]]]:
    """(where, what) of every object of a configuration that names a class, or should.

    What training alone uses is only looked at if it is ``built``. Where an object is reads ``the activation of its
    layer 'action'``; it is empty where that is not known.
    """
    stack = [("", "", config)]
    while stack:
        layer, key, value = stack.pop()
        if isinstance(value, dict):
            if "class_name" in value or "registered_name" in value or "__lambda__" in value or _is_bytecode(value):
                yield f"the {key} of its layer {layer!r}" if layer and key else "", value
            layer = str(value["name"])[:80] if key == "config" and isinstance(value.get("name"), str) else layer
            stack.extend((layer, k[:80], v) for k, v in value.items() if built or k != "compile_config")
        elif isinstance(value, list):
            stack.extend((layer, key, v) for v in value)


def _is_bytecode(value: dict[str, Any]) -> bool:
    """Whether this is a lambda as Keras writes an activation: its marshalled code, its defaults, its closure."""
    parts = value.get("value")
    return value.keys() == {"value"} and isinstance(parts, list) and len(parts) == 3 and isinstance(parts[0], str)


def _own_function(named: dict[str, Any]) -> str | None:
    """What a function of the user's own is called: an activation, an initialiser; None where it is a class."""
    if _is_bytecode(named) or named.get("class_name") == "__lambda__":
        return "a lambda (__lambda__)"
    if named.get("module") == "builtins" and named.get("class_name") == "function":
        return f"the function {str(named.get('config'))[:80]!r}"
    return None


def _function(place: str, function: str) -> NotAPolicyError:
    return NotAPolicyError(
        f"{place or 'a part of the Keras model'} is {function}, which is code and no layer of Keras",
        why="of a function the file has the bytecode or the name alone, and no code in a file is run",
        fix="save it with an activation or layers of Keras in its place; or in the process that trains it: "
        "export_model(keras_model=model)",
    )


def _code(name: str) -> NotAPolicyError:
    shown = name if name.isprintable() else repr(name)
    return NotAPolicyError(
        f"the Keras model is made of {shown[:200]}, which is code and no layer of Keras",
        why="Keras would run it when the model is loaded or called, and a model file is untrusted input",
        fix="replace it by layers of Keras; or in the process that trains it: export_model(keras_model=model)",
    )


def loss_of(training: Any) -> str:
    """What the loss of a ``training_config`` or ``compile_config`` is called; "" where there is none, or several.

    ``"mse"``, ``["mse"]``, ``{"q": "mse"}``; Keras 3: ``{"class_name": "Huber", "config": {…}}``, of a function
    ``{"class_name": "function", "config": "huber"}``.
    """
    loss = training.get("loss") if isinstance(training, dict) else None
    for _ in range(_MAX_DEPTH):
        if isinstance(loss, str):
            return loss[:200]
        if isinstance(loss, dict) and "class_name" in loss:
            plain = loss["class_name"] == "function" and isinstance(loss.get("config"), str)
            loss = loss["config"] if plain else loss["class_name"]
        elif isinstance(loss, dict | list) and len(loss) == 1:
            (loss,) = loss.values() if isinstance(loss, dict) else loss
        else:
            break
    return ""
