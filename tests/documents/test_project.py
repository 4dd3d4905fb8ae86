"""What is said of the project in more than one place is the same in all: versions, systems, commands, links."""

import re
import runpy
import shutil
import subprocess

import mitsuba_subdivision
import pytest
import yaml
from documents.pages import PROJECT, ROOT, read, without_blocks

VERSION = mitsuba_subdivision.__version__
# Systems by the names that images of workflows begin with, and by those of classifiers.
SYSTEMS = {"ubuntu": "POSIX :: Linux", "macos": "MacOS", "windows": "Microsoft :: Windows"}
REPOSITORY = "https://github.com/someone/something"


def workflow(name="tests"):
    return yaml.safe_load(read(f".github/workflows/{name}.yml"))


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


def test_the_steps_of_a_workflow_are_commands_of_the_repository():
    steps = [step for job in workflow()["jobs"].values() for step in job["steps"]]
    assert [step for step in steps if ("run" in step) == ("uses" in step)] == []
    commands = [step["run"] for step in steps if "run" in step]
    modes = {re.search(r"\.ci/run (\w+)", command)[1] for command in commands if ".ci/run" in command}
    assert modes == {"peers", "tests", "style"}
    release = read("plugin/CONTRIBUTING.md").partition("## Release")[2]
    for command in commands:
        if command.startswith("python "):
            assert f"   {command}\n" in release


def test_a_release_uploads_what_was_tried_once_a_maintainer_allows_it():
    # YAML 1.1 reads the word "on" as true.
    assert workflow("release")[True] == {"push": {"tags": ["v*"]}}
    assert "workflow_call" in workflow()[True]
    jobs = workflow("release")["jobs"]
    assert jobs["tests"] == {"uses": "./.github/workflows/tests.yml"}
    publish = jobs["publish"]
    assert (publish["needs"], publish["if"]) == ("tests", "vars.PUBLISH == 'true'")
    assert publish["permissions"] == {"id-token": "write"}
    taken, _ = publish["steps"]
    made = [step for step in workflow()["jobs"]["packages"]["steps"] if "upload-artifact" in step.get("uses", "")]
    assert [step["with"] for step in made] == [{**taken["with"], "path": "dist/", "if-no-files-found": "error"}]


def test_the_newest_mitsuba_is_tested_as_the_readme_says():
    commands = [step.get("run", "") for step in workflow("nightly")["jobs"]["newest"]["steps"]]
    assert any("pip install --upgrade --pre mitsuba drjit" in command for command in commands)
    options = re.search(r"-m pytest (.*)", read("README.md"))[1]
    assert any(f"python -m pytest {options} " in command for command in commands)


def test_packages_are_pinned_as_the_text_says():
    pinned = re.compile(r"Mitsuba ([\d.]+) and Dr\.Jit ([\d.]+), which `pyproject\.toml` pins")
    versions = pinned.search(read("plugin/ARCHITECTURE.md")).groups()
    for package, version in zip(("mitsuba", "drjit"), versions, strict=True):
        major, minor = map(int, version.split(".")[:2])
        assert requirement(package) == f">={version},<{major}.{minor + 1}"


def test_the_changelog_and_the_citation_have_the_version_and_its_day_and_the_usual_headings():
    (day,) = re.findall(rf"^## {re.escape(VERSION)} - (\d{{4}}-\d\d-\d\d)$", read("CHANGELOG.md"), flags=re.MULTILINE)
    citation = yaml.safe_load(read("CITATION.cff"))
    assert (str(citation["version"]), str(citation["date-released"])) == (VERSION, day)
    assert citation.get("repository-code") == PROJECT["urls"].get("Repository")
    heading = re.compile(r"^#+ .+$", flags=re.MULTILINE)
    for version in read("CHANGELOG.md").split("\n## ")[1:]:
        kinds = [line.removeprefix("### ") for line in heading.findall(version)]
        assert kinds == [kind for kind in ("Added", "Changed", "Fixed") if kind in kinds] != []


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


@pytest.fixture
def commands(tmp_path):
    """Function that writes programs of the shell; those that `.ci/run` needs of the system are there already."""
    for name in ("bash", "dirname", "env", "mktemp", "rm", "tail"):
        (tmp_path / name).symlink_to(shutil.which(name))

    def write(**programs):
        for name, text in programs.items():
            path = tmp_path / name.replace("_", "-")
            path.write_text(f"#!{tmp_path}/bash\n{text}\n")
            path.chmod(0o755)
        script = [str(tmp_path / "bash"), str(ROOT / ".ci" / "run"), "peers"]
        return subprocess.run(script, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)

    return write


@pytest.mark.posix
def test_the_checks_say_which_programs_are_missing_and_install_them_only_where_they_may(commands, tmp_path):
    assert "this system has no Debian packages" in commands(id="echo 0").stderr
    done = commands(dpkg="exit 1", id="echo 1000", apt_get="echo installed >&2")
    assert "missing: g++ libosd-dev libembree-dev chromium." in done.stderr
    assert "installed" not in done.stderr
    programs = {"dpkg": "case $2 in libosd-dev) exit 1 ;; esac", "apt_get": "echo no network >&2; exit 100"}
    done = commands(id="echo 0", chromium="exit 0", **programs)
    assert done.returncode == 0
    assert "no network" in done.stderr
    assert "missing: libosd-dev. Tests against OpenSubdiv and Embree" in done.stderr
    assert "missing: blender." in done.stderr
    (tmp_path / "chromium").unlink()
    assert commands(dpkg="exit 0", id="echo 0", blender="exit 0", google_chrome="exit 0").stderr == ""


def test_checks_before_a_commit_are_those_of_the_script():
    ruff, local = yaml.safe_load(read(".pre-commit-config.yaml"))["repos"]
    tools = {"ruff check", "ruff format", "mypy"}
    assert {hook["name"] for hook in [*ruff["hooks"], *local["hooks"]]} == tools
    assert requirement("ruff", "dev") == f"=={ruff['rev'].removeprefix('v')}"
    assert [tool for tool in sorted(tools) if f".venv/bin/{tool}" not in read(".ci/run")] == []


def test_the_documentation_is_built_elsewhere_as_here():
    settings = yaml.safe_load(read(".readthedocs.yaml"))
    assert (ROOT / settings["sphinx"]["configuration"]).is_file()
    assert settings["sphinx"]["fail_on_warning"]
    (install,) = settings["python"]["install"]
    assert set(install["extra_requirements"]) <= set(PROJECT["optional-dependencies"])
