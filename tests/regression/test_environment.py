"""Processors that add in different orders have different names."""

from pathlib import Path

from mitsuba_subdivision.regression import scene

EPYC = """processor\t: 0
vendor_id\t: AuthenticAMD
cpu family\t: {family}
model\t\t: {model}
model name\t: AMD EPYC
flags\t\t: fpu vme

processor\t: 1
model name\t: another one
"""
ARM = """processor\t: 0
BogoMIPS\t: 243.75
CPU implementer\t: 0x41
CPU architecture: 8
CPU part\t: 0xd40

processor\t: 1
"""


def test_processors_of_one_name_are_told_apart_and_those_without_have_numbers():
    assert scene._first_of(EPYC.format(family=26, model=2)) == "AMD EPYC, cpu family 26, model 2"
    assert scene._first_of(EPYC.format(family=25, model=1)) == "AMD EPYC, cpu family 25, model 1"
    assert scene._first_of(ARM) == "CPU implementer 0x41, CPU architecture 8, CPU part 0xd40"
    # A list of another form gives nothing.
    assert scene._first_of("") == ""
    assert scene._first_of("no colon\n") == ""


def test_this_processor_has_a_name():
    found = scene.environment("scalar_rgb")["processor"]
    information = Path("/proc/cpuinfo")
    if information.is_file():
        assert found == scene._first_of(information.read_text(encoding="utf-8", errors="replace"))
    else:
        assert found
