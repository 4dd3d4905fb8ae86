"""Imports between packages go one way, as the tables of plugin/ARCHITECTURE.md say."""

import re
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

import grimp
import mitsuba_subdivision
import mitsuba_usd
import pytest
from documents.pages import ARCHITECTURE, read, rows_below

PACKAGE = "mitsuba_subdivision"
ROOT, WHOLE_FILES = (Path(package.__file__).parent for package in (mitsuba_subdivision, mitsuba_usd))
# Modules that import by names which are no constants: of modules of their own package, or of a user.
BY_NAME = {"__init__.py", "commands/__init__.py", "files/formats.py", "figures/__init__.py"}
# Packages that may import a library that the numpy packages do without.
MAY_IMPORT = {
    "mitsuba": {"variants", "mitsuba_mesh", "shapes", "fit", "regression", "figures", "studio", "doctor", "commands"},
    "drjit": {"llvm", "variants", "device_arrays", "kernels", "shapes", "fit", "regression", "figures"},
    "matplotlib": {"regression", "figures"},
    "plyfile": {"files"},
    "pxr": {"files"},
    "MaterialX": set(),
    "mitsuba_oidn": {"studio"},
    "PIL": set(),
    "mitsuba_usd": {"commands", "__init__"},
}


def words_in(text):
    return re.findall(r"`([\w./]+)`", text)


def allowed_imports():
    """What each package, or module beside the packages, may import of this project."""
    text = " ".join(read(ARCHITECTURE).split())
    numpy_packages = words_in(text.partition('"numpy packages" are, in this order, ')[2].partition(";")[0])
    allowed = {}
    for cell, _, stated in rows_below(ARCHITECTURE, "packages"):
        (package,) = words_in(cell)
        above = numpy_packages[: numpy_packages.index(package)] if "above" in stated else numpy_packages
        allowed[package] = {*words_in(stated), *(above if "numpy packages" in stated else ())}
    return allowed


ALLOWED = allowed_imports()
# Imports that go up, in a public method that only calls a function above: the module, and what it may import there.
UP = {
    (f"{PACKAGE}.{words_in(module)[0][:-3].replace('/', '.')}", f"{PACKAGE}.{words_in(target)[0]}")
    for module, target, _ in rows_below(ARCHITECTURE, "imports that go up")
}


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph(
        PACKAGE, WHOLE_FILES.name, include_external_packages=True, exclude_type_checking_imports=True, cache_dir=None
    )


def package_of(module):
    """Package of this project, or module beside the packages; ``__init__`` for public names."""
    return [*module.split("."), "__init__"][1]


def goes_up(module, imported):
    return any(module == source and f"{imported}.".startswith(f"{target}.") for source, target in UP)


def imports_of(graph, root):
    modules = [module for module in graph.modules if module.split(".")[0] == root]
    return [(module, imported) for module in modules for imported in graph.find_modules_directly_imported_by(module)]


def test_imports_go_one_way_except_the_listed_ones(graph):
    assert {package_of(module) for module in graph.modules if module.split(".")[0] == PACKAGE} == set(ALLOWED)
    wrong, used = [], set()
    for module, imported in imports_of(graph, PACKAGE):
        package, library = package_of(module), imported.split(".")[0]
        if library != PACKAGE:
            wrong += [(module, imported)] if package not in MAY_IMPORT.get(library, {package}) else []
        elif goes_up(module, imported):
            used |= {(source, target) for source, target in UP if source == module and imported.startswith(target)}
        elif package_of(imported) not in {package, *ALLOWED[package]}:
            wrong.append((module, imported))
    assert wrong == []
    assert used == UP


def test_names_that_are_imported_are_constants():
    modules = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")}
    assert {
        name for name, text in modules.items() if re.search(r"(import_module|__import__|resolve_name)\((?!\")", text)
    } == BY_NAME


@pytest.mark.parametrize("root", [PACKAGE, WHOLE_FILES.name])
def test_modules_do_not_import_in_circles(graph, root):
    """Packages offer names of their modules, and are left out."""
    modules = {module for module in graph.modules if module.split(".")[0] == root and not graph.find_children(module)}
    before = {module: set() for module in modules}
    for module, imported in imports_of(graph, root):
        if {module, imported} <= modules and not goes_up(module, imported):
            before[module].add(imported)
    # It raises an error that names the modules of a circle.
    TopologicalSorter(before).prepare()


def test_whole_usd_files_are_built_on_public_names(graph):
    """Packages, modules beside them and those that a package lists are public, but for names with an underscore."""
    imported = {name for _, name in imports_of(graph, WHOLE_FILES.name) if name.startswith(f"{PACKAGE}.")}
    within = (name.rpartition(".") for name in imported if name.count(".") > 1)
    assert [name for package, _, name in within if name not in import_module(package).__all__] == []
    private = re.compile(rf"from {PACKAGE}[\w.]* import (\([^)]*|.*)\b_[a-z]")
    assert [path for path in WHOLE_FILES.rglob("*.py") if private.search(path.read_text(encoding="utf-8"))] == []


def test_no_module_looks_up_limits_of_numbers_while_dr_jit_renders():
    """NumPy before 2.3 warns of subnormals where it looks them up in arithmetic without any, which Dr.Jit sets."""
    paths = [*ROOT.rglob("*.py"), *WHOLE_FILES.rglob("*.py")]
    assert not [path for path in paths if "finfo(" in path.read_text(encoding="utf-8")]
