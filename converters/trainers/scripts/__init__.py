"""Bare state dictionaries of scripts that people copy (CleanRL, PPO-PyTorch), told by the names of their layers."""

from __future__ import annotations

from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.activations import activation_of, name_of
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.scripts.building import Making
from export_model.converters.trainers.scripts.choice import EXPORT_ONNX, Known, choose_script, known_state
from export_model.converters.trainers.trainer import Modules, Rebuilt, Saved, Trainer

_USUAL = "CleanRL's scripts have tanh in PPO, relu elsewhere and before images"


def _rebuild(saved: Saved, known: Known) -> Rebuilt:
    script, decided = choose_script(saved, known)
    activation, files, notes = activation_of(saved.given, saved.activation, _USUAL, script.default)
    weights = Weights(saved.archive, known.state, holder="its policy", maker=script.maker, fix=EXPORT_ONNX)
    weights.forget("critic", "_critic")
    making = Making(Network(weights), activation, saved, {}, [])
    script.build(making)
    weights.check_all_read()
    facts = SourceFacts(
        family=script.maker,
        algorithm=script.algorithm,
        image_layout="NCHW",
        memory_layout=making.memory,
        outputs=making.outputs,
        notes=(
            pytorch_alone("the script"),
            f"it is read as {script.key} ({decided}): {script.reading(known.state)}; observations that wrappers of the "
            "environment normalise or clip must come so",
            *making.notes,
            *notes,
        ),
    )
    plain = all(array.ndim < 3 for name, array in weights.arrays().items() if name.endswith("weight"))
    told = {"build": script.build.__name__, "activation": name_of(activation)}
    modules = Modules("scripts", weights, told) if plain else None
    return Rebuilt(making.net.graph(), facts, files, modules)


TRAINER = Trainer("CleanRL and PPO-PyTorch", lambda saved: known_state(saved.value), _rebuild, scripts=True)
