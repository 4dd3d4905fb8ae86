"""The choice of Dr.Jit's LLVM library. Choices that Dr.Jit makes once per process are tested in separate processes."""

import os
import secrets
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
from mitsuba_subdivision import llvm

CAGE = Path(__file__).parents[1] / "scenes" / "cages" / "valence3.obj"
OLD_LIBRARY = max(map(str, Path("/usr/lib/x86_64-linux-gnu").glob("libLLVM-1[56].so.1")), default="")
IS_TOO_OLD = OLD_LIBRARY and llvm.lowest_version() == 17
NEEDS_TOO_OLD = pytest.mark.skipif(not IS_TOO_OLD, reason="no LLVM that is too old")
NEEDS_LLVM = pytest.mark.skipif(llvm.llvm_problem() is not None, reason="no usable LLVM")

# Runs before the package, which chooses on import: hides the Python environment's libraries, sets the system's folder.
HIDE = """
import importlib.util, os, site, sys
folder = os.path.dirname(importlib.util.find_spec("mitsuba_subdivision").origin)
spec = importlib.util.spec_from_file_location("mitsuba_subdivision.llvm", folder + "/llvm.py")
llvm = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(llvm)
llvm._python_folders = lambda: []
llvm._SYSTEM_FOLDERS = (os.environ["SYSTEM_FOLDER"],)
"""


