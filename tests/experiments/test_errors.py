"""What a user reads: one line, which a terminal shows and does not obey."""

import pytest

from experiments.errors import CheckpointError, InterruptedRun, printable
from experiments.parallel import distributed

RED = "\x1b[31mred\x07\u202e\udcff"
SHOWN = r"\x1b[31mred\x07\u202e\udcff"


def test_control_characters_are_shown():
    assert printable(RED) == SHOWN
    text = "größe: 1 µm, 'a' \\ \"b\"\nsecond line"
    assert printable(text) == text


def test_an_error_is_one_line(capsys):
    error = CheckpointError(f"no {RED}\nerror: forged")
    assert str(error) == rf"no {SHOWN}\nerror: forged"
    distributed.say(f"warning: {RED}")
    assert capsys.readouterr().err == f"warning: {SHOWN}\n"
    with pytest.raises(CheckpointError, match="forged"):
        raise error


@pytest.mark.parametrize(
    "error", [CheckpointError("no run"), InterruptedRun("SIGTERM")]
)
def test_what_ends_the_first_host_ends_all(monkeypatch, error):
    def fails():
        raise error

    def heard(array):
        sent.append(array)
        return array

    sent = []
    monkeypatch.setattr(distributed, "is_alone", lambda: False)
    monkeypatch.setattr(distributed, "is_first", lambda: True)
    monkeypatch.setattr(distributed, "_from_first", heard)
    with pytest.raises(type(error)) as first:
        distributed.on_first(fails)
    assert first.value is error

    monkeypatch.setattr(distributed, "is_first", lambda: False)
    monkeypatch.setattr(distributed, "_from_first", lambda array: sent.pop(0))
    with pytest.raises(type(error), match=str(error)):
        distributed.on_first(lambda: pytest.fail("it is for the first alone"))
