"""The benchmarks run at toy sizes, wait for their results and report whole rows."""

import json
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import (
    agent,
    costs,
    counters,
    env,
    fit,
    model_quality,
    peers,
    plan,
    ratios,
    real_data,
    rollout,
    scale,
    shapes,
    timing,
    trace,
    trial,
    workloads,
)
from benchmarks import all as all_benchmarks
from benchmarks import rows as rows_module
from jaxpets.envs import half_cheetah

ENVIRONMENT = {"benchmark", "date", "device", "cpus", "git", "versions", "sizes"}
TIMING = {"compile_s", "min_ms", "median_ms", "p99_ms", "repeats"}


def check_rows(found, path, results, labels=()):
    """Rows are complete, positive, and the same in the file."""
    written = [json.loads(line) for line in path.read_text().splitlines()]
    assert json.loads(json.dumps(found)) == written[-len(found) :]
    for row in found:
        assert set(row) == ENVIRONMENT | TIMING | {*results, *labels}
        assert row["device"] == jax.devices()[0].device_kind
        assert row["versions"]["jax"] == jax.__version__
        assert 0 < row["min_ms"] <= row["median_ms"] <= row["p99_ms"]
        assert all(row[name] > 0 for name in results)


class Late:
    """A result that arrives 20 ms after one begins to wait for it."""

    waits = 0

    def block_until_ready(self):
        Late.waits += 1
        time.sleep(0.02)
        return self


def test_a_run_ends_when_its_results_are_there():
    assert timing.seconds(lambda: {"nested": (Late(),)}) >= 0.02


def test_compare_runs_both_in_turn_and_waits_for_both():
    order = []
    Late.waits = 0
    result = timing.compare(
        lambda: [order.append("first"), Late(), Late()],
        lambda: [order.append("second"), Late()],
        repeats=3,
    )
    assert order == ["first", "second"] * 4  # once unmeasured
    assert Late.waits == 12
    assert result.first_ms >= 40 and result.second_ms >= 20 and result.ratio > 1
    assert result.repeats == 3


def test_measure_compiles_once_and_counts_repeats():
    traces = []

    def function(x):
        traces.append(x.shape)
        return jnp.sin(x)

    result = timing.measure(function, jnp.ones(4), repeats=5)
    assert traces == [(4,)]
    assert result.repeats == 5 and result.compile_s > 0
    assert 0 < result.min_ms <= result.median_ms


def test_repeat_leaves_the_first_run_out():
    runs = []

    def call():
        runs.append(None)
        time.sleep(0.05 if len(runs) in (1, 4) else 0.0)

    result = timing.repeat(call, 2.0, repeats=3)
    assert len(runs) == 4
    assert result.compile_s == 2.0 and result.repeats == 3
    assert result.min_ms <= result.median_ms < 50.0  # one slow run of three
    assert result.p99_ms > 50.0


def test_work_of_the_paper_is_what_is_published():
    size = workloads.named_size("paper")
    candidates = costs.candidates_per_action(size, "cem")
    assert candidates == 2500
    assert costs.rollout_flops(size, candidates) == 396e9
    # iCEM: 500, 400, 320, 256, 204, with 15 elites kept in each and the last mean.
    assert costs.candidates_per_action(size, "icem") == 1680 + 5 * 15 + 1


def test_plan_over_seeds_and_samples(tmp_path):
    path = tmp_path / "rows.jsonl"
    results = {"ms_per_plan", "gflop", "tflops_per_s"}
    labels = {
        "name": "jaxpets",
        "dtype": "bf16",
        "engine": "scan",
        "arch": "",
        "awaited": True,
        "seeds": 2,
    }
    common = ["--tiny", "--repeats", "2", "--json", str(path)]
    found = plan.main(["--seeds", "2", *common])
    check_rows(found, path, results, labels)
    assert found[0].items() >= labels.items()
    size = workloads.named_size("tiny")
    flops = costs.rollout_flops(size, size.num_samples * size.num_iterations)
    assert found[0]["gflop"] == pytest.approx(2 * flops / 1e9)
    flags = "--seeds 1 --num-samples 8 --horizon 2 --optimizer icem --reward task"
    found = plan.main([*flags.split(), "--precision", "f32", *common])
    check_rows(found, path, results, labels)
    wanted = {"num_samples": 8, "horizon": 2, "optimizer": "icem", "precision": "f32"}
    assert found[0]["sizes"].items() >= wanted.items()


