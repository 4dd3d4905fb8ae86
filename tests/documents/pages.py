"""The project's pages and parsers of their contents."""

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # A package that pytest needs there.

ROOT = Path(__file__).resolve().parents[2]
PLUGIN, GUIDE = ROOT / "plugin", ROOT / "plugin" / "guide"
ARCHITECTURE, MATHEMATICS = PLUGIN / "ARCHITECTURE.md", PLUGIN / "MATHEMATICS.md"
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIGURATION["project"]


def read(path):
    return (ROOT / path).read_text(encoding="utf-8")


def without_blocks(text):
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)


def quoted(text):
    return re.findall(r"`([^`\n]+)`", text)


def rows_below(page, mark):
    """Cells of the table that follows a comment."""
    below = read(page).split(f"<!-- {mark} -->\n")[1].split("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in below.splitlines()[2:]]
