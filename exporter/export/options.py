"""What a person says of how a source is understood, checked: the same for the command line and for Python."""

from __future__ import annotations

from collections.abc import Mapping

from converters.graph.options import CompileOptions, NoiseMode
from signatures.errors import UsageError
from signatures.roles import Role, parse_role


def _roles(given: Mapping[str, str | Role] | None, flag: str) -> dict[str, Role]:
    roles: dict[str, Role] = {}
    for name, role in (given or {}).items():
        parsed = role if isinstance(role, Role) else parse_role(role)
        if parsed is None:
            known = ", ".join(r.value for r in Role)
            raise UsageError(f"{flag} {name}={role}: there is no such role", fix=f"the roles are {known}")
        roles[name] = parsed
    return roles


def compile_options(
    names: str,
    noise: str,
    deterministic: bool,
    brain: str | None,
    inputs: Mapping[str, str | Role] | None,
    outputs: Mapping[str, str | Role] | None,
    values: Mapping[str, float] | None,
) -> CompileOptions:
    """What a person says of an export, checked; ``inputs`` and ``outputs`` give roles by name. Raises UsageError."""
    modes: dict[str, NoiseMode] = {"lift": "lift", "keep": "keep", "zero": "zero"}
    if names not in ("canonical", "source"):
        raise UsageError(f"names={names!r}", fix="one of: canonical, source")
    if noise not in modes:
        raise UsageError(f"noise={noise!r}", fix="one of: lift, keep, zero")
    return CompileOptions(
        names,
        modes[noise],
        deterministic,
        brain,
        _roles(inputs, "--input"),
        _roles(outputs, "--output"),
        dict(values or {}),
    )
