"""A grid of runs: its file, its command lines, and the processes that run them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import runs

from experiments import cli, grid, sweep
from experiments.grid import Job
from experiments.storage import rundir

FILE = """
out = "{out}"
[grid]
arm = ["random", "pink-noise"]
[flags]
preset = "smoke"
engine = "mujoco"
num-trials = 1
model.num-members = 2
planner.num-particles = 2
task-planner.num-particles = 2
training.bootstrap = false
"""
THEN = """
[[where]]
grid.arm = ["random"]
flags.trial-length = 10
flags.planner.no-fused = true
[[then]]
phase = "zero-shot"
task = "forward"
"""
THEN_FINETUNE = """
[[then]]
grid.arm = ["pink-noise"]
phase = "finetune"
"""


@pytest.fixture
def file(tmp_path):
    """A function of the text of a sweep's file, which is below the test's folder."""

    def written(text):
        path = tmp_path / "sweep.toml"
        path.write_text(text.replace("{out}", str(tmp_path / "runs")))
        return path

    return written


def test_every_combination_is_a_run_with_its_flags(file, tmp_path):
    random, pink = grid.jobs(grid.read(file(FILE + THEN + THEN_FINETUNE)))
    explore, perform = random.commands
    assert [command[0] for command in pink.commands[1:]] == ["zero-shot", "finetune"]
    own = ["--out", str(tmp_path / "runs"), "--name", "random"]
    assert random.name == "random" and explore[:5] == ["explore", *own]
    said = " ".join(explore)
    assert "--preset smoke" in said and "--model.num-members 2" in said
    assert "--trial-length 10 --planner.no-fused --arm random" in said
    assert "--training.no-bootstrap" in said
    assert perform == ["zero-shot", *own, "--arm", "random", "--task", "forward"]
    assert "--trial-length" not in pink.commands[0]


def test_lists_are_words_and_the_last_entry_is_the_fastest(file):
    text = 'out = "x"\n[grid]\nseeds = [[0, 1], 2]\nenv = ["dmc/a", "my/b.py:f"]'
    jobs = list(grid.jobs(grid.read(file(text))))
    assert [job.name for job in jobs] == ["0-1-dmc-a", "0-1-b-f", "2-dmc-a", "2-b-f"]
    (explore,) = jobs[1].commands
    assert " ".join(explore[3:]) == "--name 0-1-b-f --seeds 0 1 --env my/b.py:f"


VARIED = """
[[then]]
phase = "zero-shot"
tag = "s"
vary."task-planner.optimizer" = ["cem", "icem"]
vary."task-planner.num-samples" = [8, 16]
[[then]]
phase = "zero-shot"
task = "forward"
vary.pessimism = [0.5]
"""


def test_a_phase_is_varied_and_each_has_its_tag(file):
    random, _ = grid.jobs(grid.read(file(FILE + VARIED)))
    *four, last = [" ".join(command) for command in random.commands[1:]]
    searches = [(name, count) for name in ("cem", "icem") for count in (8, 16)]
    for said, (name, count) in zip(four, searches, strict=True):
        assert f"--tag s-{name}-{count}" in said
        assert f"--task-planner.optimizer {name}" in said
        assert f"--task-planner.num-samples {count}" in said
    assert "--task forward --pessimism 0.5 --tag 0.5" in last


NAMED = """
[[then]]
phase = "zero-shot"
vary.task = ["walk", "stand,walk", "all"]
[[then]]
phase = "zero-shot"
tag = "s"
vary.task = ["walk"]
vary.policy = ["pretrained/best"]
"""


def test_a_tag_of_any_value_is_one_that_the_phase_takes(file, tmp_path, monkeypatch):
    """Neither a task nor what no folder may be called."""
    monkeypatch.chdir(tmp_path)
    text = FILE.replace('"random", "pink-noise"', '"random"')
    text = text.replace("[flags]", '[flags]\nenv = "dmc/walker"')
    (job,) = grid.jobs(grid.read(file(text + NAMED)))
    explored = cli.parse(job.commands[0])
    tags = [cli.parse(command, explored).tag for command in job.commands[1:]]
    wanted = ["task-walk", "task-stand-walk", "task-all", "s-walk-pretrained-best"]
    assert tags == wanted


BASED = """
base = "sweep.toml"
[grid]
arm = ["best"]
seeds = [3]
[flags]
num-trials = 2
planner.horizon = 5
"""


def test_a_file_says_what_differs_from_its_base(file, tmp_path):
    """Entries of the grid and flags one by one, and what it does not say is there."""
    file(FILE + THEN)
    path = tmp_path / "based.toml"
    path.write_text(BASED)
    (job,) = grid.jobs(grid.read(path))
    explore, perform = (" ".join(command) for command in job.commands)
    assert f"--out {tmp_path / 'runs'} --name best-3 " in explore
    assert "--preset smoke --engine mujoco --num-trials 2" in explore
    assert "--planner.num-particles 2" in explore and "--planner.horizon 5" in explore
    assert "--trial-length" not in explore  # which is of random alone
    assert perform.startswith("zero-shot") and perform.endswith("--task forward")
    path.write_text('out = "other"\nthen = []' + BASED)
    (job,) = grid.jobs(grid.read(path))
    assert len(job.commands) == 1 and "--out other" in " ".join(job.commands[0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('base = "none.toml"', "none.toml is no sweep"),
        ('base = "sweep.toml"\nflags = 3', "based.toml is no sweep"),
        ('base = "sweep.toml"\nx = 3', "unknown field `x`"),
        ('base = "based.toml"', "unknown field `base`"),  # not of itself, nor a chain
        ("base = 3", "3 is no sweep"),
    ],
)
def test_a_base_that_cannot_be_one_is_refused(file, tmp_path, capsys, text, words):
    file(FILE)
    path = tmp_path / "based.toml"
    path.write_text(text)
    assert sweep.main([str(path)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "name",
    [
        "dmc20", "dmc20-50k", "dmc20-200k", "study", "study-margin", "study-models",
        "search",
    ],
)  # fmt: skip
def test_the_files_of_tables_are_valid(name, monkeypatch):
    """Flags and tags, of every run and phase; --list would read the robots as well."""
    monkeypatch.chdir(Path(sweep.__file__).parents[1])  # where their commands are given
    jobs = list(grid.jobs(grid.read(Path("experiments/sweeps") / f"{name}.toml")))
    for job in jobs[:: max(1, len(jobs) // 3)]:
        explored = cli.parse(job.commands[0])
        found = [cli.parse(command, explored) for command in job.commands[1:]]
        folders = [cli.variant(config, explored.num_trials) for config in found]
        assert len(set(folders)) == len(folders)
        assert all(rundir.check_name(folder) is None for folder in folders)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "missing required field `out`"),
        ("out =", "Invalid value"),
        (FILE + "x = 1\n[other]\n", "unknown field `other`"),
        (FILE.replace('["random", "pink-noise"]', "[]"), "length >= 1"),
        (FILE.replace('["random", "pink-noise"]', "3"), "$.grid[...]"),
        (FILE.replace("preset", '"pre set"'), "pre set = 'smoke' is not valid"),
        (FILE.replace("num-trials = 1", "num-trials = 1e"), "sweep.toml is no sweep"),
        (FILE.replace("num-trials = 1", "num-trials = 2020-01-01"), "num-trials"),
        (FILE.replace("num-trials = 1", "num-trials = 0"), "--num-trials 0"),
        (FILE.replace("num-trials", "num-trails"), "Perhaps --num-trials?"),
        (FILE.replace("pink-noise", "random"), "two of its runs have one name"),
        (
            FILE.replace("num-trials = 1", 'out = "x"'),
            "out = 'x' is not valid as a flag",
        ),
        (FILE + '[[then]]\nphase = "zero-shot"\nname = "x"', "name = 'x' is not valid"),
        (FILE.replace('["random', '["../x/.py'), "--arm"),
        (FILE + '[[then]]\nphase = "explore"', "then.phase 'explore'"),
        (FILE + '[[then]]\nphase = "zero-shot"\neval-trials = 0', "--eval-trials 0"),
        (FILE + '[[then]]\nphase = "zero-shot"\ngrid.arm = 3', "then.grid"),
        (FILE + '[[then]]\nphase = "zero-shot"\nvary.task = []', "then.vary"),
        (FILE + '[[then]]\nphase = "zero-shot"\ngrid.arms = ["random"]', "grid.arms"),
        (FILE + "[[where]]\ngrid.envv = [1]\nflags.num-trials = 2", "grid.envv"),
        (
            FILE + '[[then]]\nphase = "zero-shot"\n' * 2,
            "zero-shot-001. Give one of them a tag",
        ),
    ],
)
def test_what_is_not_valid_is_refused_before_anything_runs(
    file, tmp_path, capsys, text, words
):
    assert sweep.main([str(file(text))]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_run_that_fails_does_not_keep_the_others(file, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(grid.__file__).parents[1]))
    path, runs = file(FILE), tmp_path / "runs"
    runs.mkdir()
    (runs / "random").touch()  # where a folder should be
    assert sweep.main([str(path), "--jobs", "2"]) == 5
    said = capsys.readouterr().out
    assert "random: exit code 5, see" in said and "pink-noise: complete" in said
    assert "random" in (runs / "logs" / "random.txt").read_text()
    assert sweep.main([str(path), "--list"]) == 0
    assert "random  left\npink-noise  complete" in capsys.readouterr().out
    assert sweep.main([str(path), "--only", "pink"]) == 0
    assert capsys.readouterr().out == "1 runs, 1 of them complete\n"


def test_a_name_that_no_run_has(file, capsys):
    assert sweep.main([str(file(FILE)), "--only", "nope", "--list"]) == 2
    said = capsys.readouterr()
    assert "--only nope is not valid; no run is called so." in said.out + said.err


def test_a_run_has_its_phases_in_turn(file, monkeypatch, capsys):
    calls = []
    monkeypatch.setattr(sweep.run, "main", lambda argv: calls.append(argv[0]) or 4)
    path = file(FILE + THEN)
    assert sweep.main([str(path), "--run", "random"]) == 4
    assert calls == ["explore"]
    monkeypatch.setattr(sweep.run, "main", lambda argv: calls.append(argv[0]))
    assert sweep.main([str(path), "--run", "random"]) == 0
    assert calls == ["explore", "explore", "zero-shot"]
    assert sweep.main([str(path), "--run", "x"]) == 2
    assert "--run x is not valid" in capsys.readouterr().err


SLEEPS = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
open(sys.argv[1], "w").close()
time.sleep(60)
"""


