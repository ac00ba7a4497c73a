"""The command line of the experiments: what it takes, and how it refuses the rest."""

import dataclasses
import json

import pytest

from experiments import cli
from experiments.config import Config
from experiments.errors import CheckpointError, OutOfMemoryError
from experiments.presets import PRESETS
from experiments.run import _plain_errors, main

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
    path.write_text(json.dumps(cli.to_json(config)))
    return path


EPOCHS = ["--tuning.num-epochs 0", "1 to 10,000"]
TRIALS = ["--num-trials", "1 to 100,000"]
ELITES = ["--planner.num-elites", "9", "2 to --planner.num-samples (8)"]
AT = ("--coordinator-address", "host:1")
AUTO = (AT[0], "auto")
RATE = ["--training.learning-rate", "1e-09 to 1.0"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), ["--phase", "explore,zero-shot,finetune,report"]),
        (("--phase",), ["--phase"]),
        (("--phase", "fly"), ["--phase", "'fly'", "'finetune'"]),
        ((*SMOKE, "--preset", "huge"), ["--preset", "huge", "paper, laptop, smoke"]),
        ((*SMOKE, "--preset"), ["--preset", "paper, laptop, smoke"]),
        ((*SMOKE, "--arm", "x"), ["--arm", "'x'", "'one-step'"]),
        ((*SMOKE, "--engine", "warp"), ["--engine", "'warp'", "'mujoco'"]),
        ((*SMOKE, "--task", "swim"), ["--task", "'swim'", "'back-flip'"]),
        ((*LATER, "--arm", "x"), ["--arm", "'x'", "'one-step'"]),
        ((*SMOKE, "--num-trails", "3"), ["--num-trails", "Perhaps", "--num-trials"]),
        ((*SMOKE, "--num_trails", "3"), ["--num_trails", "Perhaps", "--num-trials"]),
        ((*SMOKE, "extra"), ["extra"]),
        *[((*SMOKE, "--num-trials", v), [v, *TRIALS]) for v in ("0", "-1", "100001")],
        *[
            ((*SMOKE, "--num-trials", v), [v, *TRIALS])
            for v in ("abc", "nan", "inf", "1e9", "2.5")
        ],
        ((*SMOKE, "--num-trials"), TRIALS[:1]),
        ((*SMOKE, "--tuning.num-epochs", "0"), EPOCHS),
        ((*SMOKE, "--num_trials=0"), TRIALS),
        ((*SMOKE, "--seeds"), ["--seeds", "one or more different"]),
        ((*SMOKE, "--seeds", "-1"), ["--seeds", "-1", "0 to 4294967295"]),
        ((*SMOKE, "--seeds", "4294967296"), ["--seeds 4294967296", "0 to 4294967295"]),
        ((*SMOKE, "--seeds", "0", "0"), ["--seeds", "(0, 0)", "different"]),
        ((*SMOKE, "--planner.num-elites", "9"), ELITES),
        ((*SMOKE, "--planner.num-elites", "1"), [ELITES[0], "1", "2 to 1,000,000"]),
        (
            (*SMOKE, "--task-planner.num-particles", "4"),
            ["--task-planner.num-particles 4", "multiple", "(3)"],
        ),
        ((*SMOKE, "--planner.optimizer", "sgd"), ["--planner.optimizer", "'icem'"]),
        (
            (*SMOKE, "--model.num-members", "1"),
            ["--model.num-members 1", "2 or more for --arm epistemic"],
        ),
        (
            (*SMOKE, "--arm", "random", "--model.num-members", "1", "--pessimism", "1"),
            ["--pessimism 1.0", "0 with one member"],
        ),
        ((*SMOKE, "--random-trials", "4"), ["--random-trials 4", "--num-trials (3)"]),
        ((*SMOKE, "--chunk-length", "7"), ["--chunk-length 7", "divisor", "(20)"]),
        ((*SMOKE, "--num-bits", "33"), ["--num-bits 33", "1 to 32"]),
        *[
            ((*SMOKE, "--training.learning-rate", v), [v, *RATE])
            for v in ("0", "-1", "nan", "inf", "x")
        ],
        ((*SMOKE, "--model.state-margin", "nan"), ["--model.state-margin", "nan"]),
        ((*SMOKE, "--model.state-margin", "inf"), ["--model.state-margin", "inf"]),
        *[
            ((*SMOKE, f"--name={name}"), ["--name", repr(name), "letters, digits"])
            for name in ("a/b", "..", ".", "", "-x", "/etc/x", "a\0b", "a ", "a\nb")
        ],
        ((*SMOKE, "--name", "a" * 300), ["--name", "aaa...", "at most 64"]),
        ((*LATER, "--name", "../x"), ["--name", "'../x'", "at most 64"]),
        ((*SMOKE, "--video", "a.mp4"), ["--video a.mp4", "zero-shot or finetune"]),
        ((*SMOKE, "--at-trial", "2"), ["--at-trial 2", "zero-shot and finetune"]),
        ((*SMOKE, "--tag", "x"), ["--tag x", "zero-shot and finetune"]),
        ((*SMOKE, "--task", "forward"), ["--task forward", "zero-shot and finetune"]),
        ((*SMOKE, "--from", "there"), ["--from there", "zero-shot and finetune"]),
        (
            ("--phase", "explore", "--preset", "paper"),
            ["--preset paper", "hours", "--allow-cpu"],
        ),
        (("--phase", "report"), ["metrics.jsonl"]),
        ((*SMOKE, "--num-processes", "2"), ["--num-processes 2", "left out, unless"]),
        ((*SMOKE, "--process-id", "0"), ["--process-id 0", "left out, unless"]),
        ((*SMOKE, *AUTO, "--num-processes", "2"), ["--num-processes 2", "left out"]),
        ((*SMOKE, *AT[:1], "host"), [AT[0], "host is not", "HOST:PORT or auto"]),
        ((*SMOKE, *AT[:1], ":1"), [AT[0], "HOST:PORT or auto"]),
        ((*SMOKE, *AT[:1], "h:123456"), [AT[0], "HOST:PORT or auto"]),
        ((*SMOKE, *AT), ["--num-processes None", "1 or more", AT[0]]),
        ((*SMOKE, *AT, "--num-processes", "x"), ["--num-processes", "1 to 100,000"]),
        *[
            (
                (*SMOKE, *AT, "--num-processes", "2", *own),
                [" ".join(own), "0 to", "(2)"],
            )
            for own in ((), ("--process-id", "2"), ("--process-id", "-1"))
        ],
        ((*SMOKE, *AT, "--num-processes", "0"), ["--num-processes 0", "1 or more"]),
        (("--phase", "report", *AUTO), ["--coordinator-address auto", "in report"]),
    ],
    ids=str,
)
def test_bad_usage_is_one_line_before_anything_is_created(fail, out, flags, words):
    code, line = fail(*flags)
    assert code == 2
    assert all(word in line for word in words)
    assert not out.exists()


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
        (("--tag", "forward"), "--tag forward is not valid; it must not be a task"),
        (("--tag", "../x"), "--tag: run '../x' is not a valid name"),
    ],
)
def test_a_model_is_called_what_it_is(fail, out, flags, words):
    explored(out, seeds=(3, 5))
    code, line = fail(*LATER, *flags)
    assert code == 2 and words in line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"num_trails": 3}', "unknown entry 'num_trails'"),
        ('{"planner": {"elites": 3}}', "unknown entry 'elites'"),
        ('{"num_trials": NaN}', "NaN"),
        ("{", "line 1, column 2"),
        ("", "cannot be read"),
    ],
)
def test_a_damaged_config_is_one_line(fail, out, text, words):
    explored(out).write_text(text)
    code, line = fail(*LATER)
    assert code == 3 and words in line


