"""Hatchling's metadata hook: addresses of the project, and README.md as a page elsewhere shows it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|!\[[^\]]*\]\([^)]*\))*)\]\((?!https?://|#)([^)\s]+)\)")


def absolute(text: str, repository: str) -> str:
    """Return the text with links to files of the repository and its pictures as addresses, without the tests' notes."""

    def address(found: re.Match[str]) -> str:
        kind = "raw" if found[1] else "blob"
        return f"{found[1]}[{found[2]}]({repository}/{kind}/HEAD/{found[3]})"

    return _LINK.sub(address, re.sub(r"<!-- test: .*? -->\n", "", text))


class CustomMetadataHook(MetadataHookInterface):
    """Fills in what pyproject.toml calls dynamic, from the one address in it."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set ``urls`` and ``readme``."""
        repository = self.config["repository"]
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": absolute(text, repository)}
        metadata["urls"] = {
            "Homepage": repository,
            "Repository": repository,
            "Documentation": f"{repository}/blob/HEAD/docs/index.md",
            "Changelog": f"{repository}/blob/HEAD/CHANGELOG.md",
            "Issues": f"{repository}/issues",
        }
