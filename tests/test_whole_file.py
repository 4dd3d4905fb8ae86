"""Files are complete or absent after any failure of their process or the disk."""

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision import whole_file as module
from mitsuba_subdivision.regression.image import write_exr
from mitsuba_subdivision.whole_file import remove_unfinished, require_folder, require_writable, whole_file
from patches.closed_cages import torus

# The module alone: what a process imports besides takes a second.
WRITER = f"""
import itertools, pathlib, runpy, sys
whole_file = runpy.run_path({module.__file__!r})["whole_file"]
print("ready", flush=True)
for _ in itertools.count():
    with whole_file(pathlib.Path(sys.argv[1])) as beside, beside.open("wb") as stream:
        for _ in range(64):
            stream.write(sys.argv[2].encode() * {1 << 14})
            stream.flush()
"""
SIZE = 64 << 14
# Kills that must come amid a write, and how many are tried for them on a busy machine.
KILLS, TRIES = 4, 60


def start_writer(path, letter):
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path), letter], stdout=subprocess.PIPE)
    assert writer.stdout.readline() == b"ready\n"
    return writer


def kill(writer):
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    writer.stdout.close()


def write(path, text="new", then=lambda: None):
    with whole_file(path) as beside:
        beside.write_text(text)
        then()


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


@pytest.mark.parametrize("before", [[], ["a.txt"]])
@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (lambda _: KeyboardInterrupt(), KeyboardInterrupt, "^$"),
        (lambda beside: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(beside)), OSError, r"a\.txt"),
        (lambda beside: RuntimeError(f'cannot write "{beside}"'), OSError, r"a\.txt"),
    ],
)
def test_a_failed_write_keeps_the_old_file_and_names_it(tmp_path, before, error, kind, message):
    path = tmp_path / "a.txt"
    for name in before:
        (tmp_path / name).write_text("old")

    def fail():
        with whole_file(path) as beside:
            beside.write_text("ne")
            raise error(beside)

    with pytest.raises(kind, match=message) as result:
        fail()
    assert ".part" not in str(result.value)
    assert names(tmp_path) == before
    assert [(tmp_path / name).read_text() for name in before] == ["old"] * len(before)


@pytest.mark.posix
def test_a_killed_writer_leaves_a_whole_file_or_none(tmp_path, np_rng):
    path, left = tmp_path / "a.bin", 0
    for _ in range(TRIES):
        writer = start_writer(path, "x")
        time.sleep(np_rng.random() * 0.03)
        kill(writer)
        assert not path.exists() or path.read_bytes() == b"x" * SIZE
        left += len(parts := [name for name in names(tmp_path) if ".part" in name])
        for part in parts:
            (tmp_path / part).unlink()
        if left >= KILLS:
            return
    pytest.fail("too few processes were killed while they wrote: the test shows nothing")


def test_two_processes_write_one_file_without_mixing(tmp_path):
    path = tmp_path / "a.bin"
    writers = [start_writer(path, letter) for letter in "xy"]
    seen, deadline = set(), time.monotonic() + 30
    try:
        while seen != {b"x", b"y"} and time.monotonic() < deadline:
            if path.exists():
                result = path.read_bytes()
                assert result == result[:1] * SIZE
                seen.add(result[:1])
            assert all(writer.poll() is None for writer in writers)
        assert seen == {b"x", b"y"}
    finally:
        for writer in writers:
            kill(writer)


def test_threads_write_one_file_without_mixing(tmp_path):
    path = tmp_path / "a.txt"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, [path] * 8, [letter * 1000 for letter in "abcdefgh"]))
    assert path.read_text() in [letter * 1000 for letter in "abcdefgh"]
    assert names(tmp_path) == ["a.txt"]


def test_only_unfinished_files_are_removed_at_exit(tmp_path):
    write(tmp_path / "a.txt", then=lambda: write(tmp_path / "b.txt"))
    with pytest.raises(FileNotFoundError):
        write(tmp_path / "c.txt", then=remove_unfinished)
    assert names(tmp_path) == ["a.txt", "b.txt"]


