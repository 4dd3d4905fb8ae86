"""Imports between packages go one way (plugin/ARCHITECTURE.md)."""

import ast
import importlib
from functools import cache
from pathlib import Path

import mitsuba_subdivision
import mitsuba_usd
import pytest

PACKAGE = "mitsuba_subdivision"
ROOT = Path(mitsuba_subdivision.__file__).parent
WHOLE_FILES = Path(mitsuba_usd.__file__).parent
# Packages, and modules beside them, and what each may import of this project. Later ones build on earlier ones.
NUMPY_PACKAGES = [
    "deferred",
    "whole_file",
    "progress",
    "variants",
    "device_arrays",
    "mesh",
    "schemes",
    "evaluation",
    "cage",
    "refinement",
    "files",
    "patches",
    "tessellation",
    "surface",
]
ALLOWED = {
    "llvm": set(),
    "messages": {"progress"},
    "examples": set(),
    **{package: set(NUMPY_PACKAGES[:i]) for i, package in enumerate(NUMPY_PACKAGES)},
    "whole_file": set(),
    "variants": {"llvm"},
    "device_arrays": {"llvm"},
    "mesh": set(),
    "schemes": {"deferred", "mesh"},
    "evaluation": {"mesh", "schemes"},
    "cage": {"variants", "device_arrays", "mesh", "schemes"},
    "refinement": {"mesh", "schemes", "cage"},
    "files": {"deferred", "whole_file", "mesh", "cage"},
    "inspection": {"mesh", "schemes", "cage", "surface"},
    "kernels": {"llvm", "deferred", "device_arrays", "mesh", "schemes", "evaluation", "patches", "tessellation"},
    "shapes": {"llvm", *NUMPY_PACKAGES, "kernels"},
    "fit": {*NUMPY_PACKAGES, "kernels", "shapes"},
    "srgb": set(),
    "mitsuba_mesh": {"device_arrays"},
    "regression": {"llvm", "messages", "whole_file", "srgb", "progress", "variants", "__init__"},
    "figures": {
        "examples",
        "mitsuba_mesh",
        "srgb",
        *NUMPY_PACKAGES,
        "kernels",
        "shapes",
        "fit",
        "regression",
        "__init__",
    },
    "studio": {"messages", *NUMPY_PACKAGES, "mitsuba_mesh", "shapes", "regression"},
    "doctor": {"llvm", "cage", "__init__"},
    "commands": {
        "llvm",
        "messages",
        *NUMPY_PACKAGES,
        "inspection",
        "shapes",
        "regression",
        "studio",
        "figures",
        "doctor",
        "__init__",
    },
    "__main__": {"messages", "whole_file", "progress", "cage", "commands", "__init__"},
    "__init__": {"llvm", "examples", *NUMPY_PACKAGES, "kernels", "shapes", "fit", "studio"},
}
# Imports that go up, each a public method that only calls a function above: the module, and what it may import there.
UP = {
    ("cage/control_cage.py", "files.formats"),
    ("cage/control_cage.py", "refinement.cage_refinement"),
    ("surface/limit_surface.py", "kernels"),
}
# Modules that import by names which are no constants: of modules of their own package, or of a user.
BY_NAME = {"deferred.py", "schemes/scheme_table.py", "files/formats.py"}
BY_NAME |= {"figures/figure_table.py"}
# Packages that may import a library that the numpy packages do without.
MAY_IMPORT = {
    "mitsuba": {"variants", "mitsuba_mesh", "shapes", "fit", "regression", "figures", "studio", "doctor", "commands"},
    "drjit": {
        "llvm",
        "variants",
        "device_arrays",
        "kernels",
        "shapes",
        "fit",
        "regression",
        "figures",
        "doctor",
        "commands",
    },
    "matplotlib": {"regression", "figures"},
    "plyfile": {"files"},
    "pxr": {"files"},
    "MaterialX": set(),
    "mitsuba_oidn": {"studio"},
    "PIL": set(),
    "mitsuba_usd": {"commands", "__init__"},
}


