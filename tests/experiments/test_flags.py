"""The phases as commands: their flags, their help, and where a phase may stand."""

import dataclasses
import re

import pytest

from experiments import cli
from experiments.entries import entries, flag, is_read
from experiments.flags import COMMANDS
from experiments.presets import PRESETS
from experiments.run import main


def help_of(capsys, *flags):
    with pytest.raises(SystemExit) as stop:
        main([*flags, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("said", [("{}",), ("--phase", "{}", "--preset", "smoke")])
@pytest.mark.parametrize("phase", COMMANDS)
def test_the_help_of_a_phase_explains_all_flags_that_it_reads(phase, said, capsys):
    text = help_of(capsys, *(word.format(phase) for word in said))
    assert f"experiments.run {phase}" in text
    assert COMMANDS[phase].__doc__.splitlines()[0] in text
    for entry in entries(COMMANDS[phase]):
        shown = re.search(rf"(?m)^\W*{flag(entry.name)}\b", text) is not None
        assert shown == is_read(entry.name, phase), entry.name


def test_the_first_help_fits_two_screens(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = help_of(capsys).splitlines()
    assert len(lines) <= 90 and max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert all(phase in text for phase in COMMANDS)
    assert "--preset" in text and "--planner.horizon" not in text


@pytest.mark.parametrize(
    "flags",
    [
        ("explore", "--preset", "smoke", "--seeds", "1", "2"),
        ("--phase", "explore", "--preset", "smoke", "--seeds", "1", "2"),
        ("--preset", "smoke", "--seeds", "1", "2", "--phase", "explore"),
        ("--seeds", "1", "2", "--phase=explore", "--preset=smoke"),
        ("explore", "--preset", "smoke", "--seeds", "1", "2", "--task", "all"),
    ],
)
def test_a_phase_is_the_first_word_or_a_flag_anywhere(flags):
    want = dataclasses.replace(PRESETS["smoke"], seeds=(1, 2))
    assert cli.parse(flags) == want


def test_a_report_may_stand_behind_the_flags_of_other_phases(tmp_path):
    flags = ("--preset", "paper", "--engine", "mujoco", "--out", str(tmp_path))
    config = cli.parse([*flags, "--phase", "report"])
    assert (config.phase, config.out) == ("report", tmp_path)
