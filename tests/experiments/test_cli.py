"""The command line of the experiments: what it takes, and how it refuses the rest."""

import dataclasses
import json
import warnings

import pytest

from experiments import cli, phases
from experiments.config import Config, DistillingConfig, ImaginationConfig
from experiments.entries import to_json
from experiments.errors import InterruptedRun, OutOfMemoryError
from experiments.presets import PRESETS
from experiments.run import _plain_errors, main
from experiments.storage import status

SMOKE = ("--phase", "explore", "--preset", "smoke")
LATER = ("--phase", "zero-shot", "--preset", "smoke")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def fail(out, capsys):
    """Runs `main`; returns its exit code and the one line it must have said."""

    def run(*flags):
        code = main([*flags, "--out", str(out)])
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("error: ")
        assert said.err.count("\n") == 1 and said.err.endswith("\n")
        assert not set("│─╭╰") & set(said.err)
        return code, said.err

    return run


def explored(out, name="smoke-epistemic", **changes):
    """Writes the config.json of an exploration run."""
    config = dataclasses.replace(PRESETS["smoke"], phase="explore", **changes)
    (out / name).mkdir(parents=True)
    path = out / name / "config.json"
    path.write_text(json.dumps(to_json(config)))
    return path


# Command lines, after those of SMOKE where they begin with a flag, and what is said.
WRONG = """
fly --preset smoke                      | --phase fly; finetune
report --num-trails 3                   | --num-trails is not a flag
report                                  | metrics.jsonl
report --coordinator-address auto       | --coordinator-address auto; in report
explore --preset paper                  | --preset paper; hours; --allow-cpu
--phase                                 | --phase with no value; explore, zero-shot
--phase fly                             | --phase fly; finetune
--preset huge                           | --preset huge; laptop, paper, smoke
--arm x                                 | --arm x; one-step
--num-trails 3                          | --num-trails is not a; Perhaps --num-trials?
--num_trails=3                          | --num_trails is not a; Perhaps --num-trials?
--allow-cpu=true                        | true is not a flag
--allow-cpu extra                       | extra is not a flag
--num-trials                            | --num-trials with no value; 1 to 100,000
--num_trials=0                          | --num-trials 0; 1 to 100,000
--num-trials -1                         | --num-trials -1; 1 to 100,000
--num-trials 1e9                        | --num-trials 1e9; 1 to 100,000
--num-trials 2.5                        | --num-trials 2.5; 1 to 100,000
--num-trials nan                        | --num-trials nan; 1 to 100,000
--milestones 10 -1                      | --milestones 10 -1; a list, each 1 to 100,000
--training.learning-rate nan            | learning-rate nan; 1e-09 to 1.0
--model.state-margin inf                | state-margin inf; 0.0 to 1,000,000.0 or None
--tuning.num-epochs 0                   | --tuning.num-epochs 0; 1 to 10,000
--seeds                                 | --seeds (); one or more different
--seeds 0 -1                            | --seeds 0 -1; 0 to 4,294,967,295
--seeds 0 0                             | --seeds (0, 0); different
--planner.num-elites 9                  | --planner.num-elites 9; num-samples (8)
--task-planner.num-particles 4          | --task-planner.num-particles 4; multiple; (3)
--model.num-members 1                   | members 1; 2 or more for --arm epistemic
--arm random --model.num-members 1 --pessimism 1 | --pessimism 1.0; 0 with one member
--random-trials 4                       | --random-trials 4; --num-trials (3)
--chunk-length 7                        | --chunk-length 7; divisor; (20)
--task forward                          | --task forward; left out in explore
--tag x                                 | --tag x; it is for zero-shot and finetune
--from there                            | --from there; left out in explore
--at-trial 2                            | --at-trial 2; left out in explore
--video a.mp4                           | --video a.mp4; left out in explore
--phase zero-shot --arm x               | --arm x; one-step
--env pets/half_cheeta                  | --env pets/half_cheeta; pets/half_cheetah
--env robots/none.py                    | --env robots/none.py; there is no such file
--env robots/none.xml                   | --env robots/none.xml; FILE.py, with a robot(
--arm none.py                           | --arm none.py; or FILE.py:NAME
--arm none.py:bonus                     | --arm none.py:bonus; there is no such file
--tasks x.py                            | --tasks x.py; left out in explore
--list envs                             | --list; is not a flag
--phase zero-shot --name ../x           | --name; '../x'; at most 64
--num-processes 2                       | --num-processes 2; left out, unless
--process-id 0                          | --process-id 0; left out, unless
--coordinator-address auto --process-id 0 | --process-id 0; left out, unless
--coordinator-address host              | address host is; HOST:PORT or auto
--coordinator-address :1                | address :1 is; HOST:PORT or auto
--coordinator-address h:123456          | address h:123456 is; HOST:PORT or auto
--coordinator-address h:1               | --num-processes None; 1 or more
--coordinator-address h:1 --num-processes 0 | --num-processes 0; 1 to 100,000
--coordinator-address h:1 --num-processes 2 | --process-id None; 0 to; (2)
--coordinator-address h:1 --num-processes 2 --process-id 2 | --process-id 2; 0 to; (2)
"""


