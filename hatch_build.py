"""Put the address of the repository, which stands in pyproject.toml, into what needs it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


def urls(repository: str) -> dict[str, str]:
    """Return the addresses that are shown beside the package; none without a repository."""
    if not repository:
        return {}
    return {
        "Source": repository,
        "Issues": f"{repository}/issues",
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
    }


def readme(text: str, repository: str) -> str:
    """Return the README with pictures and links as a page elsewhere needs them.

    Without a repository pictures are left out, and links become their words.
    """

    def target(found: re.Match[str]) -> str:
        picture, words, link = found.groups()
        if "://" in link or link.startswith("#"):
            return found[0]
        if not repository:
            return "" if picture else words
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/main/{link})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", target, text)


class CustomMetadataHook(MetadataHookInterface):
    """Fill in `readme` and `urls`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Change the metadata in place."""
        root = Path(self.root)
        repository = self.config.get("repository", "")
        text = (root / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": readme(text, repository),
        }
        if found := urls(repository):
            metadata["urls"] = found