@pytest.mark.posix
def test_links_are_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link.txt").symlink_to(tmp_path / "real" / "a.txt")
    write(tmp_path / "link.txt")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"


@pytest.mark.posix
@pytest.mark.parametrize("name", ["pipe", "link"])
def test_pipes_are_written_to(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    # As /dev/stdout is one.
    (tmp_path / "link").symlink_to("pipe")
    require_writable(tmp_path / name)
    read = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_text()))
    reader.start()
    write(tmp_path / name)
    reader.join()
    assert read == ["new"]


@pytest.mark.parametrize("stem", ["a" * 251, "ä" * 125])
def test_names_of_maximum_length_are_written(tmp_path, stem):
    path = tmp_path / f"{stem}.txt"
    require_writable(path)
    write(path)
    assert names(tmp_path) == [path.name]


def test_invalid_outputs_are_refused_by_name(tmp_path, monkeypatch):
    (tmp_path / "folder.txt").mkdir()
    for name in ("file", "protected.txt"):
        (tmp_path / name).write_text("")
    # The superuser may write to all files.
    monkeypatch.setattr(os, "access", lambda path, mode: not (mode == os.W_OK and Path(path).name == "protected.txt"))
    for path, message in (
        (tmp_path / "folder.txt", 'folder.txt" is a folder; expected a file'),
        (tmp_path / "file" / "a.txt", 'file" is a file; expected a folder'),
        (tmp_path / f"{'a' * 300}.txt", 'aaa.txt".*too long|too long'),
        (tmp_path / "protected.txt", r'protected\.txt" is protected from writing'),
        (Path("/proc/a.txt"), 'output "/proc/a.txt": '),
    ):
        with pytest.raises(OSError, match=message):
            require_writable(path)
    with pytest.raises(OSError, match='folder "/proc/folder" cannot be made: '):
        require_folder(Path("/proc/folder"))
    assert names(tmp_path) == ["file", "folder.txt", "protected.txt"]


@pytest.mark.posix
def test_inputs_are_refused_as_outputs(tmp_path):
    (tmp_path / "a.txt").write_text("kept")
    (tmp_path / "link.txt").symlink_to("a.txt")
    with pytest.raises(ValueError, match=r'output ".*link\.txt" is an input as well'):
        require_writable(tmp_path / "link.txt", [tmp_path / "a.txt"])
    require_writable(tmp_path / "new" / "b.txt", [tmp_path / "a.txt"])
    assert names(tmp_path / "new") == []


@pytest.mark.posix
@pytest.mark.usefixtures("variant_scalar_rgb")
def test_every_writer_reports_a_full_disk_and_keeps_the_old_file(tmp_path, np_rng):
    resource = pytest.importorskip("resource")
    for package in ("pxr", "plyfile", "matplotlib"):
        pytest.importorskip(package)
    from mitsuba_subdivision.figures.output import FigureOptions
    from mitsuba_subdivision.figures.staging import draw_picture

    pixels, cage = np_rng.random((128, 128, 3)).astype(np.float32), torus(20, 20)

    def write_bitmap(path):
        with whole_file(path) as beside:
            mi.util.convert_to_bitmap(pixels, uint8_srgb=False).write(str(beside))

    def draw(path):
        draw_picture(FigureOptions(tmp_path, formats=("png",)), path.stem, pixels, cage="none")

    writers = {"a.exr": lambda path: write_exr(path, pixels), **dict.fromkeys(("b.exr", "b.hdr"), write_bitmap)}
    writers["c.png"] = draw
    writers |= {f"d.{suffix}": LimitSurface(cage).tessellate(2).save for suffix in ("obj", "ply", "usda", "usdc")}
    writers |= {f"e.{suffix}": cage.save for suffix in ("obj", "ply", "usda", "usdc")}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # As on a full disk: what goes beyond is not written.
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        for name, writer in writers.items():
            (tmp_path / name).write_text("old")
            with pytest.raises(OSError, match=re.escape(str(tmp_path / name))) as error:
                writer(tmp_path / name)
            assert ".part" not in str(error.value)
            assert names(tmp_path) == [name]
            assert (tmp_path / name).read_text() == "old"
            (tmp_path / name).unlink()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
