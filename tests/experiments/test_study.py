"""A study: all phases after one command, under one bar."""

import contextlib
import os
import pty
import re
import sys
import termios
import threading

import own_robot
import pytest

from experiments import study
from experiments.report import style

FILE = own_robot.__file__
FLAGS = (
    "--env", FILE, "--arm", f"{FILE}:novelty", "--preset", "smoke",
    "--engine", "mujoco", "--model.num-members", "2", "--model.hidden-size", "8",
    "--model.num-layers", "1", "--num-trials", "2",
    *(f"--{name}.{flag}" for name in ("planner", "task-planner")
      for flag in ("no-fused", "horizon=2", "num-particles=2", "num-iterations=1")),
)  # fmt: skip
NAME = "smoke-own_robot-own_robot-novelty"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "none-such")  # videos are tested elsewhere
    monkeypatch.setitem(style.STYLE, "savefig.dpi", 30)
    monkeypatch.setattr(study, "_REFRESH", 0.01)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("out")


@contextlib.contextmanager
def terminal(monkeypatch):
    """Makes stderr a terminal; gives what has all that it was sent, at the end."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (40, 120))
    sent = bytearray()

    def read():
        while not sent.endswith(b"\0"):
            sent.extend(os.read(ours, 65536))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    with monkeypatch.context() as patch, os.fdopen(theirs, "w") as file:
        patch.setattr(sys, "stderr", file)
        yield sent
        file.write("\0")
        file.flush()
        reader.join(20)
    os.close(ours)


def test_one_bar_names_what_is_waited_for(out, monkeypatch):
    with terminal(monkeypatch) as sent:
        assert study.main([*FLAGS, "--out", str(out)]) == 0
    shown = sent.decode()
    for waited in (
        "explore: compiling the physics, about 10 s, once",
        "explore: compiling the planner, about 30 s, once",
        "zero-shot: compiling the planner, about 30 s, once",
        "video 1 of 2",
    ):
        assert waited in shown
    shares = [int(x) for x in re.findall(r"(\d+)% \|", shown)]
    assert shares == sorted(shares) and shares[-1] > shares[0]
    assert re.search(r"% \|.*\| 00:\d\d, about \d+ s left  ", shown)
    assert " steps " not in shown  # the bar of a phase


def test_elsewhere_it_prints_lines_and_says_what_was_made(out, capsys):
    """After the other test exploring is done, and is not done again."""
    assert study.main([*FLAGS, "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "already complete: 2 of 2 trials." in said and "\r" not in said
    assert "%" not in said and "compiling" not in said
    _, last = said.split("\ndone in ")
    report = out / "report" / "report.md"
    assert f"  {report}" in last and report.exists() and ".mp4" not in last
    run = out / NAME
    named = f"--from {run} --env {FILE} --arm {FILE}:novelty"
    assert last.endswith(f"  python -m experiments.run finetune {named}\n")


def test_the_folder_of_the_run_may_be_a_link_to_another_disk(out, tmp_path, capsys):
    """Phase 2 and the report find it by its name."""
    (tmp_path / "mine").symlink_to(out / NAME)
    flags = [*FLAGS, "--out", str(tmp_path), "--name", "mine"]
    assert study.main(flags) == 0
    said = capsys.readouterr().err
    assert f"finetune --from {tmp_path / 'mine'}" in said
    report = (tmp_path / "report" / "report.md").read_text()
    assert "`own_robot-novelty`: explored 2 trials (seeds 0); 1 zero-shot" in report


def test_a_seed_that_the_report_would_count_twice_is_refused(out, capsys):
    """Before anything is explored."""
    flags = [*FLAGS, "--out", str(out), "--name", "second"]
    assert study.main(flags) == 2
    text = capsys.readouterr().err
    assert f"{out / NAME} has seed 0 of own_robot-novelty already" in text
    assert text.count("\n") == 1 and not (out / "second").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--num-trails", "3"), "Perhaps --num-trials?"),
        (("--num-trials", "none"), "--num-trials"),
        (("--video", "a.mp4"), "--video"),
        (("zero-shot",), "zero-shot"),
        (
            ("--coordinator-address", "h:1", "--num-processes", "2", "--process-id=0"),
            "--coordinator-address h:1 is not valid; it must be left out; a study is",
        ),
    ],
)
def test_what_is_wrong_is_a_line(flags, said, tmp_path, capsys):
    assert study.main(["--out", str(tmp_path / "out"), *flags]) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_phase_that_fails_ends_it(tmp_path, capsys):
    (tmp_path / "out").write_text("no folder")
    assert study.main([*FLAGS, "--out", str(tmp_path / "out")]) == 5
    assert "done in" not in capsys.readouterr().err