@pytest.mark.parametrize("case", WRONG.strip().splitlines(), ids=lambda case: case)
def test_bad_usage_is_one_line_before_anything_is_created(fail, out, case):
    flags, _, words = case.partition("|")
    code, line = fail(*(SMOKE if flags.startswith("-") else ()), *flags.split())
    assert code == 2
    assert all(word.strip() in line for word in words.split(";"))
    assert not out.exists()


@pytest.mark.parametrize(
    "name", ["a/b", "..", ".", "", "-x", "/etc/x", "a\0b", "a ", "a\nb", "a" * 300]
)
def test_a_name_is_that_of_one_folder(fail, out, name):
    code, line = fail(*SMOKE, f"--name={name}")
    assert code == 2 and "--name: run" in line and "at most 64" in line
    assert (repr(name) if len(name) < 64 else "aaa...'") in line
    assert not out.exists()


def test_a_name_is_text(fail, out):
    code, line = fail(*SMOKE, "--name", "by\udcffte")
    assert (code, line) == (
        2,
        "error: 'by\\udcffte' is not valid; it must be text in UTF-8.\n",
    )
    assert not out.exists()


def test_a_phase_is_needed(fail):
    code, line = fail("--preset", "smoke")
    assert code == 2 and "--phase is missing" in line and "explore, zero-shot" in line


@pytest.mark.parametrize("phase", ["zero-shot", "finetune"])
def test_later_phases_need_an_explored_run(fail, out, phase):
    code, line = fail("--phase", phase, "--preset", "smoke")
    assert code == 3
    assert str(out / "smoke-epistemic") in line and "--phase explore first" in line
    assert not out.exists()
    explored(out)  # stopped in its first trial
    code, line = fail("--phase", phase, "--preset", "smoke")
    assert code == 3 and "no checkpoint" in line
    assert sorted(path.name for path in out.rglob("*")) == [
        "config.json", "smoke-epistemic",
    ]  # fmt: skip


def test_a_video_is_an_mp4(fail, out):
    explored(out)
    code, line = fail(*LATER, "--video", "a.avi")
    assert code == 2 and "--video a.avi" in line and ".mp4" in line


def test_later_phases_take_the_numbers_of_the_run(out):
    path = explored(out, trial_length=40, seeds=(3, 5))
    config = cli.parse([*LATER, "--out", str(out), "--eval-trials", "2"])
    assert (config.phase, config.eval_trials) == ("zero-shot", 2)
    assert (config.trial_length, config.seeds) == (40, (3, 5))
    assert cli.explored_run(config) == path.parent


