"""``python -m tests.bench``: how much faster and smaller than the tools that a user would run instead.

Every figure is of a whole process, started cold. It measures and prints; it has no limits that it could fail by.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from pathlib import Path
from statistics import median

from tests.bench.contest import OURS, PEERS, Contest, run_contest
from tests.peers.environment import PeersUnavailableError, ensure_peers

#: Fixture → rounds.
POLICIES = {"continuous": 5, "recurrent": 3, "visual": 3}
#: The policy of 3DBall's size that the aims are about.
NAMED, SPEED_TARGET, MEMORY_TARGET = "continuous", 20, 10


def report(contest: Contest) -> str:
    """The table of one policy."""
    lines = [
        f"{contest.policy}: median of {len(contest.rounds)} rounds",
        f"  {'':24}{'wall s':>9}{'peak MiB':>10}{'kB':>9}{'ours, kB':>10}",
        f"  {OURS:24}{contest.seconds(OURS):>9.3f}{contest.peak(OURS):>10.1f}",
    ]
    for name in PEERS:
        theirs, ours = contest.sizes[name]
        costs = f"{contest.seconds(name):>9.3f}{contest.peak(name):>10.1f}"
        lines.append(f"  {name:24}{costs}{theirs / 1000:>9.1f}{ours / 1000:>10.1f}")
    ratios = contest.speed_ratios
    lines += [
        f"  wall: the three / ours  {median(ratios):>9.1f}x   {min(ratios):.1f} to {max(ratios):.1f}",
        f"  peak: largest / ours    {contest.memory_ratio:>9.1f}x",
    ]
    if contest.policy == NAMED:
        lines.append(f"  (aimed at: {SPEED_TARGET}x and {MEMORY_TARGET}x)")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--policy", action="append", choices=sorted(POLICIES), help="only this fixture (repeatable)")
    parser.add_argument("--rounds", type=int, help="rounds per policy")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    options = parser.parse_args()
    try:
        peers = ensure_peers()
    except PeersUnavailableError as error:
        # Not a failure of this program: there is nothing to compare it with.
        print(f"not measured: {error}")
        return 0
    print(f"Python {platform.python_version()}, {platform.system()} {platform.machine()}, {os.cpu_count()} cores")
    print(f"{OURS} writes four formats (--verify none); each of the others writes one of them\n", flush=True)
    contests = []
    with tempfile.TemporaryDirectory() as scratch:
        for policy in options.policy or POLICIES:
            contests.append(run_contest(policy, options.rounds or POLICIES[policy], peers, Path(scratch)))
            print(report(contests[-1]) + "\n", flush=True)
    if options.json:
        content = {"schema": 1, "contests": [c.to_dict() for c in contests]}
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
