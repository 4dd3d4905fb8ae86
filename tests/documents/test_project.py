"""The package on indexes: links of its long description, and its metadata."""

import re
import runpy

import mitsuba_subdivision
import pytest
from documents.pages import PROJECT, ROOT, read, without_blocks

pytest.importorskip("hatchling")

REPOSITORY = "https://github.com/someone/something"


def long_description(*words):
    """By the module that hatchling loads by its path."""
    return runpy.run_path(str(ROOT / "plugin" / "long_description.py"))["long_description"](*words)


def targets(text):
    return list(map("".join, re.findall(r'\]\(([^)]+)\)|src="([^"]+)"', without_blocks(text))))


@pytest.mark.parametrize("repository", [None, REPOSITORY])
def test_links_of_the_long_description_work_on_a_package_index(repository):
    readme = read("README.md")
    text = long_description(readme, repository, "v1.2.3")
    links = targets(text)
    assert links
    assert [target for target in links if not target.startswith("https://")] == []
    paths = set(re.findall(rf"^{REPOSITORY}/(?:blob|raw)/v1\.2\.3/([^#\n]+)", "\n".join(links), flags=re.MULTILINE))
    relative = {target.partition("#")[0] for target in targets(readme) if not target.startswith("https:")}
    assert paths == (relative if repository else set())
    # All else is as it was.
    assert re.findall(r"```.*?```", text, flags=re.DOTALL) == re.findall(r"```.*?```", readme, flags=re.DOTALL)
    assert "<!--" not in text
    picture = f'<img src="{REPOSITORY}/raw/v1.2.3/renders/figures/hero.png" width='
    assert (picture if repository else "\nThe control cage of a human figure, and its limit surface\n") in text


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_metadata_of_the_package_is_valid_and_has_the_long_description():
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    version, metadata = mitsuba_subdivision.__version__, ProjectMetadata(str(ROOT), PluginManager())
    metadata.validate_fields()
    assert metadata.version == version
    repository = PROJECT["urls"].get("Repository")
    assert metadata.core.readme == long_description(read("README.md"), repository, f"v{version}")