def test_laptop_is_the_preset_of_the_experiments():
    from experiments.presets import PRESETS

    planner = PRESETS["laptop"].planner
    size = workloads.named_size("laptop")
    for name in ("num_samples", "num_elites", "num_iterations", "horizon"):
        assert getattr(size, name) == getattr(planner, name)


def test_ratios(tmp_path):
    path = tmp_path / "rows.jsonl"
    found = ratios.main(["--tiny", "--repeats", "2", "--json", str(path)])
    results = {"first_ms", "second_ms", "ratio", "ratio_of_min", "repeats"}
    assert len(found) == len(path.read_text().splitlines()) == 2
    for row in found:
        assert set(row) == ENVIRONMENT | results
        assert all(row[name] > 0 for name in results)


def test_agent(tmp_path):
    path = tmp_path / "rows.jsonl"
    flags = ["--engine", "scan", "--optimizer", "cem", "--repeats", "3", "--json"]
    (row,) = agent.main(["--tiny", "--num-samples", "9", *flags, str(path)])
    assert row["sizes"]["num_samples"] == 9
    assert json.loads(path.read_text()) == json.loads(json.dumps(row))
    assert 0 < row["plan_ms"] <= row["plan_p99_ms"]
    assert 0 < row["act_ms"] <= row["act_p99_ms"]
    assert 0 < row["copied_ms"] <= row["copied_p99_ms"]


def test_agent_adds_the_median_of_the_differences_of_pairs(monkeypatch):
    seconds = [(5e-3, 1e-3, 2e-3), (3e-3, 2e-3, 2e-3), (4e-3, 3e-3, 8e-3)]
    monkeypatch.setattr(agent.timing, "in_turn", lambda *calls, **options: seconds)
    (row,) = agent.main(["--tiny", "--engine", "scan", "--repeats", "3"])
    assert row["added_ms"] == pytest.approx(1)  # and not 4 - 2
    assert (row["act_ms"], row["plan_ms"]) == pytest.approx((4, 2))
    assert row["copied_ms"] == pytest.approx(2)
    assert row["copied_p99_ms"] == pytest.approx(2 + 0.98 * 6)


def test_agent_says_through_which_memory_an_action_came(monkeypatch):
    device = jax.devices()[0]
    size = workloads.named_size("tiny")
    planner = workloads.planner(size, "f32")
    kinds = {memory.kind for memory in device.addressable_memories()}
    ways = {device.default_memory().kind, "pinned_host"} & kinds
    if device.platform == "cpu":  # which has nothing to copy
        assert agent.memory() == device.default_memory().kind
    for kind in ways:
        monkeypatch.setattr(agent, "memory", lambda kind=kind: kind)
        _, plan_alone, copied = agent.calls(size, planner, "epistemic")
        np.testing.assert_array_equal(plan_alone(), copied())


