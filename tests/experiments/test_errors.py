"""What a user reads: one line, which a terminal shows and does not obey."""

import pytest

from experiments.errors import CheckpointError, printable
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