def test_a_run_gives_its_numbers_and_nothing_else(out, tmp_path):
    """What a folder that others wrote to may not decide: names, places, a process."""
    elsewhere = tmp_path / "elsewhere"
    path = explored(
        out, chunk_length=5, task="forward", tag="x/../../y", source=elsewhere,
        at_trial=7, video=elsewhere / "a.mp4", debug=True, coordinator_address="h:1",
    )  # fmt: skip
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "out": str(elsewhere), "name": "../x"}))
    config = cli.parse([*LATER, "--out", str(out)])
    smoke = PRESETS["smoke"]
    assert config == dataclasses.replace(
        smoke, phase="zero-shot", out=out, chunk_length=5
    )


def test_a_later_phase_follows_no_link_out_of_the_run(fail, out, tmp_path):
    run, outside = explored(out).parent, tmp_path / "outside"
    step = run / "checkpoints" / "3"
    step.mkdir(parents=True)
    (step / "SHA256SUMS").touch()
    outside.mkdir()
    (run / "zero-shot-003").symlink_to(outside)
    code, line = fail(*LATER)
    assert code == 5 and f"{run / 'zero-shot-003'} is a link, or no folder" in line
    assert list(outside.iterdir()) == []


def test_from_names_a_run_anywhere(out):
    path = explored(out, name="mine", arm="count", num_bits=16)
    config = cli.parse(["--phase", "finetune", "--from", str(path.parent)])
    assert (config.preset, config.arm, config.num_bits) == ("smoke", "count", 16)
    assert cli.explored_run(config) == path.parent


def test_a_run_keeps_its_labels(fail, out):
    path = explored(out, name="mine", arm="count")
    start = ("--phase", "zero-shot", "--from", str(path.parent))
    code, line = fail(*start, "--arm", "random")
    assert code == 2 and "--arm random" in line and "count" in line
    code, line = fail(*start, "--preset", "paper")
    assert code == 2 and "--preset paper" in line and "smoke" in line


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--seeds", "6"), "--seeds (6,) is not valid; it must be (3, 5)"),
        (("--seeds", "5", "3"), "--seeds (5, 3) is not valid"),
        (("--num-bits", "16"), "--num-bits 16 is not valid; it must be 32"),
        (("--num-trials", "4"), "--num-trials 4 is not valid; it must be 3"),
        (("--model.hidden-size", "8"), "--model.hidden-size 8 is not valid"),
        (
            ("--task", "swim"),
            "--task swim is not valid; it must be all, or of forward,",
        ),
        (("--task", "forward,forward"), "each at most once"),
        (
            ("--tasks", "x"),
            "--tasks x is not valid; it must be FILE.py or FILE.py:NAME",
        ),
        (("--tag", "forward"), "--tag forward is not valid; it must be something else"),
        (("--tag", "../x"), "--tag: run '../x' is not a valid name"),
    ],
)
def test_a_model_is_called_what_it_is(fail, out, flags, words):
    explored(out, seeds=(3, 5))
    code, line = fail(*LATER, *flags)
    assert code == 2 and words in line


@pytest.mark.parametrize(
    ("phase", "said", "meant"),
    [
        ("zero-shot", "--planner.horizon 9", ""),
        ("zero-shot", "--distill.num-rounds 9", ""),
        ("finetune", "--eval-trials 9", ""),
        ("finetune", "--critic.num-updates 9", ""),
        ("distill", "--tuning.batch-size 9", ""),
        ("distill", "--critic.hidden-size 9", ""),
        (
            "distill",
            "--critic.batch-size 9",
            "; --distill.critic.batch-size is meant here",
        ),
    ],
)
def test_a_phase_refuses_what_it_would_ignore(fail, out, phase, said, meant):
    explored(out)
    code, line = fail(phase, *LATER[2:], *said.split())
    left_out = f"it must be left out in {phase}, which does not read it{meant}."
    assert code == 2 and line == f"error: {said} is not valid; {left_out}\n"


def test_what_a_phase_ignores_may_be_said_as_it_is(out):
    explored(out)
    said = ("--planner.horizon", "3", "--distill.num-rounds", "2")
    assert cli.parse([*LATER, "--out", str(out), *said]).planner.horizon == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"num_trails": 3}', "unknown entry 'num_trails'"),
        ('{"planner": {"elites": 3}}', "unknown entry 'planner.elites'"),
        ("[]", "config.json: it is [], not an object"),
        ('{"model": null}', "config.json: model is None, not an object"),
        ('{"num_trials": NaN}', "NaN"),
        ("{", "line 1, column 2"),
        ("", "cannot be read"),
    ],
)
def test_a_damaged_config_is_one_line(fail, out, text, words):
    explored(out).write_text(text)
    code, line = fail(*LATER)
    assert code == 3 and words in line