def run(code, **environment):
    clean = {name: os.environ[name] for name in {*os.environ} - {llvm.ENVIRONMENT_VARIABLE, "LD_LIBRARY_PATH"}}
    given = {"env": clean | environment, "timeout": 120, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", code], check=False, **given)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """Search from the start in folders of our own: the Python environment's and the system's."""
    python, system = tmp_path / "python", tmp_path / "system"
    python.mkdir()
    system.mkdir()
    monkeypatch.delenv(llvm.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    monkeypatch.delitem(sys.modules, "drjit")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(llvm.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(llvm, "_python_folders", lambda: [str(python)])
    monkeypatch.setattr(llvm, "_SYSTEM_FOLDERS", (str(system),))
    llvm.select_llvm.cache_clear()
    yield python, system
    llvm.select_llvm.cache_clear()


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-19.so", 19),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so.23.1", 23),
        ("llvm-19/lib/libLLVM.so", 19),
        ("llvm/20.1.2/lib/libLLVM.dylib", 20),
        ("libLLVM.so", None),
        ("libm.so.6", None),
    ],
)
def test_version_by_name(tmp_path, name, version):
    # Resolved, so that no part of the folder's own name counts.
    path = tmp_path.resolve() / name
    assert llvm.library_version(path) == version
    if os.name == "posix":
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        (tmp_path / "libLLVM").symlink_to(path)
        assert llvm.library_version(tmp_path / "libLLVM") == version


@pytest.mark.parametrize(("modules", "libraries"), [("lib/python3/site-packages", "lib"), ("packages", "packages/lib")])
def test_libraries_of_a_wheel_are_found_where_its_packages_are(monkeypatch, tmp_path, modules, libraries):
    """In an environment, and in a folder that `pip install --target` names."""
    for folder in (modules, libraries):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / libraries / "libLLVM.so.19.1").touch()
    monkeypatch.setattr(sys, "path", ["", str(tmp_path / modules)])
    assert str(tmp_path / libraries / "libLLVM.so.19.1") in llvm._libraries(llvm._python_folders())


def test_a_folder_with_a_star_matches_names_by_their_beginning(tmp_path):
    for version, folder in ((18, "llvm-18/lib"), (19, "llvm-19/lib"), (20, "llvm-20/bin"), (21, "other-21/lib")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / f"libLLVM-{version}.so").touch()
    (tmp_path / "llvm-18/lib/libLLVM-folder.so").mkdir()
    libraries = llvm._libraries([f"{tmp_path}/llvm-*/lib", f"{tmp_path}/none*/lib", f"{tmp_path}/none"])
    assert sorted(libraries) == [str(tmp_path / f"llvm-{version}/lib/libLLVM-{version}.so") for version in (18, 19)]


@pytest.mark.parametrize(
    ("python", "system", "machine", "setting", "version"),
    [
        (["libLLVM.so.19.1"], ["libLLVM.so.22.1"], "x86_64", None, 19),
        ([], ["libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so.1"], "x86_64", None, 19),
        # Nothing leaves the search to Dr.Jit; old ones alone are never used, unless the processor lacks instructions.
        ([], ["libLLVM.so"], "x86_64", None, None),
        (["libLLVM-16.so"], ["libLLVM-14.so.1"], "x86_64", None, llvm.NO_USABLE_LLVM),
        ([], ["libLLVM-15.so.1"], "aarch64", None, 15),
        # The user's own setting stands; what a parent process did not find is looked for again.
        (["libLLVM.so.19.1"], [], "x86_64", "/opt/libLLVM-15.so", 15),
        (["libLLVM.so.19.1"], [], "x86_64", llvm.NO_USABLE_LLVM, 19),
    ],
)
def test_libraries_of_python_precede_the_systems(fresh, monkeypatch, python, system, machine, setting, version):
    for folder, names in zip(fresh, (python, system), strict=True):
        for name in names:
            (folder / name).touch()
    monkeypatch.setattr(llvm.platform, "machine", lambda: machine)
    if setting:
        monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, setting)
    choice = llvm.select_llvm()
    if version == llvm.NO_USABLE_LLVM:
        assert choice.path is None
        assert "17 or newer" in choice.reason
    else:
        assert choice.version == version
    assert os.environ.get(llvm.ENVIRONMENT_VARIABLE) == (choice.path or version)


@NEEDS_LLVM
def test_a_good_library_runs_maximum_is_the_best_variant_and_does_not_warn():
    done = run(
        "import mitsuba_subdivision, mitsuba as mi, drjit as dr; from mitsuba_subdivision.llvm import best_variant;"
        "mi.set_variant(best_variant()); print(mi.variant(), dr.maximum(mi.Float([1, 4]), mi.Float(2)))"
    )
    assert (done.stdout, done.stderr) == ("llvm_ad_rgb [2, 4]\n", "")


@pytest.mark.skipif(llvm.lowest_version() != 17, reason="old LLVM works on this processor")
def test_without_a_usable_library_variants_fail_with_an_exception(tmp_path):
    (tmp_path / "libLLVM-15.so.1").touch()
    done = run(
        HIDE + "import mitsuba_subdivision, mitsuba as mi\n"
        "try: mi.set_variant('llvm_ad_rgb')\n"
        "except ImportError as error: print('ImportError')\n"
        "print(llvm.best_variant()); mi.set_variant('scalar_rgb')",
        SYSTEM_FOLDER=str(tmp_path),
    )
    assert done.stdout.split() == ["ImportError", "scalar_rgb"]
    line = done.stderr.splitlines()[-1]
    assert "using the slower variant scalar_rgb" in line
    assert "no LLVM library but LLVM 15, which would abort" in line
    assert "pip install 'mitsuba-subdivision[llvm]'" in line
    assert llvm.ENVIRONMENT_VARIABLE in line


# Mitsuba before the package, which then comes too late.
LATE = "import mitsuba as mi, os; del os.environ['DRJIT_LIBLLVM_PATH'];"
TOO_LATE = "import mitsuba_subdivision before mitsuba and drjit"
# Nothing is told while the variant is a scalar one.
SCALAR = "import mitsuba_subdivision, sys; mi.set_variant('scalar_rgb'); sys.stderr.write('so far\\n');"
LLVM = "mi.set_variant('llvm_ad_rgb');"


@NEEDS_TOO_OLD
@pytest.mark.parametrize(
    ("code", "message"),
    [
        (f"import mitsuba_subdivision, mitsuba as mi; {SCALAR} {LLVM}", "(DRJIT_LIBLLVM_PATH is set)"),
        (f"{LATE} {SCALAR} {LLVM}", TOO_LATE),
        (f"{LATE} {LLVM} import mitsuba_subdivision", TOO_LATE),
    ],
    ids=["user's setting", "imported late", "imported after set_variant"],
)
def test_aborting_libraries_warn_when_an_llvm_variant_is_set(code, message):
    done = run(code, DRJIT_LIBLLVM_PATH=OLD_LIBRARY)
    assert done.stderr.startswith("so far\n") == (SCALAR in code)
    assert done.stderr.count("which aborts the process, and needs 17 or newer") == 1
    assert message in done.stderr


# In one process, as importing takes longest.
RUNS_KERNELS = [
    "LimitSurface(cube()).on_device('llvm_ad_rgb')",
    "upload(mi.Float, [0])",
    "fit.CageFit(cube(), [fit.View({'type': 'perspective', 'film': film}, np.zeros((4, 4, 3)))], {})",
    "usd_scene('none.usda', mi)",
    "set_variant('llvm_mono')",
    f"mi.load_dict({{'type': 'subdivision', 'filename': {str(CAGE)!r}}})",
]


@NEEDS_TOO_OLD
def test_calls_that_run_kernels_are_errors_with_old_libraries():
    """Earlier, the first evaluation of `on_device` ended the process."""
    done = run(
        f"""{LATE} import numpy as np
from mitsuba_subdivision import LimitSurface, usd_scene
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload; from mitsuba_subdivision.variants import set_variant
mi.set_variant('llvm_ad_rgb'); from mitsuba_subdivision import fit
film = {{'type': 'hdrfilm', 'width': 4, 'height': 4}}
for code in {RUNS_KERNELS!r}:
    try: exec(code)
    except RuntimeError as error: print(repr(error))
    else: print("no error:", code)""",
        DRJIT_LIBLLVM_PATH=OLD_LIBRARY,
    )
    told = done.stdout.splitlines()
    assert len(told) == len(RUNS_KERNELS)
    assert [line for line in told if "Dr.Jit has loaded LLVM" not in line or TOO_LATE not in line] == []


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_kernels_of_tests_are_not_kept_for_users():
    """These are without LLVM's optimisations."""
    folder = Path(os.environ["DRJIT_CACHE_DIR"])
    before = set(folder.iterdir()) if folder.is_dir() else set()
    # Of a number that no kernel has had.
    dr.eval(dr.arange(mi.Float, 3) * secrets.randbelow(10**7))
    assert set(folder.iterdir()) - before
