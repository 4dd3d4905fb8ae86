"""Imports go one way, from room to room (plugin/ARCHITECTURE.md)."""

import ast
from pathlib import Path

import mitsuba_subdivision
import pytest

PACKAGE = "mitsuba_subdivision"
ROOT = Path(mitsuba_subdivision.__file__).parent
# Every room, or module beside the rooms, and what of ours it may import. Later ones build on earlier ones.
NUMPY_ROOMS = [
    "deferred",
    "whole_file",
    "progress",
    "variants",
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
    "messages": set(),
    "interruption": set(),
    "examples": set(),
    **{room: set(NUMPY_ROOMS[:i]) for i, room in enumerate(NUMPY_ROOMS)},
    "whole_file": set(),
    "variants": set(),
    "mesh": set(),
    "schemes": {"deferred", "mesh"},
    "evaluation": {"mesh", "schemes"},
    "cage": {"variants", "mesh", "schemes"},
    "refinement": {"mesh", "schemes", "cage"},
    "files": {"whole_file", "mesh", "cage"},
    "inspection": {"mesh", "schemes", "cage", "surface"},
    "kernels": {"deferred", "mesh", "schemes", "evaluation", "patches", "tessellation"},
    "shapes": {"llvm", *NUMPY_ROOMS, "kernels"},
    "fit": {*NUMPY_ROOMS, "kernels", "shapes"},
    "images": {"whole_file"},
    "mitsuba_mesh": set(),
    "regression": {"llvm", "messages", "whole_file", "progress", "variants", "images", "__init__"},
    "figures": {
        "examples",
        "mitsuba_mesh",
        *NUMPY_ROOMS,
        "kernels",
        "shapes",
        "fit",
        "images",
        "regression",
        "__init__",
    },
    "studio": {"messages", *NUMPY_ROOMS, "mitsuba_mesh", "shapes", "regression"},
    "usd": {
        "progress",
        "variants",
        "mesh",
        "schemes",
        "cage",
        "files",
        "tessellation",
        "surface",
        "regression",
        "studio",
    },
    "doctor": {"llvm", "cage", "__init__"},
    "commands": {
        "llvm",
        "messages",
        *NUMPY_ROOMS,
        "inspection",
        "shapes",
        "images",
        "regression",
        "studio",
        "usd",
        "figures",
        "doctor",
        "__init__",
    },
    "__main__": {"messages", "interruption", "whole_file", "progress", "cage", "commands", "__init__"},
    "__init__": {"llvm", "examples", *NUMPY_ROOMS, "kernels", "shapes", "fit", "studio", "usd"},
}
# Imports that go up, each a public method that only calls a function above: the module, and what it may import there.
UP = {
    ("cage/control_cage.py", "files.formats"),
    ("cage/control_cage.py", "refinement.cage_refinement"),
    ("surface/limit_surface.py", "kernels"),
}
# Modules that import by names which are no constants: of modules of their own package, or of a user.
BY_NAME = {"deferred.py", "schemes/__init__.py", "files/formats.py", "files/usd_process.py", "images/tiers.py"}
BY_NAME |= {"figures/__init__.py"}
# Who may import a package that the numpy rooms do without.
MAY_IMPORT = {
    "mitsuba": {
        "variants",
        "mitsuba_mesh",
        "shapes",
        "fit",
        "regression",
        "figures",
        "studio",
        "usd",
        "doctor",
        "commands",
    },
    "drjit": {"llvm", "kernels", "shapes", "fit", "regression", "figures", "doctor", "commands"},
    "matplotlib": {"figures"},
    "plyfile": {"files"},
    "pxr": {"files", "usd"},
    "MaterialX": {"usd"},
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


def absolute(name, package):
    """A name without the dots at its beginning, each of which stands for a package."""
    level = len(name) - len(name.lstrip("."))
    above = package[: len(package) + 1 - level] if level else []
    return ".".join([*above, *([name[level:]] if name[level:] else [])])


def room_of(name, rooms):
    """Room that a dotted name of ours leads to; ``__init__`` for what the package itself offers."""
    _, *path = name.split(".")
    return path[0] if path and path[0] in rooms else "__init__"


def goes_up(relative, name):
    """Whether an import is one of `UP`."""
    names = [target for module, target in UP if module == relative.as_posix()]
    return any(f"{name}.".startswith(f"{PACKAGE}.{target}.") for target in names)


def violations(root):
    """One line for each import against the direction."""
    found = []
    rooms = {path.stem if path.is_file() else path.name for path in root.iterdir() if is_room(path)}
    found += [f"{room}: not in the order of rooms" for room in sorted(rooms - set(ALLOWED))]
    for path in sorted(root.rglob("*.py")):
        relative = path.relative_to(root)
        room = relative.parts[0].removesuffix(".py")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name in imported_names(tree, [PACKAGE, *relative.parts[:-1]]):
            if name is None:
                if relative.as_posix() not in BY_NAME:
                    found.append(f"{relative}: imports by a name that is no constant")
                continue
            top = name.split(".")[0]
            target = room_of(name, rooms) if top == PACKAGE else None
            if target not in {None, room, *ALLOWED.get(room, ())} and not goes_up(relative, name):
                found.append(f"{relative}: {name} ({room} may not import {target})")
            if room not in MAY_IMPORT.get(top, {room}):
                found.append(f"{relative}: {name} ({room} may not import {top})")
    return found


def module_graph(root):
    """The modules of ours that each module imports, wherever in it, but for what packages offer and for `UP`."""
    modules = {".".join([PACKAGE, *path.relative_to(root).with_suffix("").parts]): path for path in root.rglob("*.py")}
    graph = {}
    for module, path in modules.items():
        relative = path.relative_to(root)
        names = imported_names(ast.parse(path.read_text(encoding="utf-8")), [PACKAGE, *relative.parts[:-1]])
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


def is_room(path):
    if path.name == "scenes":
        return False  # Data, with scripts for Blender, which an installed package has beside its rooms.
    return path.suffix == ".py" or (path.is_dir() and any(path.glob("*.py")))


def test_imports_go_one_way():
    assert violations(ROOT) == []


def test_nothing_else_goes_up():
    used = {
        (relative, target)
        for relative, target in UP
        for name in imported_names(ast.parse((ROOT / relative).read_text(encoding="utf-8")), package_of(relative))
        if name and f"{name}.".startswith(f"{PACKAGE}.{target}.")
    }
    assert used == UP


def package_of(relative):
    return [PACKAGE, *Path(relative).parts[:-1]]


def test_modules_do_not_import_in_circles():
    known = (f"{PACKAGE}.shapes.", f"{PACKAGE}.commands.")  # They still have circles.
    assert [module for module in circles(module_graph(ROOT)) if not module.startswith(known)] == []


def test_a_circle_of_modules_is_found(tmp_path):
    package_with(tmp_path, "mesh/a.py", "if TYPE_CHECKING:\n    from .b import B\nfrom .c import C")
    (tmp_path / "mesh" / "b.py").write_text("def f():\n    from . import a\n")
    (tmp_path / "mesh" / "c.py").write_text("import numpy\n")
    (tmp_path / "mesh" / "d.py").write_text("from .a import A\n")
    assert circles(module_graph(tmp_path)) == [f"{PACKAGE}.mesh.a", f"{PACKAGE}.mesh.b"]


def test_every_room_of_the_design_exists():
    assert {path.stem for path in ROOT.iterdir() if is_room(path)} == set(ALLOWED)


VIOLATIONS = {
    "absolute": ("cage/a.py", "import mitsuba_subdivision.surface"),
    "absolute from": ("cage/a.py", "from mitsuba_subdivision.patches import PatchTable"),
    "relative": ("schemes/a.py", "from ..evaluation.element import element_stencils"),
    "relative room": ("schemes/a.py", "from .. import evaluation"),
    "of the package itself": ("cage/a.py", "from .. import LimitSurface"),
    "in a function": ("tessellation/a.py", "def f():\n    from ..kernels import WeightKernel"),
    "for type checking": ("patches/a.py", "if TYPE_CHECKING:\n    from ..surface import LimitSurface"),
    "module beside the rooms": ("inspection.py", "from .shapes import registration"),
    "images of ours": ("images/a.py", "from ..cage import ControlCage"),
    "kernels of the surface": ("kernels/a.py", "from ..surface import LimitSurface"),
    "llvm of ours": ("llvm.py", "from .cage import ControlCage"),
    "nested": ("cage/deep/a.py", "from ...surface import LimitSurface"),
    "mitsuba in images": ("images/a.py", "def f():\n    import mitsuba as mi"),
    "cage in regression": ("regression/a.py", "from ..cage import ControlCage"),
    "mitsuba in a numpy room": ("surface/a.py", "def f():\n    import mitsuba as mi"),
    "mitsuba in kernels": ("kernels/a.py", "from mitsuba import llvm_ad_rgb"),
    "mitsuba by name": ("cage/a.py", "import importlib\nmi = importlib.import_module('mitsuba')"),
    "drjit in a numpy room": ("tessellation/a.py", "import drjit as dr"),
    "ours by name": ("cage/a.py", "import importlib\nimportlib.import_module('..files', __package__)"),
    "by no constant": ("cage/a.py", "import importlib\nimportlib.import_module(NAME, __package__)"),
    "by a table": (
        "__init__.py",
        "from .deferred import deferred\n__getattr__ = deferred(__name__, {'f': 'figures.f'})",
    ),
    "up in another module": ("cage/a.py", "def f():\n    from ..files.formats import read_file"),
    "unknown room": ("helpers/a.py", "import numpy"),
}
KEPT = {
    "mitsuba in shapes": ("shapes/a.py", "def f():\n    import mitsuba as mi"),
    "down": ("evaluation/a.py", "from ..mesh.one_ring import one_ring\nfrom . import element"),
    "type checking down": ("kernels/a.py", "if TYPE_CHECKING:\n    from ..tessellation import VertexTable"),
    "a method of cages": ("cage/control_cage.py", "def f():\n    from ..files.formats import read_file"),
    "command line": ("__main__.py", "import mitsuba_subdivision as msub\nfrom . import __version__"),
    "a package of similar name": ("cage/a.py", "import mitsuba_subdivision_extras, mitsubas"),
}


# Rooms that are one file, not a folder.
MODULES = {path.stem for path in ROOT.glob("*.py")}


def package_with(tmp_path, place, text):
    for room in ALLOWED:
        if room in MODULES:
            (tmp_path / f"{room}.py").touch()
        else:
            (tmp_path / room).mkdir()
            (tmp_path / room / "__init__.py").touch()
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