def imported_names(tree, package):
    """Dotted names of all imports of a module that lies in ``package``, wherever in the module they are.

    None stands for an import by a name that is no constant.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = absolute("." * node.level + (node.module or ""), package)
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called in ("import_module", "__import__"):
                name = node.args[0]
                yield absolute(name.value, package) if isinstance(name, ast.Constant) else None
            elif called == "deferred":
                # Its table has names of modules within the package.
                places = [each for each in ast.walk(tree) if isinstance(each, ast.Dict)]
                names = {each.value for table in places for each in table.values if isinstance(each, ast.Constant)}
                yield from (absolute(f".{name}", package) for name in names if isinstance(name, str))


@cache
def imports_of(path, root):
    """The imported names of a file, each once."""
    package = [WHOLE_FILES.name if root == WHOLE_FILES else PACKAGE, *path.relative_to(root).parts[:-1]]
    return set(imported_names(ast.parse(path.read_text(encoding="utf-8")), package))


def absolute(name, package):
    """A name without the dots at its beginning, each of which stands for a package."""
    level = len(name) - len(name.lstrip("."))
    above = package[: len(package) + 1 - level] if level else []
    return ".".join([*above, *([name[level:]] if name[level:] else [])])


def package_named(name, packages):
    """Package of this project that a dotted name begins with; ``__init__`` for public names."""
    _, *path = name.split(".")
    return path[0] if path and path[0] in packages else "__init__"


def goes_up(relative, name):
    """Whether an import is one of `UP`."""
    names = [target for module, target in UP if module == relative.as_posix()]
    return any(f"{name}.".startswith(f"{PACKAGE}.{target}.") for target in names)


def violations(root):
    """One line for each import against the direction."""
    found = []
    packages = {path.stem if path.is_file() else path.name for path in root.iterdir() if is_package(path)}
    found += [f"{package}: not in the order of packages" for package in sorted(packages - set(ALLOWED))]
    for path in sorted(root.rglob("*.py")):
        relative = path.relative_to(root)
        package = relative.parts[0].removesuffix(".py")
        for name in imports_of(path, root):
            if name is None:
                if relative.as_posix() not in BY_NAME:
                    found.append(f"{relative}: imports by a name that is no constant")
                continue
            top = name.split(".")[0]
            target = package_named(name, packages) if top == PACKAGE else None
            if target not in {None, package, *ALLOWED.get(package, ())} and not goes_up(relative, name):
                found.append(f"{relative}: {name} ({package} may not import {target})")
            if package not in MAY_IMPORT.get(top, {package}):
                found.append(f"{relative}: {name} ({package} may not import {top})")
    return found


def names_within(root):
    """What the package of whole USD files imports of this one that is not public: in ``__all__`` of a package."""
    found = []
    for path in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [(alias.name, None) for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [(node.module, alias.name) for alias in node.names]
            else:
                continue
            found += [f"{path.name}: {module} {name}" for module, name in names if not is_public(module, name)]
    return found


def is_public(module, name):
    """Whether a name is one of another library, of a module beside the packages, or in ``__all__`` of a package."""
    if module.split(".")[0] != PACKAGE:
        return True
    place = ROOT.joinpath(*module.split(".")[1:])
    if place.is_dir():
        return name in importlib.import_module(module).__all__
    return place.parent == ROOT and not name.startswith("_")


def module_graph(root):
    """The modules of ours that each module imports, wherever in it, but for what packages offer and for `UP`."""
    package = WHOLE_FILES.name if root == WHOLE_FILES else PACKAGE
    modules = {".".join([package, *path.relative_to(root).with_suffix("").parts]): path for path in root.rglob("*.py")}
    graph = {}
    for module, path in modules.items():
        relative = path.relative_to(root)
        names = imports_of(path, root)
        candidates = {each for name in names if name and not goes_up(relative, name) for each in (name, parent(name))}
        graph[module] = {each for each in candidates if each in modules and each != module}
    return graph


def parent(name):
    return name.rpartition(".")[0]


def circles(graph):
    """Modules that lead back to themselves, in order of their names."""
    after = {module: set(targets) for module, targets in graph.items()}
    while any(ends := [module for module, targets in after.items() if not targets]):
        for module in ends:
            del after[module]
        after = {module: targets & set(after) for module, targets in after.items()}
    # What is left leads to a circle. What nothing left leads to is in none.
    while starts := set(after) - set().union(*after.values()):
        after = {module: targets for module, targets in after.items() if module not in starts}
    return sorted(after)


def is_package(path):
    if path.name == "scenes":
        return False  # Data, with scripts for Blender, which an installed package has beside its modules.
    return path.suffix == ".py" or (path.is_dir() and any(path.glob("*.py")))


def test_imports_go_one_way():
    assert violations(ROOT) == []


def test_nothing_else_goes_up():
    used = {
        (relative, target)
        for relative, target in UP
        for name in imports_of(ROOT / relative, ROOT)
        if name and f"{name}.".startswith(f"{PACKAGE}.{target}.")
    }
    assert used == UP


def test_modules_do_not_import_in_circles():
    known = f"{PACKAGE}.shapes."  # Protocols of `vertices`, for type checking.
    assert [module for module in circles(module_graph(ROOT)) if not module.startswith(known)] == []
    assert circles(module_graph(WHOLE_FILES)) == []


def test_whole_usd_files_are_built_on_public_names():
    assert names_within(WHOLE_FILES) == []


@pytest.mark.parametrize(
    "text",
    [
        "from mitsuba_subdivision.files.usd_stage import open_stage",
        "from mitsuba_subdivision.studio import picture",
        "from mitsuba_subdivision.progress import _bar",
        "import mitsuba_subdivision.cage",
    ],
)
def test_a_name_that_is_not_public_is_found(tmp_path, text):
    (tmp_path / "a.py").write_text(text + "\n")
    assert len(names_within(tmp_path)) == 1


def test_no_module_looks_up_limits_of_numbers_while_dr_jit_renders():
    """NumPy before 2.3 warns of subnormals where it looks them up in arithmetic without any, which Dr.Jit sets."""
    paths = [*ROOT.rglob("*.py"), *WHOLE_FILES.rglob("*.py")]
    assert not [path for path in paths if "finfo(" in path.read_text(encoding="utf-8")]


def test_a_circle_of_modules_is_found(tmp_path):
    package_with(tmp_path, "mesh/a.py", "if TYPE_CHECKING:\n    from .b import B\nfrom .c import C")
    (tmp_path / "mesh" / "b.py").write_text("def f():\n    from . import a\n")
    (tmp_path / "mesh" / "c.py").write_text("import numpy\n")
    (tmp_path / "mesh" / "d.py").write_text("from .a import A\n")
    assert circles(module_graph(tmp_path)) == [f"{PACKAGE}.mesh.a", f"{PACKAGE}.mesh.b"]


def test_every_package_of_the_table_exists():
    assert {path.stem for path in ROOT.iterdir() if is_package(path)} == set(ALLOWED)


VIOLATIONS = {
    "absolute": ("cage/a.py", "import mitsuba_subdivision.surface"),
    "absolute from": ("cage/a.py", "from mitsuba_subdivision.patches import PatchTable"),
    "relative": ("schemes/a.py", "from ..evaluation.element import element_stencils"),
    "relative package": ("schemes/a.py", "from .. import evaluation"),
    "of the package itself": ("cage/a.py", "from .. import LimitSurface"),
    "in a function": ("tessellation/a.py", "def f():\n    from ..kernels import VertexKernel"),
    "for type checking": ("patches/a.py", "if TYPE_CHECKING:\n    from ..surface import LimitSurface"),
    "module beside the packages": ("inspection.py", "from .shapes import registration"),
    "kernels of the surface": ("kernels/a.py", "from ..surface import LimitSurface"),
    "llvm of ours": ("llvm.py", "from .cage import ControlCage"),
    "nested": ("cage/deep/a.py", "from ...surface import LimitSurface"),
    "cage in regression": ("regression/a.py", "from ..cage import ControlCage"),
    "mitsuba in a numpy package": ("surface/a.py", "def f():\n    import mitsuba as mi"),
    "mitsuba in kernels": ("kernels/a.py", "from mitsuba import llvm_ad_rgb"),
    "mitsuba by name": ("cage/a.py", "import importlib\nmi = importlib.import_module('mitsuba')"),
    "drjit in a numpy package": ("tessellation/a.py", "import drjit as dr"),
    "ours by name": ("cage/a.py", "import importlib\nimportlib.import_module('..files', __package__)"),
    "by no constant": ("cage/a.py", "import importlib\nimportlib.import_module(NAME, __package__)"),
    "by a table": (
        "__init__.py",
        "from .deferred import deferred\n__getattr__ = deferred(__name__, {'f': 'figures.f'})",
    ),
    "up in another module": ("cage/a.py", "def f():\n    from ..files.formats import read_file"),
    "unknown package": ("helpers/a.py", "import numpy"),
}
KEPT = {
    "mitsuba in shapes": ("shapes/a.py", "def f():\n    import mitsuba as mi"),
    "down": ("evaluation/a.py", "from ..mesh.one_ring import one_ring\nfrom . import element"),
    "type checking down": ("kernels/a.py", "if TYPE_CHECKING:\n    from ..tessellation import VertexTable"),
    "a method of cages": ("cage/control_cage.py", "def f():\n    from ..files.formats import read_file"),
    "command line": ("__main__.py", "import mitsuba_subdivision as msub\nfrom . import __version__"),
    "a package of similar name": ("cage/a.py", "import mitsuba_subdivision_extras, mitsubas"),
}


# Those of `ALLOWED` that are one file, not a folder.
MODULES = {path.stem for path in ROOT.glob("*.py")}


def package_with(tmp_path, place, text):
    for package in ALLOWED:
        if package in MODULES:
            (tmp_path / f"{package}.py").touch()
        else:
            (tmp_path / package).mkdir()
            (tmp_path / package / "__init__.py").touch()
    path = tmp_path / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")
    return tmp_path


@pytest.mark.parametrize(("place", "text"), VIOLATIONS.values(), ids=VIOLATIONS)
def test_import_the_other_way_is_found(tmp_path, place, text):
    assert len(violations(package_with(tmp_path, place, text))) == 1


@pytest.mark.parametrize(("place", "text"), KEPT.values(), ids=KEPT)
def test_import_in_the_direction_is_not_reported(tmp_path, place, text):
    assert violations(package_with(tmp_path, place, text)) == []
