import fcntl
import os
import shutil
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from mitsuba_subdivision.__main__ import interruptible, main
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.shapes.interaction_hook import hook_problem

# Windows has no such terminals.
pty = pytest.importorskip("pty")

SCENE = Path(__file__).parent / "data" / "cube.xml"
# The command line, also where the tests run in the background and so ignore what this is about.
LISTENING = """import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from mitsuba_subdivision.__main__ import main
sys.exit(main(sys.argv[1:]))"""
# Far more than what any machine renders before the test interrupts it.
SAMPLES = "100000"


def test_work_gives_its_result_or_its_error_and_another_thread_does_its_own():
    assert interruptible(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 / 0)
    result = []
    thread = threading.Thread(target=lambda: result.append(interruptible(threading.get_ident)))
    thread.start()
    thread.join()
    assert result == [thread.ident]


def test_ctrl_c_does_not_wait_for_the_work(monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.__main__._abandon", Mock(side_effect=InterruptedError))
    started, end = threading.Event(), threading.Event()

    def work():
        started.set()
        end.wait()

    def press():
        started.wait()
        signal.raise_signal(signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    presser = threading.Thread(target=press)
    try:
        presser.start()
        # Where the process would end.
        with pytest.raises(InterruptedError):
            interruptible(work)
    finally:
        signal.signal(signal.SIGINT, handler)
        end.set()
        presser.join()


def test_interrupts_within_the_work_are_reported(monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("mitsuba_subdivision.commands.info._surface", interrupt)
    assert main(["info", "cube.obj"]) == 130
    assert capsys.readouterr().err == "mitsuba-subdivision: interrupted\n"


@pytest.mark.parametrize(
    ("variant", "shading", "seconds", "words"),
    [("scalar_rgb", "vertex", 0.3, ["--passes", "2"]), ("llvm_ad_rgb", "exact", 6, [])],
)
def test_ctrl_c_ends_a_render(tmp_path, shading, seconds, words, variant, request):
    if shading == "exact" and hook_problem():
        pytest.skip(str(hook_problem()))
    request.getfixturevalue(f"variant_{variant}")
    cube().save(tmp_path / "cube.obj")
    shutil.copy(SCENE, tmp_path / "scene.xml")
    mine, its = pty.openpty()
    # A terminal of no width would show no progress.
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    command = [sys.executable, "-c", LISTENING, "render", "scene.xml", "-o", "picture.exr"]
    command += ["--spp", SAMPLES, "--variant", variant, "-D", f"shading={shading}", *words]
    command += ["-D", "size=512", "-D", "integrator=path"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    render = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=its, cwd=tmp_path, env=environment)
    request.addfinalizer(render.kill)
    os.close(its)
    said = os.read(mine, 1000)
    while b"Rendering" not in said:
        said += os.read(mine, 1000)
    # When the render has begun, which takes some seconds without a cache of kernels on a busy machine, Mitsuba's own
    # handler is replaced within a moment.
    time.sleep(seconds)
    render.send_signal(signal.SIGINT)
    out, _ = render.communicate(timeout=60)
    while b"interrupted" not in said:
        said += os.read(mine, 1000)
    os.close(mine)
    assert (render.returncode, out) == (130, b"")
    assert said.endswith(b"\r\x1b[Kmitsuba-subdivision: interrupted\r\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cube.obj", "scene.xml"]