HERE = """
import sys
from pathlib import Path
from experiments import grid, sweep
from experiments.grid import Job
table, folder = grid.read(Path(sys.argv[1])), Path(sys.argv[2])
left = [Job(str(folder / name), []) for name in "abc"]
sys.exit(sweep._here(table, left, [sys.executable, "-c", sys.argv[3]], 1))
"""


@pytest.mark.parametrize("whom", [os.kill, os.killpg], ids=["sweep", "terminal"])
def test_a_signal_stops_those_that_run_and_starts_no_other(file, tmp_path, whom):
    """They end as a run that is interrupted does; a terminal signals all of a group."""
    own = tmp_path / "started"
    own.mkdir()
    env = os.environ | {"PYTHONPATH": str(Path(grid.__file__).parents[1])}
    arguments = ["-c", HERE, str(file(FILE)), str(own), SLEEPS]
    process = subprocess.Popen(
        [sys.executable, *arguments], env=env, start_new_session=True,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not (own / "a").exists() and process.poll() is None:
        time.sleep(0.05)
    whom(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 75 and "exit code 75, see" in said
    assert not (own / "b").exists() and not (own / "c").exists()


ORPHAN = """
import sys, time
from experiments import signals, sweep
from experiments.errors import InterruptedRun
sweep._end_with(int(sys.argv[3]))
with signals.stoppable():
    try:
        open(sys.argv[1], "w").close()
        time.sleep(60)
    except InterruptedRun:
        time.sleep(0.5)  # in which a second signal would end it
        open(sys.argv[1] + "-stopped", "w").close()
"""
# Under nohup, and with many threads, as the end of each may signal the run.
NOHUP = """
import signal, threading, time
signal.signal(signal.SIGHUP, signal.SIG_IGN)
for _ in range(50):
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the run")
def test_a_sweep_that_is_killed_stops_its_run(file, tmp_path):
    """As any signal does, in its own time."""
    own = tmp_path / "started"
    own.mkdir()
    env = os.environ | {"PYTHONPATH": str(Path(grid.__file__).parents[1])}
    arguments = ["-c", NOHUP + HERE, str(file(FILE)), str(own), ORPHAN]
    with subprocess.Popen([sys.executable, *arguments], env=env) as process:
        while not (own / "a").exists() and process.poll() is None:
            time.sleep(0.05)
        process.kill()
    late = time.monotonic() + 30  # it takes none; a run that goes on takes 60
    while not (own / "a-stopped").exists() and time.monotonic() < late:
        time.sleep(0.05)
    assert (own / "a-stopped").exists()


def test_a_run_ends_with_the_sweep_that_started_it(file, monkeypatch, capsys):
    known = []
    monkeypatch.setattr(sweep, "_end_with", known.append)
    monkeypatch.setattr(sweep.run, "main", lambda argv: 0)
    command = [str(file(FILE)), "--run", "random"]
    assert sweep.main(command) == 0 and not known  # by hand it outlives a shell
    assert sweep.main([*command, "--parent", "5"]) == 0 and known == [5]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the run")
def test_a_run_whose_sweep_is_gone_already_does_not_begin(file):
    """In a process of its own, whose parent is this one and not the first of all."""
    env = os.environ | {"PYTHONPATH": str(Path(grid.__file__).parents[1])}
    command = [sys.executable, "-m", "experiments.sweep", str(file(FILE))]
    command += ["--run", "random", "--parent", "1"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (75, "")
    assert done.stderr.startswith("stopped: the sweep that has started it is gone; ")


def test_a_sweep_says_the_error_of_a_run(file, tmp_path, capsys):
    """Though another process writes to the same log, which has errors of before."""
    code = """if 1:
        import sys
        print("error: x is in use by pid 7.\\n5/20 of another", file=sys.stderr)
        sys.exit(int(sys.argv[1]))
    """
    table, command = grid.read(file(FILE)), [sys.executable, "-c", code]
    (tmp_path / "runs" / "logs").mkdir(parents=True)
    (tmp_path / "runs" / "logs" / "3.txt").write_text("error: of an earlier start\n")
    left = [Job(name, []) for name in ("3", "75", "1")]
    assert sweep._here(table, left, command, 1) == 3
    locked, stopped, bug = capsys.readouterr().out.splitlines()
    assert locked.startswith("3: exit code 3, see ")
    assert locked.endswith(" s  error: x is in use by pid 7.")
    assert stopped.endswith(" s") and bug.endswith(" s")


def test_a_run_that_cannot_be_started_does_not_keep_the_others(file, tmp_path, capsys):
    table = grid.read(file(FILE))
    logs = tmp_path / "runs" / "logs"
    (logs / "bad.txt").mkdir(parents=True)
    left = [Job(name, []) for name in ("bad", "good")]
    assert sweep._here(table, left, [sys.executable, "-c", ""], 1) == 5
    said = capsys.readouterr().out
    assert "bad.txt" in said and "good: complete" in said
    missing = [str(tmp_path / "missing")]
    assert sweep._here(table, left[1:], missing, 1) == 5
    assert "cannot start good" in capsys.readouterr().out


DONE = """
out = "{out}"
[grid]
arm = ["epistemic"]
[flags]
preset = "smoke"
engine = "mujoco"
[[then]]
phase = "zero-shot"
refit.num-epochs = 1
refit.batch-size = 16
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "state"),
    [
        ("", "", "complete"),
        ("smoke", "smoke", "complete"),
        ("[[then]]", "num-trials = 4\n[[then]]", "left"),
        ("[[then]]", "num-trials = 2\n[[then]]\nat-trial = 2", "left"),
        ("[[then]]", "training.batch-size = 9\n[[then]]", "left"),
        ("num-epochs = 1", "num-epochs = 2", "left"),
        ("[[then]]", '[[then]]\nphase = "zero-shot"\ntag = "more"\n[[then]]', "left"),
        ("[[then]]", "[[then]]\nat-trial = 0", "left"),
    ],
)
def test_a_run_is_complete_if_it_is_what_the_file_says(
    performed_once, file, tmp_path, capsys, old, new, state
):
    runs.copied(performed_once, tmp_path / "copy")
    (tmp_path / "runs").mkdir()
    (tmp_path / "copy" / performed_once.name).rename(tmp_path / "runs" / "epistemic")
    assert sweep.main([str(file(DONE.replace(old, new, 1))), "--list"]) == 0
    assert f"epistemic  {state}" in capsys.readouterr().out


