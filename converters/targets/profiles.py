"""The list of profiles: every consumer that a policy can be made for, in a file of its own beside this one."""

from __future__ import annotations

import difflib

from converters.targets import barracuda3, barracuda10, barracuda14, tfsharp, unity6
from converters.targets.profile import Profile
from signatures.errors import UsageError

#: The newest first; ``--for help`` shows them in this order.
PROFILES: tuple[Profile, ...] = (
    unity6.PROFILE,
    barracuda3.PROFILE,
    barracuda14.PROFILE,
    barracuda10.PROFILE,
    *tfsharp.PROFILES,
)


def profile(name: str) -> Profile:
    """The profile of a word of ``--for``. Raises UsageError."""
    for known in PROFILES:
        if name.lower() in (known.name, *known.aliases):
            return known
    names = [n for p in PROFILES for n in (p.name, *p.aliases)]
    close = difflib.get_close_matches(name.lower(), names, n=1)
    raise UsageError(
        f"--for {name}: there is no such profile",
        fix=(f"did you mean {close[0]}? " if close else "") + f"the profiles are {', '.join(p.name for p in PROFILES)}",
    )
