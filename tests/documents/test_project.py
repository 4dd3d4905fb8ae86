"""What is said of the project in more than one place is the same in all: versions, systems, commands, links."""

import re
import runpy

import mitsuba_subdivision
import pytest
import yaml
from documents.pages import PROJECT, ROOT, read, without_blocks

VERSION = mitsuba_subdivision.__version__
# Systems by the names that images of workflows begin with, and by those of classifiers.
SYSTEMS = {"ubuntu": "POSIX :: Linux", "macos": "MacOS", "windows": "Microsoft :: Windows"}
REPOSITORY = "https://github.com/someone/something"


def workflow():
    return yaml.safe_load(read(".github/workflows/tests.yml"))


def classified(topic):
    return {line.removeprefix(topic) for line in PROJECT["classifiers"] if line.startswith(topic)}


def requirement(package, extra=None):
    lines = PROJECT["dependencies"] if extra is None else PROJECT["optional-dependencies"][extra]
    (line,) = (line.removeprefix(package) for line in lines if line.startswith(package))
    return line


@pytest.mark.parametrize("job", ["tests", "try-packages"])
def test_a_workflow_runs_on_all_systems_and_versions_that_the_package_is_for(job):
    matrix = workflow()["jobs"][job]["strategy"]["matrix"]
    versions = [version for version in classified("Programming Language :: Python :: ") if "." in version]
    assert sorted(matrix["python"]) == sorted(versions)
    least = min(matrix["python"], key=lambda version: int(version.partition(".")[2]))
    assert PROJECT["requires-python"] == f">={least}"
    assert f"With Python {least} or newer" in read("README.md")
    assert {SYSTEMS[name.partition("-")[0]] for name in matrix["os"]} == classified("Operating System :: ")
    assert any(name.startswith("ubuntu") and name.endswith("-arm") for name in matrix["os"])


def test_packages_are_pinned_as_the_text_says():
    pinned = re.compile(r"Mitsuba ([\d.]+) and Dr\.Jit ([\d.]+), which `pyproject\.toml` pins")
    versions = pinned.search(read("plugin/ARCHITECTURE.md")).groups()
    for package, version in zip(("mitsuba", "drjit"), versions, strict=True):
        major, minor = map(int, version.split(".")[:2])
        assert requirement(package) == f">={version},<{major}.{minor + 1}"


def test_the_changelog_and_the_citation_have_the_version_and_its_day():
    (day,) = re.findall(rf"^## {re.escape(VERSION)} - (\d{{4}}-\d\d-\d\d)$", read("CHANGELOG.md"), flags=re.MULTILINE)
    citation = yaml.safe_load(read("CITATION.cff"))
    assert (str(citation["version"]), str(citation["date-released"])) == (VERSION, day)
    assert citation.get("repository-code") == PROJECT["urls"].get("Repository")


def long_description(*words):
    """By the module that hatchling loads by its path."""
    pytest.importorskip("hatchling")
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
def test_the_metadata_of_the_package_is_as_it_is_stated():
    pytest.importorskip("hatchling")
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    metadata = ProjectMetadata(str(ROOT), PluginManager())
    metadata.validate_fields()
    repository = PROJECT["urls"].get("Repository")
    assert metadata.version == VERSION
    assert metadata.core.readme == long_description(read("README.md"), repository, f"v{VERSION}")
    assert all(url.startswith("https://") for url in metadata.core.urls.values())