def test_phase_2_of_fewer_trials_than_were_explored_is_refused(
    performed_once, file, tmp_path, capsys
):
    runs.copied(performed_once, tmp_path / "copy")
    (tmp_path / "runs").mkdir()
    (tmp_path / "copy" / performed_once.name).rename(tmp_path / "runs" / "epistemic")
    text = DONE.replace("[[then]]", "num-trials = 2\n[[then]]")
    assert sweep.main([str(file(text)), "--list"]) == 2
    said = capsys.readouterr().err
    assert "num-trials is 2, but" in said and "has explored 3" in said
    assert "at-trial = 2" in said


def test_a_run_whose_status_is_torn_is_left(performed_once, file, tmp_path, capsys):
    runs.copied(performed_once, tmp_path / "copy")
    (tmp_path / "runs").mkdir()
    run = (tmp_path / "copy" / performed_once.name).rename(tmp_path / "runs/epistemic")
    (run / "status.json").write_text('{"state": "run')
    assert sweep.main([str(file(DONE)), "--list"]) == 0
    assert "epistemic  left" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('task = "forwrd"', "--task forwrd is not valid"),
        ("critic.acts = true", "--critic.acts"),
    ],
)
def test_what_comes_later_is_refused_at_once(file, capsys, line, words):
    assert sweep.main([str(file(DONE + line)), "--list"]) == 2
    assert words in capsys.readouterr().err


