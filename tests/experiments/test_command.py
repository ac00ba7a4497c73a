"""The command `jaxpets`: its words, and what it is called in texts."""

import subprocess
import sys
from pathlib import Path

import pytest

from experiments import __main__, calling, flags

ROOT = Path(__main__.__file__).resolve().parents[1]
WORDS = (*__main__._PHASES, *__main__._OTHERS)


@pytest.fixture
def called(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/jaxpets"])


def python(code, *words):
    """Runs a program that is called as the command is."""
    code = f"import sys; sys.argv[0] = 'jaxpets'\n{code}"
    return subprocess.run(
        [sys.executable, "-c", code, *words],
        env={"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_first_help_names_all_words(capsys):
    assert __main__.main([]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {word} " in text for word in WORDS)
    assert max(map(len, text.splitlines())) <= 80
    assert set(flags.COMMANDS) == set(__main__._PHASES)


@pytest.mark.parametrize("word", WORDS)
def test_a_help_says_what_was_called(word, called, capsys):
    with pytest.raises(SystemExit) as stop:
        __main__.main([word, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: jaxpets {word}" in text and "experiments." not in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("fly",), "fly is no word of jaxpets. It must be explore, zero-shot,"),
        (("zeroshot",), "zeroshot is no word of jaxpets. Perhaps zero-shot?"),
        (("completion",), "completion with no value is not valid; it must be bash"),
        (("completion", "ksh"), "completion ksh is not valid; it must be bash"),
        (("explore", "--num-trails", "3"), "Perhaps --num-trials?"),
        (("--preset", "smoke"), "--phase is missing"),
    ],
)
def test_a_wrong_word_is_one_line(words, said, capsys):
    assert __main__.main(words) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: ") and said in text and text.count("\n") == 1


def test_a_command_is_named_as_it_was_called(called, monkeypatch):
    run = ("run", "zero-shot", "--from", Path("runs/a"))
    assert calling.line(*run) == "jaxpets zero-shot --from runs/a"
    assert calling.line("status") == "jaxpets status"
    assert calling.line("status", Path("my runs")) == "jaxpets status 'my runs'"
    monkeypatch.setattr(sys, "argv", ["experiments/run.py"])
    assert calling.line(*run) == ("python -m experiments.run zero-shot --from runs/a")
    assert calling.usage("status") == "experiments.status"


def test_the_library_alone_says_what_to_install():
    done = python(
        "sys.modules['tyro'] = None\n"
        "from experiments.__main__ import command; command()",
        "explore",
    )
    assert done.returncode == 2
    assert done.stderr == (
        'error: tyro is not installed; pip install "jaxpets[experiments]" brings it.\n'
    )


def test_a_wheel_may_call_the_folder_otherwise():
    """An editable install has the checkout's folder by that name."""
    done = python(
        "import jaxpets_experiments.run, jaxpets_experiments.report.report\n"
        "print('experiments' in sys.modules)\n"
        "from jaxpets_experiments.__main__ import command; command()",
        "status",
        "--help",
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("False\nusage: jaxpets status")


def test_bash_completes_words_flags_and_values(tmp_path, capsys):
    assert __main__.main(["completion", "bash"]) == 0
    script = tmp_path / "jaxpets.bash"
    script.write_text(capsys.readouterr().out)
    tries = {
        "": set(WORDS),
        "zero": {"zero-shot"},
        "explore --planner.hor": {"--planner.horizon"},
        "study --num-tr": {"--num-trials"},
        "explore --preset ": {"laptop", "paper", "smoke"},
    }
    for line, wanted in tries.items():
        words = ["jaxpets", *line.split(" ")]
        program = (
            f'source {script}; COMP_WORDS=("$@"); COMP_CWORD={len(words) - 1}\n'
            '_tyro_jaxpets; printf "%s\\n" "${COMPREPLY[@]}"'
        )
        done = subprocess.run(
            ["bash", "-c", program, "bash", *words],
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
        found = set(done.stdout.split()) - {"-h", "--help"}
        assert found == wanted, line
