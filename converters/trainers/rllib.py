"""RLlib's own modules of actor and critic (PPO, APPO, IMPALA), rebuilt from their state and their arguments.

Source: ray/rllib/core/models/torch/{encoder,heads,primitives}.py, core/models/catalog.py,
core/rl_module/default_model_config.py and models/torch/torch_distributions.py of Ray 2.60. Names are
``encoder.encoder.net.mlp.<n>`` (``encoder.actor_encoder`` where the critic has its own; ``tokenizer`` and ``lstm`` with
``use_lstm``) and ``pi.net.mlp.<n>``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.files.pickled_objects import Instance, array_of
from export_model.converters.graph.nn.activations import clip
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.rsl_rl import per_action
from export_model.converters.trainers.settings import Settings
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import DamagedFileError, SourceError
from export_model.signatures.roles import Role

_EXPORT_ONNX = "load it in RLlib, export the module (torch.onnx.export), and give the .onnx"
_FILE = "class_and_ctor_args.pkl"
_CLASSES = ("DefaultPPOTorchRLModule", "DefaultAPPOTorchRLModule", "PPOTorchRLModule", "APPOTorchRLModule")
#: How far the logarithm of a deviation may be from 0; of choices it stands there too, and says nothing.
_LIMIT = "pi.log_std_clip_param_const"
#: What training alone needs: the critic, and APPO's policy of before.
_TRAINING = ("vf.", "encoder.critic_encoder.", "_old_encoder.", "_old_pi.", _LIMIT)


def _arguments_of(saved: Saved) -> Any:
    """Return what a module was made with; None where another wrote what was saved."""
    return None if saved.settings is None else saved.settings.get("rllib")


def _rebuild(saved: Saved, arguments: Any) -> Rebuilt:
    saved.refuse_activation("a module of RLlib", "its class_and_ctor_args.pkl has it")
    given = arguments if isinstance(arguments, dict) else {}
    made, pair = given.get("class"), given.get("ctor_args_and_kwargs")
    named = pair[1] if isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], dict) else None
    name = getattr(made, "name", None)
    if named is None or not isinstance(name, str):
        raise DamagedFileError(f"its {_FILE} must name a class and its arguments", why="it is damaged")
    if name not in _CLASSES:
        raise SourceError(
            f"its module is {name[:80]}, which is not built here",
            why=f"of RLlib's modules {', '.join(_CLASSES[:2])} are; what others compute is only in their code",
            fix=_EXPORT_ONNX,
        )
    graph, facts = _rebuild_actor(saved, named)
    return Rebuilt(graph, facts)


def _rebuild_actor(saved: Saved, named: Mapping[Any, Any]) -> tuple[Graph, SourceFacts]:
    """Return the policy and what is known of it.

    Raises SourceError for settings and parts that are not built, DamagedFileError.
    """
    settings = Settings(_attributes(named.get("model_config")), _FILE, "model_config")
    for key in ("conv_filters", "lstm_use_prev_action", "lstm_use_prev_reward"):
        if settings.values.get(key):
            raise settings.error(key, "is set, and such networks are not built")
    weights = Weights(saved.archive, saved.value, holder="its policy", maker="RLlib", fix=_EXPORT_ONNX)
    own = "encoder.actor_encoder" if weights.under("encoder.actor_encoder.") else "encoder.encoder"
    weights.forget(*_TRAINING)
    net, activation = Network(weights), settings.activation("fcnet_activation", "tanh")
    recurrent = settings.flag("use_lstm")
    first = f"{own}.tokenizer.net.mlp" if recurrent else f"{own}.net.mlp"
    x = net.input("obs", weights.length(f"{first}.0.weight", 1))
    x = net.mlp(x, first, activation)
    memory: tuple[str, ...] = ()
    if recurrent:
        x, memory = net.remembering(x, f"{own}.lstm")
    x = net.mlp(x, "pi.net.mlp", settings.activation("head_fcnet_activation", "relu"), ends=True)
    outputs = _act(net, x, named.get("action_space"), settings)
    outputs |= {"recurrent_out": Role.MEMORY_OUT} if memory else {}
    weights.check_all_read()
    facts = SourceFacts(
        family="RLlib",
        memory_layout=memory,
        outputs=outputs,
        notes=(
            pytorch_alone("RLlib"),
            f"its network is built as {_FILE} says",
            "what RLlib's connectors do before and behind it (a filter of observations, actions brought from -1 … 1 to "
            "the limits of the environment: normalize_actions) is not in the module",
        ),
    )
    return net.graph(), facts


def _attributes(value: Any) -> Mapping[str, Any]:
    """Return a pickled dictionary, or an object's attributes. Raises DamagedFileError."""
    found = value.state if isinstance(value, Instance) else value
    if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
        raise DamagedFileError(f"its {_FILE} has no model_config", why="every module of RLlib's own has one")
    return found


def _act(net: Network, x: str, space: Any, settings: Settings) -> dict[str, Role | None]:
    """Add the outputs that a space of actions asks for. Raises SourceError for another space."""
    kind = space.maker.name if isinstance(space, Instance) else ""
    if kind == "Box":
        return _continuous(net, x, settings)
    if kind == "Discrete":
        net.at("action")
        net.output("action", net.choice(x))
    elif kind == "MultiDiscrete":
        counts = array_of(space.attribute("nvec"), "'nvec' of its actions").reshape(-1)
        sizes = [int(n) for n in counts]
        if sum(sizes) != net.width(x) or min(sizes, default=0) < 1:
            raise net.state.damaged_error(f"its actions have {sizes} choices", f"its network gives {net.width(x)}")
        net.at("action")
        net.output("action", net.choices(x, sizes))
    else:
        raise SourceError(
            f"its space of actions is {kind[:60] or 'missing'}, which is not built here",
            why="Box, Discrete and MultiDiscrete are",
            fix=_EXPORT_ONNX,
        )
    return {"action": Role.ACTION}


def _continuous(net: Network, x: str, settings: Settings) -> dict[str, Role | None]:
    """The mean, and the logarithm of the deviation: a weight of its own (``free_log_std``), or half of the numbers."""
    limit = net.state.number(_LIMIT) if _LIMIT in net.state else settings.number("log_std_clip_param", 20.0)
    if "pi.log_std" in net.state:
        mean = x
        values = net.state.array("pi.log_std", net.width(mean))
        per_action(net, mean, np.clip(values, -limit, limit).astype(FLOAT32), "action_log_std")
    else:
        actions, rest = divmod(net.width(x), 2)
        if rest or not actions:
            raise net.state.damaged_error(f"its network gives {net.width(x)} numbers", "a mean and a deviation each")
        net.at("action_log_std")
        mean, logarithm = (net.slice(x, 1, i * actions, (i + 1) * actions) for i in (0, 1))
        net.output("action_log_std", clip(net, logarithm, -limit, limit))
    net.at("action")
    net.output("action", mean)
    return {"action": Role.ACTION, "action_log_std": Role.LOG_STD}


TRAINER = Trainer("RLlib", _arguments_of, _rebuild, by_names=False)