def test_runs_share_the_gpus(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    monkeypatch.delenv("XLA_PYTHON_CLIENT_MEM_FRACTION", raising=False)
    assert sweep._gpus() == ["2", "5"]
    own = sweep._environment("5", 3)
    assert own["CUDA_VISIBLE_DEVICES"] == "5"
    assert own["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.30"
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in sweep._environment("2", 1)


ON_A_CLUSTER = """
import sys
from pathlib import Path
import msgspec
from experiments import grid, sweep
from experiments.errors import UsageError
from experiments.grid import Job
table = grid.read(Path(sys.argv[1]))
code = "import sys; sys.exit(3 * (sys.argv[1] == 'damaged'))"
command, left = [sys.executable, "-c", code], [Job("fine", []), Job("damaged", [])]
print(sweep._on_slurm(table, left, command, 2, cluster="local"))
job = sweep._Phases(command)
print(job.checkpoint().function.command == command)
unknown = msgspec.structs.replace(table, slurm={"fly": 1})
for wrong, cluster in ((table, "slurm"), (unknown, "local")):
    try:
        sweep._on_slurm(wrong, left, command, None, cluster)
    except UsageError as error:
        print(error)
"""


def test_a_cluster_runs_each_as_a_job(file):
    """On submitit's cluster of one machine; it takes the handlers of logging away."""
    path = file(FILE + "[slurm]\ntimeout_min = 2")
    env = os.environ | {"PYTHONPATH": str(Path(grid.__file__).parents[1])}
    command = [sys.executable, "-c", ON_A_CLUSTER, str(path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    fine, damaged, code, same, slurm, fly = done.stdout.splitlines()
    assert fine == "fine: complete" and damaged.startswith("damaged: exit code 3, see")
    assert (code, same) == ("3", "True")
    assert slurm.startswith("--slurm is not valid here:") and "srun" in slurm
    assert fly.startswith("--slurm is not valid here:") and "fly" in fly
