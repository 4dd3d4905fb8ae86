"""Long work counts on a terminal, and leaves nothing behind."""

import io

import pytest
from mitsuba_subdivision import progress
from mitsuba_subdivision.messages import print_remark


class Terminal(io.StringIO):
    def isatty(self):
        return True


def in_place_of_stderr(monkeypatch, stream, patience=0.0):
    """The stream, set by the test itself: between fixtures and the test, pytest sets its own."""
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr(progress, "PATIENCE", patience)
    monkeypatch.setattr(progress, "INTERVAL", 0.0)
    return stream


def test_a_line_counts_and_is_wiped(monkeypatch):
    terminal = in_place_of_stderr(monkeypatch, Terminal())
    assert list(progress.counted("abc", "Letters")) == ["a", "b", "c"]
    lines = [f"\rLetters [{'#' * 10 * n}{'.' * 10 * (3 - n)}] {n} of 3" for n in range(3)]
    assert terminal.getvalue() == "".join(lines) + "\r\x1b[K"


def test_messages_stand_on_lines_of_their_own(monkeypatch):
    terminal = in_place_of_stderr(monkeypatch, Terminal())
    for letter in progress.counted("ab", "Letters"):
        print_remark(letter)
    text = terminal.getvalue()
    assert all(f"\r\x1b[Kmitsuba-subdivision: {letter}\n" in text for letter in "ab")


def test_an_interrupted_line_is_wiped(monkeypatch):
    terminal = in_place_of_stderr(monkeypatch, Terminal())

    def work():
        for _ in progress.counted("abc", "Letters"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert terminal.getvalue().endswith("\x1b[K")


@pytest.mark.parametrize(("stream", "patience"), [(Terminal(), 60.0), (io.StringIO(), 0.0)])
def test_short_work_and_pipes_show_nothing(monkeypatch, stream, patience):
    in_place_of_stderr(monkeypatch, stream, patience)
    assert list(progress.counted([1, 2], "Numbers")) == [1, 2]
    assert not stream.getvalue()


def test_seconds_of_a_step_are_told_and_wiped(monkeypatch):
    terminal = in_place_of_stderr(monkeypatch, Terminal(), patience=0.001)
    with progress.timed("Rendering") as at:
        at("part 2 of 3")
        while "part" not in terminal.getvalue():
            pass
    assert terminal.getvalue().startswith("\rRendering")
    assert "\rRendering part 2 of 3: 0 s\x1b[K" in terminal.getvalue()
    assert terminal.getvalue().endswith("\r\x1b[K")


@pytest.mark.parametrize(("stream", "patience"), [(Terminal(), 60.0), (io.StringIO(), 0.0)])
def test_short_steps_and_pipes_show_nothing(monkeypatch, stream, patience):
    in_place_of_stderr(monkeypatch, stream, patience)
    with progress.timed("Rendering") as at:
        at("part 1 of 1")
    assert not stream.getvalue()