def test_later_phases_are_not_started_on_a_cpu_for_hours(fail, out):
    explored(out)
    huge = ("--task-planner.num-samples", "1000000", "--task-planner.horizon", "1000")
    code, line = fail(*LATER, *huge)
    assert code == 2
    assert "--phase zero-shot of --preset smoke would take about 3 hours" in line
    code, line = fail("distill", *LATER[2:], "--distill.horizon", "100000", *huge[:2])
    assert code == 2 and "--phase distill of --preset smoke would take" in line
    for phase, group in (("zero-shot", "--"), ("distill", "--distill.")):
        critic = (f"{group}critic.num-updates", "10000000")
        rows = (f"{group}critic.batch-size", "65536")
        code, line = fail(phase, *LATER[2:], *critic, *rows)
        assert code == 2 and f"--phase {phase} of --preset smoke would take" in line


_IMAGINED = DistillingConfig(2, 6, critic=ImaginationConfig(1))


@pytest.mark.parametrize(
    ("changes", "planned", "flags"),
    [
        (dict(phase="explore"), "1 trials", "--seeds, --planner.num-samples"),
        (
            dict(phase="zero-shot", task="forward", eval_trials=5),
            "5 trials",
            "--seeds, --eval-trials, --task-planner.num-samples",
        ),
        (dict(phase="finetune"), "4 trials", "--seeds, --task-planner.num-samples"),
        (
            dict(phase="distill", task="forward"),
            "6 trials",
            "--seeds, --eval-trials, --distill.num-trials, --task-planner.num-samples",
        ),
        (
            dict(phase="distill", task="forward", distill=_IMAGINED),
            "6 trials",
            "--seeds, --eval-trials, --distill.num-trials, --distill.critic.batch-size",
        ),
    ],
)
def test_out_of_memory_names_the_flags_of_the_phase(changes, planned, flags):
    config = dataclasses.replace(PRESETS["smoke"], **changes)
    with pytest.raises(OutOfMemoryError) as error, _plain_errors(config):
        raise MemoryError
    assert f"1 seeds x {planned} x 8 samples x 3 particles" in str(error.value)
    assert f"lower one of {flags}, --" in str(error.value)


@pytest.mark.parametrize("said", [(), ("--preset", "paper", "--arm", "best")])
def test_what_an_older_run_lacks_is_that_of_its_preset_and_arm(out, said):
    path = explored(out, name="mine", preset="paper", arm="best")
    data = json.loads(path.read_text())
    del data["refit"]["bootstrap"], data["tuning"], data["distill"]["critic"]
    data["distill"]["num_rounds"] = 10  # its default then
    path.write_text(json.dumps(data))
    flags = ("--phase", "finetune", "--from", str(path.parent), *said)
    config = cli.parse(flags)
    assert not config.refit.bootstrap
    assert config.refit.num_epochs == PRESETS["smoke"].refit.num_epochs  # as recorded
    assert config.tuning == PRESETS["paper"].tuning
    assert config.distill == PRESETS["paper"].distill


def test_laptop_is_the_default():
    config = cli.parse(["--phase", "explore"])
    assert config == dataclasses.replace(PRESETS["laptop"], phase="explore")


def test_the_paper_preset_has_the_numbers_of_the_paper():
    paper = PRESETS["paper"]
    assert (paper.num_trials, paper.trial_length, paper.eval_trials) == (60, 1000, 5)
    assert (paper.model.num_members, paper.model.hidden_size) == (5, 200)
    assert (paper.planner.num_samples, paper.planner.num_elites) == (500, 50)
    assert (paper.planner.horizon, paper.planner.num_particles) == (30, 20)
    assert paper.planner == paper.task_planner
    assert isinstance(paper, Config)