@pytest.mark.parametrize("preset", PRESETS)
def test_configs_survive_json(preset, tmp_path):
    config = dataclasses.replace(
        PRESETS[preset], phase="finetune", seeds=(1, 2**32 - 1), video=tmp_path / "a"
    )
    data = json.loads(json.dumps(cli.to_json(config)))
    default = dataclasses.replace(PRESETS["paper"], phase="explore", num_trials=7)
    assert cli.from_json(data, default) == config
    del data["num_trials"], data["planner"]["horizon"]
    older = cli.from_json(data, default)
    assert older.num_trials == 7 and older.planner.horizon == default.planner.horizon
    with pytest.raises(CheckpointError, match="unknown entry 'colour'"):
        cli.from_json({**data, "colour": 1}, default)


def test_differences_name_the_field():
    old = cli.to_json(dataclasses.replace(PRESETS["smoke"], phase="explore"))
    new = json.loads(json.dumps(old))
    default = cli.to_json(PRESETS["paper"])
    assert cli.differences(old, new, (), default) == []
    new["planner"]["horizon"], new["seeds"], new["debug"] = 5, [1], True
    assert cli.differences(old, new, ("debug",), default) == [
        "planner.horizon: 3 (there) vs 5 (now)",
        "seeds: [0] (there) vs [1] (now)",
    ]


def test_later_phases_are_not_started_on_a_cpu_for_hours(fail, out):
    explored(out)
    huge = ("--task-planner.num-samples", "1000000", "--task-planner.horizon", "1000")
    code, line = fail(*LATER, *huge)
    assert code == 2
    assert "--phase zero-shot of --preset smoke would take about 3 hours" in line


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
    del data["refit"]["bootstrap"], data["tuning"]
    path.write_text(json.dumps(data))
    flags = ("--phase", "finetune", "--from", str(path.parent), *said)
    config = cli.parse(flags)
    assert not config.refit.bootstrap
    assert config.refit.num_epochs == PRESETS["smoke"].refit.num_epochs  # as recorded
    assert config.tuning == PRESETS["paper"].tuning


def test_what_an_older_version_did_not_write_was_the_default():
    default = cli.to_json(dataclasses.replace(PRESETS["paper"], phase="explore"))
    old = json.loads(json.dumps(default))
    del old["refit"]["bootstrap"], old["pessimism"], old["tuning"]
    assert cli.differences(old, default, (), default) == []
    new = {**default, "pessimism": 3.0}
    new["refit"] = {**default["refit"], "bootstrap": False}
    assert cli.differences(old, new, (), default) == [
        "pessimism: 0.0 (there) vs 3.0 (now)",
        "refit.bootstrap: True (there) vs False (now)",
    ]
    # What only the older one has is nothing this version could do differently.
    assert cli.differences({**old, "colour": 1}, default, (), default) == []


@pytest.mark.parametrize("flags", [(), SMOKE, LATER])
def test_help_explains_every_flag(flags, out, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*flags, "--out", str(out), "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out

    def check(config, prefix):
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            name = {"source": "from"}.get(field.name, field.name)
            flag = prefix + name.replace("_", "-")
            if dataclasses.is_dataclass(value):
                check(value, f"{flag}.")
            else:
                assert flag in text

    check(PRESETS["smoke"], "--")
    assert "experiments.run" in text


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