def test_agent_with_a_policy(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "rows.jsonl"
    (row,) = agent.main(["--policy", "--repeats", "3", "--json", str(path)])
    assert row["sizes"] == {"hidden_size": 256}
    assert json.loads(path.read_text()) == json.loads(json.dumps(row))
    for name in ("onnx", "bound", "jax"):
        assert 0 < row[f"{name}_min_us"] <= row[f"{name}_us"] <= row[f"{name}_p99_us"]
    actions = {name: call() for name, call in agent.policy_calls(8).items()}
    assert actions["onnx"].shape == (1, 6) and np.any(actions["onnx"])
    np.testing.assert_array_equal(actions["bound"], actions["onnx"])
    np.testing.assert_allclose(actions["jax"], actions["onnx"][0], atol=1e-5)
    (tiny,) = agent.main(["--policy", "--tiny", "--repeats", "3"])
    assert tiny["sizes"]["hidden_size"] < 256


def test_agent_with_a_policy_has_no_plan(capsys):
    with pytest.raises(SystemExit):
        agent.main(["--policy", "--means", "--num-samples", "3"])
    assert "no plan that could have --means, --num-samples" in capsys.readouterr().err


def test_rollout_and_fit(tmp_path):
    path = tmp_path / "rows.jsonl"
    common = ["--tiny", "--repeats", "2", "--json", str(path)]
    found = rollout.main(["--precision", "f32", *common])
    check_rows(found, path, {"us_per_step", "tflops_per_s"}, {"arch": ""})
    found = fit.main(["--seeds", "2", "--epochs", "2", *common])
    check_rows(found, path, {"us_per_update"})
    assert found[0]["sizes"]["updates"] == 2 * 4  # 100 rows, the last batch partial
    assert found[0]["sizes"]["engine"] == "scan"
    with pytest.raises(SystemExit, match="no kernel to time: the device is no GPU"):
        fit.main(["--engine", "kernel", *common])


def test_shapes(tmp_path):
    path = tmp_path / "rows.jsonl"
    common = ["--tiny", "--repeats", "2", "--json", str(path), "--precision", "f32"]
    found = shapes.main(["--shape", "gelu", "16 members", *common])
    check_rows(found, path, {"tflops_per_s", "share_of_paper"}, {"arch": ""})
    names = [row["sizes"]["shape"] for row in found]
    assert names == ["paper", "gelu", "16 members"]
    assert found[0]["share_of_paper"] == 1.0
    assert found[1]["sizes"]["activation"] == "gelu"
    (ten,) = shapes.main(["--shape", "paper", "--rollouts", "10", *common])
    one = found[0]["tflops_per_s"] * found[0]["median_ms"]
    assert ten["tflops_per_s"] * ten["median_ms"] == pytest.approx(10 * one)
    # By hand: (24 x 8 + 8 x 8 + 8 x 36) x 2 for each of 4 x 20 x 2 steps.
    shape = shapes.Shape(18, 6, (8, 8), num_samples=4, horizon=2)
    assert shapes._flops(shape) == 2 * (24 * 8 + 8 * 8 + 8 * 36) * 160


@pytest.mark.slow
def test_env_and_trial(tmp_path, monkeypatch):
    monkeypatch.delitem(env.ENGINES, "mjx")  # which test_ratios compiles
    path = tmp_path / "rows.jsonl"
    common = ["--tiny", "--repeats", "2", "--json", str(path)]
    found = env.main(common)
    engines = ["mujoco", "mujoco-loop"]
    assert [row["sizes"]["engine"] for row in found] == engines
    check_rows(found, path, {"ms_per_step", "env_steps_per_s"})
    found = trial.main([*common, "--engine", "mujoco"])
    check_rows(found, path, {"unroll_s", "ms_per_step", "fit_s", "trial_s"})
    row = found[0]
    assert row["trial_s"] == pytest.approx(row["unroll_s"] + row["fit_s"])


def test_the_set_for_a_gpu_is_made_of_valid_flags(monkeypatch, tmp_path):
    seen = []

    def record(run_args, columns, path):
        del run_args, columns
        seen.append(path)
        return []

    # Flags are parsed by the real programs; only the measuring is left out.
    monkeypatch.setattr(rows_module, "report", record)
    path = tmp_path / "rows.jsonl"
    assert all_benchmarks.main(["--tiny", "--json", str(path)]) == ([], [], [])
    assert seen == [path] * len(all_benchmarks.SET)


def test_of_the_set_only_what_a_gpu_never_ran_may_be_left_out(monkeypatch, capsys):
    commands = (plan, "--seeds 1"), (plan, "--engine kernel --seeds 1"), (trace, "")
    monkeypatch.setattr(all_benchmarks, "SET", commands)
    done, by, left_out = all_benchmarks.main(["--tiny", "--repeats", "1"])
    assert [row["engine"] for row in done] == ["scan"] and by == [(plan, "--seeds 1")]
    assert left_out == [
        "benchmarks.plan --engine kernel --seeds 1",
        "benchmarks.trace ",
    ]
    assert "f32 only" in capsys.readouterr().out  # why the kernel could not run
    committed = [
        {**row, "device": device, "sizes": {"engine": engine}}
        for row in done
        for device, engine in (("a", "scan"), ("b", "kernel"))
    ]
    assert all_benchmarks.gone(left_out, committed, "a") == []
    assert all_benchmarks.gone(left_out, committed, "b") == left_out[:1]
    monkeypatch.setattr(all_benchmarks, "SET", ((plan, "--no-such-flag"),))
    with pytest.raises(SystemExit, match="2"):
        all_benchmarks.main(["--tiny"])


@pytest.mark.parametrize(("second", "fails"), [(1.02, []), (2.0, ["kernel"])])
def test_what_is_slower_once_is_timed_once_more(second, fails):
    """The host was slow for a while, or the program is; another is slower by chance."""
    size = workloads.named_size("paper").num_samples
    sizes = {"num_samples": size, "precision": "bf16", "seeds": 1, "plans": 1}

    def row(engine, ms):
        return {"benchmark": "plan", "device": "gpu", "git": "a", "min_ms": ms,
                "median_ms": ms, "sizes": {**sizes, "engine": engine}}  # fmt: skip

    def day(kernel, other):
        return [row("scan", 10.0), row("kernel", kernel), row("sm_90", other)]

    commands = [(plan, name) for name in ("scan", "both", "both")]
    ran = []

    def again(commands):
        ran.extend(commands)
        return all_benchmarks.Outcome(day(second, 2.0), [], [])

    today = all_benchmarks.Outcome(day(1.5, 1.0), commands, [])
    found = all_benchmarks.slower(today, day(1.0, 1.0), again)
    assert [x["sizes"]["engine"] for x in found] == fails
    assert ran == [all_benchmarks.UNIT, (plan, "both")]
    same = all_benchmarks.Outcome(day(1.0, 1.0), commands, [])
    assert all_benchmarks.slower(same, day(1.0, 1.0), again) == [] and len(ran) == 2


def test_rows_of_a_process_name_one_commit(monkeypatch):
    """Though the first is appended to a file that is committed."""
    said = iter(["a\n", "a-dirty\n"])
    monkeypatch.setattr(
        rows_module.subprocess, "check_output", lambda *a, **b: next(said)
    )
    rows_module._commit.cache_clear()
    found = [rows_module.make_row("plan", {})["git"] for _ in range(2)]
    rows_module._commit.cache_clear()
    assert found == ["a", "a"]


def test_a_row_is_on_disk_before_the_next_is_measured(tmp_path):
    path = tmp_path / "rows.jsonl"

    def measured():
        yield rows_module.make_row("first", {})
        assert len(path.read_text().splitlines()) == 1
        yield rows_module.make_row("second", {})

    assert len(rows_module.report(measured(), (), path)) == 2


def test_scores_equal_closed_forms():
    target = np.array([[0.0, 2.0], [2.0, 6.0]])
    same = model_quality.scores(
        np.stack([target + 1.0] * 3), np.full((3, 2, 2), 4.0), target
    )
    expected = 0.5 * (1 / 4 + np.log(2 * np.pi * 4))
    assert same["nll_members"] == pytest.approx(expected)
    assert same["nll_mixture"] == pytest.approx(expected)  # equal members
    assert same["nrmse"] == pytest.approx(np.sqrt((1 + 1 / 4) / 2))  # stds 1 and 2
    one_right = np.stack([target, target + 1e3])
    mixed = model_quality.scores(one_right, np.ones((2, 2, 2)), target)
    # One member of two explains everything: log 2 over two dimensions.
    assert mixed["nll_mixture"] == pytest.approx(
        0.5 * np.log(2 * np.pi) + np.log(2) / 2
    )


def test_model_quality_of_ours_on_real_transitions(tmp_path):
    path, data = tmp_path / "rows.jsonl", tmp_path / "data.npz"
    flags = f"--tiny --ours --seeds 0 --epochs 1 --data {data} --json {path}"
    found = model_quality.main(flags.split())
    again = model_quality.main(flags.split())
    assert found[0]["nrmse"] == again[0]["nrmse"]  # the file has all the data
    results = {"nll_members", "nll_mixture", "nrmse"}
    assert set(found[0]) == ENVIRONMENT | results
    assert all(np.isfinite(found[0][name]) for name in results)

    split = real_data.load(data)
    obs, next_obs = split.train["obs"], split.train["next_obs"]
    np.testing.assert_array_equal(obs[1:], next_obs[:-1])
    np.testing.assert_allclose(obs[0], 0.0, atol=0.006)
    # The first entry is a mean velocity: between those at the ends, but for impacts.
    mean = (obs[:, 9] + next_obs[:, 9]) / 2
    assert np.corrcoef(next_obs[:, 0], mean)[0, 1] > 0.9


def test_preprocessing_for_mbrl_lib_is_ours():
    key = jax.random.key(0)
    drawn = workloads.transitions(key, 7)
    arrays = {name: np.asarray(x) for name, x in drawn._asdict().items()}
    space = half_cheetah.model_space()
    np.testing.assert_allclose(
        real_data.features(arrays["obs"]), space.features(drawn.obs), rtol=1e-6
    )
    np.testing.assert_allclose(
        real_data.targets(arrays),
        space.target(drawn.obs, drawn.next_obs),
        rtol=1e-5,
        atol=1e-5,
    )


def test_bad_usage(capsys):
    for program, flags, message in [
        (plan, "--seeds 0", "must be at least 1"),
        (plan, "--precision f16", "invalid choice"),
        (model_quality, "--tiny", "ask for --ours, --mbrl or both"),
    ]:
        with pytest.raises(SystemExit) as caught:
            program.main(flags.split())
        assert caught.value.code == 2
        assert message in capsys.readouterr().err


def test_a_file_that_rows_cannot_go_to_is_refused_first(tmp_path, capsys, monkeypatch):
    (path := tmp_path / "rows.jsonl").touch()
    monkeypatch.setattr(plan, "run", lambda args: pytest.fail("it measures"))
    for file, message in [
        (tmp_path, "is a folder"),
        (tmp_path / "none" / "rows.jsonl", "there is no folder"),
        (path / "rows.jsonl", "there is no folder"),
        (path, "cannot be written to"),
        (tmp_path / "new.jsonl", "cannot be written to"),
    ]:
        if message == "cannot be written to":  # which root always can
            monkeypatch.setattr(rows_module.os, "access", lambda *_: False)
        with pytest.raises(SystemExit) as caught:
            plan.main(["--tiny", "--json", str(file)])
        assert caught.value.code == 2
        assert message in capsys.readouterr().err
    monkeypatch.undo()
    assert rows_module.appendable(str(path)) == path
    assert rows_module.appendable(str(new := tmp_path / "new.jsonl")) == new
    assert not new.exists()


@pytest.mark.parametrize(
    ("program", "flags", "said", "toys"),
    [
        (fit, "--rows 7", {"rows": 7}, {"rows": 100}),
        (env, "--batch 2 3", {"batch": [2, 3]}, {"batch": [1], "steps": 3}),
        (env, "--steps 50", {"steps": 50}, {"batch": [1], "steps": 3}),
        (trial, "--steps 4 --repeats 3", {"steps": 4, "repeats": 3}, {"rows": 100}),
        (trial, "--rows 9", {"rows": 9}, {"rows": 100, "steps": 3, "size": "tiny"}),
        (plan, "--size paper", {"size": "paper"}, {"size": "tiny"}),
        (peers, "--hydrax .", {}, {"size": ["tiny"]}),
    ],
)
def test_what_is_said_wins_over_toy_sizes(monkeypatch, program, flags, said, toys):
    seen = []
    monkeypatch.setattr(program, "run", lambda args: seen.append(vars(args)) or [])
    for tiny in ["--tiny", *flags.split()], [*flags.split(), "--tiny"]:
        program.main(tiny)
        assert seen.pop().items() >= (toys | said).items()
    program.main(flags.split())
    assert not toys.items() <= seen.pop().items()


@pytest.mark.parametrize(
    ("program", "flags", "message"),
    [
        (plan, "--num-elites 500", "num_samples must be at least num_elites, 500"),
        (plan, "--num-particles 7", "num_particles must be a multiple"),
        (shapes, "--arch volta --precision f32", "arch must be the name of a GPU"),
        (counters, "--read nowhere.csv", "No such file or directory: 'nowhere.csv'"),
        (model_quality, "--ours --data .", "Is a directory: '.'"),
        (model_quality, "--ours --data no/data.npz", "there is no folder"),
    ],
)
def test_sizes_and_files_that_cannot_be_end_with_one_line(
    capsys, program, flags, message
):
    with pytest.raises(SystemExit) as caught:
        program.main(["--tiny", *flags.split()])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and message in line


def test_an_error_of_what_is_timed_is_not_refused(monkeypatch):
    def broken(*_):
        raise ValueError("a bug")

    monkeypatch.setattr(plan.timing, "compile_program", broken)
    with pytest.raises(ValueError, match="a bug"):
        plan.main(["--tiny", "--seeds", "1"])


def test_devices_that_are_not_there_are_left_out_unless_all_are(monkeypatch):
    monkeypatch.setattr(scale, "seeds", lambda size, count, args: count)
    monkeypatch.setattr(scale, "candidates", lambda size, count, args: -count)
    monkeypatch.setattr(scale.rows, "report", lambda found, *_: list(found))
    assert scale.main(["--tiny", "--devices", "1", "999"]) == [1, -1]
    with pytest.raises(SystemExit, match=r"--devices must be at most .*, got 998"):
        scale.main(["--tiny", "--devices", "998", "999"])


def test_a_trace_is_summed_over_the_streams_of_the_gpu():
    def event(name, dur, pid=1, tid=7):
        return {"ph": "X", "name": name, "dur": dur, "pid": pid, "tid": tid, "ts": 0}

    def label(kind, name, pid, **more):
        return {"ph": "M", "name": kind, "pid": pid, "args": {"name": name}, **more}

    events = [
        label("process_name", "/device:GPU:0", 1),
        label("process_name", "/host:CPU", 2),
        label("thread_name", "Stream #7(Compute)", 1, tid=7),
        label("thread_name", "XLA Modules", 1, tid=8),
        label("thread_name", "Stream of thought", 2, tid=7),
        event("rollout_kernel", 20.0),
        event("sort", 1.0),
        event("rollout_kernel", 22.0),
        event("jit_run", 60.0, tid=8),
        event("python", 90.0, pid=2),
        {"ph": "X", "dur": 1.0},
    ]
    found = trace.programs_of({"traceEvents": events})
    assert found == {"rollout_kernel": (42.0, 2), "sort": (1.0, 1)}
    programs = {name: (10 * us, n) for name, (us, n) in found.items()}
    row = trace._row(
        workloads.named_size("tiny"), 4, timing.Timing(1, 2, 2, 2, 3), programs
    )
    assert row["rollout_us"] == 42.0 and row["busy_us"] == 43.0
    assert row["outside"] == pytest.approx(1 / 43)
    assert row["idle"] == pytest.approx(1 - 43 / 200)
    assert row["ms_per_plan"] == pytest.approx(0.05)


def test_where_no_kernel_runs_none_is_timed(monkeypatch):
    device = SimpleNamespace(platform="tpu")
    monkeypatch.setattr(jax, "devices", lambda: [device])
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    text = r"no kernel to time: .* is a tpu, not a"
    with pytest.warns(UserWarning), pytest.raises(SystemExit, match=text):
        plan.main(["--tiny", "--seeds", "1", "--engine", "kernel"])


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the kernel of a CPU")
def test_on_a_cpu_the_kernel_is_timed_but_not_traced():
    size = workloads.named_size("tiny")
    rollout, args = workloads.rollout_work(size, "f32", "kernel")
    assert rollout.uses_kernel
    want = jax.jit(workloads.rollout_fn(size, "f32"))(*args)
    np.testing.assert_allclose(jax.jit(rollout)(*args), want, rtol=1e-5, atol=1e-5)
    with pytest.raises(SystemExit, match="that of a CPU is --precision f32 only"):
        plan.main(["--tiny", "--seeds", "1", "--engine", "kernel"])
    with pytest.raises(SystemExit, match="that of a CPU is --precision f32 only"):
        shapes.main(["--tiny", "--shape", "paper"])
    with pytest.raises(SystemExit, match="there is no GPU whose programs"):
        trace.main(["--tiny", "--seeds", "1"])
