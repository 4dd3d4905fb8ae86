"""The README for package indexes: a metadata hook of hatchling.

Relative links do not work on an index. They become absolute, to files at the tag of the version, if ``[project.urls]``
in ``pyproject.toml`` has a ``Repository`` on GitHub. Without it, links become their text, pictures their alternative.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# A relative target has no scheme and is not on the same page.
_RELATIVE = r"(?![a-z]+:|#)"
_HTML_PICTURE = re.compile(
    rf'(?P<before><img src=")(?P<target>{_RELATIVE}[^"]+)(?P<after>"[^>]*alt="(?P<text>[^"]*)">)'
)
_LINK = re.compile(rf"(?P<before>!?\[(?P<text>[^\]]*)\]\()(?P<target>{_RELATIVE}[^)]+)(?P<after>\))")
_COMMENT = re.compile(r"^<!--.*?-->\n", flags=re.MULTILINE)


class LongDescription(MetadataHookInterface):
    """Gives the package its long description."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field ``readme`` of the package's metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = long_description(text, metadata.get("urls", {}).get("Repository"), f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def long_description(text: str, repository: str | None, tag: str) -> str:
    """Markdown whose links work on any page.

    Parameters
    ----------
    text : str
        Markdown of a file at the top of the repository.
    repository : str or None
        URL of the repository on GitHub.
    tag : str
        Version of the linked files.
    """

    def resolved(link: re.Match[str]) -> str:
        if repository is None:
            return link["text"]
        is_picture = link["before"].startswith(("!", "<"))
        return f"{link['before']}{repository}/{'raw' if is_picture else 'blob'}/{tag}/{link['target']}{link['after']}"

    text = _COMMENT.sub("", text)
    return _LINK.sub(resolved, _HTML_PICTURE.sub(resolved, text))