def test_a_policy_is_imagined_at_the_size_of_the_paper_alone():
    imagined = ImaginationConfig(60_000, batch_size=1024, horizon=10, squash=10.0)
    own = {name: config.distill for name, config in PRESETS.items()}
    assert all(x.critic.squash == 10.0 for x in own.values())
    assert (own["paper"].num_rounds, own["paper"].critic) == (0, imagined)
    assert (own["laptop"].num_rounds, own["laptop"].critic.num_updates) == (10, 0)
    assert (own["smoke"].num_rounds, own["smoke"].critic.num_updates) == (2, 0)


def test_best_is_the_paper_with_another_refit_and_search_for_tasks():
    flags = ["--phase", "explore", "--preset", "paper"]
    plain, best = cli.parse(flags), cli.parse([*flags, "--arm", "best"])
    assert best.task_planner.optimizer == "icem"
    assert best.refit.num_epochs == 800
    changed = {name: getattr(best, name) for name in ("arm", "refit", "task_planner")}
    assert best == dataclasses.replace(plain, **changed)
    flags += ["--arm", "best", "--task-planner.horizon", "20"]
    assert cli.parse(flags).task_planner.horizon == 20
    laptop = cli.parse(["--phase", "explore", "--arm", "best"])
    assert laptop.task_planner == PRESETS["laptop"].task_planner


def test_a_robot_brings_numbers_of_its_own_to_the_laptop():
    flags = ["--phase", "explore", "--env", "dmc/cartpole"]
    cartpole, laptop = cli.parse(flags), PRESETS["laptop"]
    assert (cartpole.engine, cartpole.num_trials, cartpole.trial_length) == (
        "mujoco", 16, 250,
    )  # fmt: skip
    assert cartpole.planner == dataclasses.replace(laptop.planner, horizon=25)
    assert cartpole.model == laptop.model
    flags += ["--num-trials", "3", "--engine", "mjx"]
    assert (cli.parse(flags).num_trials, cli.parse(flags).engine) == (3, "mjx")
    paper = cli.parse(
        ["--phase", "explore", "--env", "dmc/cartpole", "--preset", "paper"]
    )
    assert paper.num_trials == 60


def of_c_code(met):
    """Returns what C code raises that called Python and met an exception in it."""
    error = SystemError("<function> returned a result with an exception set")
    error.__cause__ = met
    return error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (MemoryError(), 6, "error: out of memory. 1 seeds x"),
        (RuntimeError("RESOURCE_EXHAUSTED: 9 TB"), 6, "error: out of memory. 1 seeds"),
        (OSError(28, "No space left on device"), 5, "error: cannot go on (No space"),
        (OSError(30, "Read-only", "/x"), 5, "error: cannot use /x (Read-only). Check"),
        (InterruptedRun("SIGTERM"), 75, "stopped: SIGTERM; at most the trial under"),
        (of_c_code(InterruptedRun("SIGTERM")), 75, "stopped: SIGTERM; at most the"),
    ],
)
def test_what_ends_a_run_is_a_line_and_its_status(
    out, capsys, monkeypatch, error, code, said
):
    def explore(config, run, watch):
        raise error

    monkeypatch.setattr(phases, "explore", explore)
    assert main([*SMOKE, "--out", str(out)]) == code
    err = capsys.readouterr().err
    assert err.startswith(said) and err.count("\n") == 1
    found = status.read(out / "smoke-epistemic")
    assert found.state == ("interrupted" if code == 75 else "failed")
    assert err.partition(": ")[2].startswith(found.reason)


def test_a_warning_is_one_line_without_its_source(out, capsys, monkeypatch):
    def explore(config, run, watch):
        warnings.warn("the kernel was built anew", stacklevel=1)

    monkeypatch.setattr(phases, "explore", explore)
    assert main([*SMOKE, "--out", str(out)]) == 0
    first, second = capsys.readouterr().err.splitlines()
    assert first == "warning: the kernel was built anew"
    assert second.startswith("next: ")
