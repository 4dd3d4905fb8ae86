"""Long work counts on a terminal, and leaves nothing behind."""

import io

import pytest
from mitsuba_subdivision import messages
from mitsuba_subdivision.messages import counted, print_remark, timed


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    def replaced(stream, patience=0.0):
        monkeypatch.setattr("sys.stderr", stream)
        monkeypatch.setattr(messages, "PATIENCE", patience)
        return stream

    return replaced


def test_a_line_counts_and_is_wiped_and_messages_stand_on_lines_of_their_own(terminal):
    stream = terminal(Terminal())
    assert list(counted("abc", "Letters")) == ["a", "b", "c"]
    assert "Letters" in stream.getvalue()
    assert not stream.getvalue().split("\r")[-1].strip()
    for letter in counted("ab", "Letters"):
        print_remark(letter)
    assert all(f"\r\x1b[Kmitsuba-subdivision: {letter}\n" in stream.getvalue() for letter in "ab")


@pytest.mark.parametrize(("kind", "patience"), [(Terminal, 60.0), (io.StringIO, 0.0)])
def test_short_work_and_pipes_show_nothing(terminal, kind, patience):
    stream = terminal(kind(), patience)
    assert list(counted([1, 2], "Numbers")) == [1, 2]
    assert not stream.getvalue()


def test_a_step_is_told_and_wiped(terminal):
    stream = terminal(Terminal())
    with timed("Rendering") as at:
        at("part 2 of 3")
    assert "Rendering part 2 of 3" in stream.getvalue()
    assert not stream.getvalue().split("\r")[-1].strip()
    terminal(pipe := io.StringIO())
    with timed("Rendering") as at:
        at("part 2 of 3")
    assert not pipe.getvalue()
