import json
import os
import sys

import pytest
from mitsuba_subdivision import doctor
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.doctor import in_words, try_variant
from mitsuba_subdivision.llvm import ENVIRONMENT_VARIABLE


def test_the_report_lists_variants_and_packages(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "VARIANTS", {"scalar_rgb": True, "cuda_ad_spectral_polarized_double": False})
    assert main(["doctor"]) == 0
    told = capsys.readouterr().out
    assert "scalar_rgb" in told
    assert "works (" in told
    assert "; exact shading needs a variant of llvm or cuda\n" in told
    assert 'not available: unknown variant "cuda_ad_spectral_polarized_double"' in told
    assert told.endswith("everything that this machine should support works\n")
    for package in doctor.PACKAGES:
        assert f"\n{package} " in told


def test_failing_variants_exit_with_status_1(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "try_variant", lambda *_: {"works": False, "problem": "the process crashed (SIGABRT)"})
    assert main(["doctor", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["healthy"] is False
    assert report["variants"]["llvm_ad_rgb"]["problem"] == "the process crashed (SIGABRT)"
    assert set(report["llvm"]) == {"path", "version", "reason"}
    assert set(report["versions"]) == {"mitsuba-subdivision", "Python", *doctor.PACKAGES}
    assert main(["doctor"]) == 1
    assert capsys.readouterr().out.endswith("there are PROBLEMS, listed above\n")


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_a_missing_package_and_a_misplaced_surface_are_problems(monkeypatch):
    monkeypatch.setattr(doctor, "PACKAGES", ("numpy", "unheard-of-package"))
    report = doctor.diagnose({})
    assert not report["healthy"]
    assert "unheard-of-package   MISSING" in in_words(report)
    monkeypatch.setattr(doctor, "CUBE_HEIGHT", 0.84)
    told = "the limit surface of a cube was rendered at the height 0.839506; expected 0.840000"
    # What another process runs.
    assert doctor._report("scalar_rgb")["problem"] == told


CRASHES = pytest.mark.skipif(not hasattr(os, "kill"), reason="processes have no signals here")


@pytest.mark.parametrize(
    ("child", "problem"),
    [
        pytest.param("import os; os.abort()", "the process crashed (SIGABRT)", marks=CRASHES),
        ("raise SystemExit('no such library')", "the process ended with 1: no such library"),
        ("pass", "the process ended with 0: no output"),
        ("import time; time.sleep(60)", "did not end within 0.2 s"),
    ],
)
def test_the_report_states_how_a_process_ended(monkeypatch, child, problem):
    monkeypatch.setattr(doctor, "_CHILD", child)
    report = try_variant("scalar_rgb", seconds=0.2 if "sleep" in child else 60)
    assert (report["works"], report["problem"]) == (False, problem)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems search for LLVM by their own rules")
def test_a_broken_library_is_a_problem(monkeypatch, tmp_path):
    (tmp_path / "libLLVM.so.20").write_text("no library")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "libLLVM.so.20"))
    report = try_variant("llvm_ad_rgb")
    assert report["works"] is False
    assert report["problem"].startswith(f'Dr.Jit could not use "{tmp_path}')
