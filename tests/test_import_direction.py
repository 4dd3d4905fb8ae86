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
    "files": {"whole_file", "mesh", "cage"},
    "inspection": {"mesh", "schemes", "cage", "surface"},
    "surface": {*NUMPY_ROOMS[: NUMPY_ROOMS.index("surface")], "kernels"},
    "kernels": {"deferred", "mesh", "schemes", "evaluation", "patches", "tessellation"},
    "shapes": {"llvm", *NUMPY_ROOMS, "kernels"},
    "fit": {*NUMPY_ROOMS, "kernels", "shapes"},
    "images": {"whole_file"},
    "regression": {"llvm", "messages", "whole_file", "progress", "images", "__init__"},
    "figures": {
        "llvm",
        "messages",
        "examples",
        *NUMPY_ROOMS,
        "kernels",
        "shapes",
        "fit",
        "images",
        "regression",
        "__init__",
    },
    "studio": {"llvm", "messages", *NUMPY_ROOMS, "kernels", "shapes", "images", "regression", "__init__"},
    "usd": {"variants", "mesh", "schemes", "cage", "files", "surface", "studio"},
    "doctor": {"llvm", "cage", "__init__"},
    "__main__": {
        "llvm",
        "messages",
        "interruption",
        *NUMPY_ROOMS,
        "inspection",
        "kernels",
        "shapes",
        "images",
        "regression",
        "studio",
        "usd",
        "figures",
        "doctor",
        "__init__",
    },
    "__init__": {"llvm", "examples", *NUMPY_ROOMS, "kernels", "shapes", "fit", "studio", "usd"},
}
# Who may import a package that the numpy rooms do without.
MAY_IMPORT = {
    "mitsuba": {"variants", "shapes", "fit", "regression", "figures", "studio", "doctor", "__main__"},
    "drjit": {"llvm", "kernels", "shapes", "fit", "regression", "figures", "studio", "doctor", "__main__"},
    "matplotlib": {"figures"},
    "plyfile": {"files"},
    "pxr": {"files", "usd"},
    "MaterialX": {"usd"},
}


def imported_names(tree, package):
    """Dotted names of all imports of a module that lies in ``package``, wherever in the module they are."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            base = [*above, *([node.module] if node.module else [])]
            yield from (".".join([*base, alias.name]) for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "__import__",
        ):
            yield from (arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant))


def room_of(name, rooms):
    """Room that a dotted name of ours leads to; ``__init__`` for what the package itself offers."""
    _, *path = name.split(".")
    return path[0] if path and path[0] in rooms else "__init__"


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
            top = name.split(".")[0]
            target = room_of(name, rooms) if top == PACKAGE else None
            if target not in {None, room, *ALLOWED.get(room, ())}:
                found.append(f"{relative}: {name} ({room} may not import {target})")
            if room not in MAY_IMPORT.get(top, {room}):
                found.append(f"{relative}: {name} ({room} may not import {top})")
    return found


def is_room(path):
    if path.name == "scenes":
        return False  # Data, with scripts for Blender, which an installed package has beside its rooms.
    return path.suffix == ".py" or (path.is_dir() and any(path.glob("*.py")))


def test_imports_go_one_way():
    assert violations(ROOT) == []


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
    "module beside the rooms": ("surface.py", "from .shapes import registration"),
    "images of ours": ("images/a.py", "from ..cage import ControlCage"),
    "kernels of the surface": ("kernels/a.py", "from ..surface import LimitSurface"),
    "llvm of ours": ("llvm.py", "from .cage import ControlCage"),
    "nested": ("cage/deep/a.py", "from ...surface import LimitSurface"),
    "mitsuba in images": ("images/a.py", "def f():\n    import mitsuba as mi"),
    "cage in regression": ("regression/a.py", "from ..cage import ControlCage"),
    "mitsuba in a numpy room": ("surface.py", "def f():\n    import mitsuba as mi"),
    "mitsuba in kernels": ("kernels/a.py", "from mitsuba import llvm_ad_rgb"),
    "mitsuba by name": ("cage/a.py", "import importlib\nmi = importlib.import_module('mitsuba')"),
    "drjit in a numpy room": ("tessellation/a.py", "import drjit as dr"),
    "unknown room": ("helpers/a.py", "import numpy"),
}
KEPT = {
    "mitsuba in shapes": ("shapes/a.py", "def f():\n    import mitsuba as mi"),
    "down": ("evaluation/a.py", "from ..mesh.one_ring import one_ring\nfrom . import element"),
    "type checking down": ("kernels/a.py", "if TYPE_CHECKING:\n    from ..tessellation import SamplingTable"),
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
