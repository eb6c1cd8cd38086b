"""Policies of PyTorch, each as its users keep it: ``python modules.py FOLDER``, with torch and onnxscript.

Of each module stand in the folder a trace and a script (TorchScript), the ONNX of both exporters, and where a trainer
that is read keeps one like it, its checkpoint. Not imported by tests: they have no PyTorch.
"""

from __future__ import annotations

import itertools
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn


def mlp(*sizes: int, activation: Callable[[], nn.Module] = nn.ELU) -> nn.Sequential:
    """Linear layers with an activation between."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), activation()]
    return nn.Sequential(*layers[:-1])


class Actor(nn.Module):
    """A normaliser (rsl_rl's), an MLP, and what is done to its end."""

    def __init__(self, actor: nn.Module, size: int, end: str = "") -> None:
        super().__init__()
        self.actor, self.end = actor, end
        self.register_buffer("_mean", torch.randn(1, size))
        self.register_buffer("_std", torch.rand(1, size) + 0.5)

    def forward(self, obs: Tensor) -> Tensor:
        x = self.actor((obs - self._mean) / (self._std + 1e-2))
        if self.end == "tanh":
            return torch.tanh(x)
        if self.end == "clip":
            return torch.clamp(x, -1.0, 1.0)
        return x


class Remembering(nn.Module):
    """A recurrent layer whose state is given and given back."""

    def __init__(self, kind: type[nn.GRU], layers: int = 1) -> None:
        super().__init__()
        self.rnn, self.actor = kind(10, 8, layers), mlp(8, 16, 3)

    def forward(self, obs: Tensor, h_in: Tensor) -> tuple[Tensor, Tensor]:
        y, h_out = self.rnn(obs.unsqueeze(0), h_in)
        return self.actor(y.squeeze(0)), h_out


class RememberingTwo(nn.Module):
    """An LSTM whose two states are given and given back."""

    def __init__(self) -> None:
        super().__init__()
        self.rnn, self.actor = nn.LSTM(10, 8), mlp(8, 16, 3)

    def forward(self, obs: Tensor, h_in: Tensor, c_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        y, (h_out, c_out) = self.rnn(obs.unsqueeze(0), (h_in, c_in))
        return self.actor(y.squeeze(0)), h_out, c_out


class Eye(nn.Module):
    """Convolutions of an image, then layers."""

    def __init__(self) -> None:
        super().__init__()
        self.cnn = nn.Sequential(nn.Conv2d(3, 8, 4, 2), nn.ReLU(), nn.Conv2d(8, 8, 3, 1), nn.ReLU(), nn.Flatten())
        self.head = nn.Linear(8 * 7 * 7, 4)

    def forward(self, obs: Tensor) -> Tensor:
        return self.head(self.cnn(obs / 255.0))


class Attending(nn.Module):
    """Attention over the parts of a row."""

    def __init__(self) -> None:
        super().__init__()
        self.embed, self.norm, self.head = nn.Linear(4, 8), nn.LayerNorm(8), nn.Linear(8, 3)

    def forward(self, obs: Tensor) -> Tensor:
        x = self.embed(obs.reshape(-1, 5, 4))
        x = self.norm(x + torch.softmax(x @ x.transpose(1, 2) / 2.8, -1) @ x)
        return self.head(x.mean(1))


class History(nn.Module):
    """A convolution over the steps of a row of frames."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.head = nn.Conv1d(4, 6, 3), nn.Linear(18, 3)

    def forward(self, obs: Tensor) -> Tensor:
        return self.head(nn.functional.elu(self.conv(obs.reshape(-1, 5, 4).transpose(1, 2))).flatten(1))


def modules() -> dict[str, tuple[nn.Module, tuple[Tensor, ...], list[str]]]:
    """Name → (module, inputs of one agent, names of its outputs)."""
    row, state = torch.randn(1, 10), torch.randn(1, 1, 8)
    plain = {
        "rsl_elu": Actor(mlp(10, 32, 16, 3), 10),
        "rsl_selu": Actor(mlp(10, 16, 3, activation=nn.SELU), 10),
        "sb3_tanh_clip": Actor(mlp(10, 16, 16, 3, activation=nn.Tanh), 10, "clip"),
        "sac_relu_tanh": Actor(mlp(10, 32, 3, activation=nn.ReLU), 10, "tanh"),
        "dreamer_silu": Actor(mlp(10, 16, 3, activation=nn.SiLU), 10),
        "gelu": Actor(mlp(10, 16, 3, activation=nn.GELU), 10),
        "mish": Actor(mlp(10, 16, 3, activation=nn.Mish), 10),
        "leaky": Actor(mlp(10, 16, 3, activation=nn.LeakyReLU), 10, "tanh"),
        "norms": Actor(nn.Sequential(nn.Linear(10, 16), nn.LayerNorm(16), nn.ELU(), nn.Linear(16, 3)), 10),
        "batch_norm": Actor(nn.Sequential(nn.Linear(10, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Linear(16, 3)), 10),
        "softplus": Actor(mlp(10, 16, 3, activation=nn.Softplus), 10),
        "celu": Actor(mlp(10, 16, 3, activation=nn.CELU), 10, "clip"),
    }
    found = {name: (module, (row,), ["actions"]) for name, module in plain.items()}
    found["eye"] = Eye(), (torch.rand(1, 3, 20, 20) * 255,), ["actions"]
    found["attending"] = Attending(), (torch.randn(1, 20),), ["actions"]
    found["history"] = History(), (torch.randn(1, 20),), ["actions"]
    found["gru"] = Remembering(nn.GRU), (row, state), ["actions", "h_out"]
    found["gru_two"] = Remembering(nn.GRU, 2), (row, torch.randn(2, 1, 8)), ["actions", "h_out"]
    found["lstm"] = RememberingTwo(), (row, state, state * 0.5), ["actions", "h_out", "c_out"]
    return found


def checkpoint(module: nn.Module, name: str) -> dict[str, object] | None:
    """What rsl_rl 5.5 saves of an actor; None of another network."""
    if not name.startswith("rsl_") or not isinstance(module, Actor):
        return None
    state = {f"mlp.{n.removeprefix('actor.')}": t for n, t in module.state_dict().items() if n.startswith("actor.")}
    state |= {f"obs_normalizer.{n}": getattr(module, n) for n in ("_mean", "_std")}
    state["obs_normalizer._var"], state["obs_normalizer.count"] = module._std**2, torch.tensor(9)
    return {"actor_state_dict": state | {"distribution.std_param": torch.ones(3)}, "iter": 1, "infos": None}


def main(folder: Path) -> None:
    """Write all of them."""
    warnings.simplefilter("ignore")
    for name, (module, inputs, outputs) in modules().items():
        torch.manual_seed(len(name))
        for tensor in module.state_dict().values():
            if tensor.is_floating_point():
                tensor.copy_(tensor + 0.1 * torch.rand_like(tensor))
        module.eval()
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        names = {"input_names": ["obs", "h_in", "c_in"][: len(inputs)], "output_names": outputs}
        torch.jit.trace(module, inputs).save(str(place / "trace.pt"))
        torch.jit.script(module).save(str(place / "script.pt"))
        torch.onnx.export(module, inputs, str(place / "legacy.onnx"), dynamo=False, **names)
        torch.onnx.export(module, inputs, str(place / "dynamo.onnx"), dynamo=True, verbose=False, **names)
        saved = checkpoint(module, name)
        if saved is not None:
            torch.save(saved, place / "checkpoint.pt")
            (place / "agent.yaml").write_text(f"policy:\n  activation: {name.partition('_')[2]}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
