"""What the figure of the plan's times draws, from rows whose numbers are known."""

import json
import re

import matplotlib.image
import pytest

from benchmarks import figure, plan

H200 = "NVIDIA H200"
PAPER = {
    "num_samples": 500,
    "num_elites": 50,
    "num_iterations": 5,
    "horizon": 30,
    "num_particles": 20,
    "num_members": 5,
    "hidden_sizes": [200] * 4,
    "precision": "bf16",
    "seeds": 1,
    "optimizer": "cem",
    "reward": "epistemic",
}


def row(ms, device=H200, benchmark="plan", **sizes):
    return {
        "benchmark": benchmark,
        "device": device,
        "sizes": PAPER | sizes,
        "median_ms": ms,
    }


def peer(name, ms, seeds=1, device=H200):
    return {"name": name, "device": device, "seeds": seeds, "ms_per_plan": ms}


ROWS = [
    row(10.0),  # from before there were engines
    row(80.0, seeds=16, engine="scan"),
    row(24.0, seeds=4, engine="scan"),
    row(160.0, num_samples=8000, num_elites=800, engine="scan"),
    row(2.0, engine="kernel"),
    row(16.0, seeds=16, engine="kernel"),
    row(0.5, num_samples=125, engine="kernel"),
    # None of these belongs to the figure.
    row(1.0, precision="tf32"),
    row(1.0, optimizer="icem"),
    row(1.0, horizon=15),
    row(1.0, hidden_sizes=[64, 64]),
    row(1.0, chunk_size=50),
    row(1.0, plans=10),
    row(1.0, benchmark="rollout"),
    row(1.0, seeds=4, num_samples=125),
]
PEERS = [
    peer("slow", 300.0),
    peer("slow", 200.0),
    peer("slow", 250.0),
    peer("batched", 50.0),
    peer("batched", 40.0, seeds=16),
    peer("elsewhere", 1.0, device="cpu"),
]


def lines(axes):
    """Label to points, of every line."""
    found = {}
    for line in axes.get_lines():
        points = list(zip(*line.get_data(), strict=True))
        found.setdefault(line.get_label(), []).extend(points)
    return found


def test_lines_hold_the_time_of_one_plan():
    left, right = figure.draw(ROWS, PEERS).axes
    over_seeds, over_samples = lines(left), lines(right)
    assert over_seeds["jaxpets, scan"] == [(1, 10.0), (4, 6.0), (16, 5.0)]
    assert over_seeds["jaxpets, kernel"] == [(1, 2.0), (16, 1.0)]
    assert over_samples["jaxpets, scan"] == [(500, 10.0), (8000, 160.0)]
    assert over_samples["jaxpets, kernel"] == [(125, 0.5), (500, 2.0)]
    for axes in (left, right):
        assert axes.get_xscale() == axes.get_yscale() == "log"


def test_peers_are_markers_at_their_best():
    left, right = figure.draw(ROWS, PEERS).axes
    assert lines(left)["slow"] == [(1, 200.0)]
    assert sorted(lines(left)["batched"]) == [(1, 50.0), (16, 40.0)]
    assert lines(right)["batched"] == [(500, 50.0)]
    marks = {}
    for line in (*left.get_lines(), *right.get_lines()):
        if line.get_label() in ("slow", "batched"):
            assert line.get_linestyle() == "None"
            marks.setdefault(line.get_label(), set()).add(line.get_marker())
    assert all(len(each) == 1 for each in marks.values())
    assert marks["slow"] != marks["batched"]
    for axes in (left, right):
        assert "elsewhere" not in lines(axes)


def test_the_floor_is_the_operations_at_the_peak():
    left, right = figure.draw(ROWS, PEERS).axes
    paper = 396e9 / 989e12 * 1e3  # ms
    want = [(1, paper), (16, paper)]
    assert lines(left)[figure.FLOOR] == [pytest.approx(each) for each in want]
    want = [(125, paper / 4), (8000, paper * 16)]
    assert lines(right)[figure.FLOOR] == [pytest.approx(each) for each in want]


def test_no_floor_where_the_peak_is_unknown():
    rows = [row(3000.0, device="cpu"), row(1.0, device="abacus", horizon=15)]
    left, right = figure.draw(rows, PEERS).axes
    assert set(lines(left)) == {"jaxpets, scan", "elsewhere"}
    assert lines(right) == lines(left) | {
        "jaxpets, scan": [(500, 3000.0)],
        "elsewhere": [(500, 1.0)],
    }


def test_the_last_of_equal_rows_counts():
    left, _ = figure.draw([row(10.0), row(9.0, engine="scan")], []).axes
    assert lines(left)["jaxpets, scan"] == [(1, 9.0)]


@pytest.mark.parametrize("rows", [[], [row(1.0), row(1.0, device="cpu")]])
def test_rows_must_be_of_one_device(rows):
    with pytest.raises(ValueError, match="one device"):
        figure.draw(rows, PEERS)


def written(path, rows):
    path.write_text("".join(json.dumps(each) + "\n" for each in rows))
    return path


def test_program_draws_the_committed_peers(tmp_path):
    first = written(tmp_path / "a.jsonl", ROWS[:3])
    second = written(tmp_path / "b.jsonl", ROWS[3:])
    target = tmp_path / "plan.svg"
    flags = [str(first), str(second), "--out", str(target)]
    left, _ = figure.main(flags).axes
    drawn = lines(left)
    assert drawn["jaxpets, scan"] == [(1, 10.0), (4, 6.0), (16, 5.0)]
    peers = {"mbrl-lib", "handful-of-trials-pytorch", "opax", "mbrl-jax"}
    assert peers < set(drawn)
    assert drawn["mbrl-lib"] == [(1, 81.7)]
    text = target.read_text()
    assert "<svg" in text and not re.search(r"<dc:date>|Matplotlib v", text)
    again = tmp_path / "again.svg"
    figure.main([str(first), str(second), "--out", str(again)])
    assert again.read_text() == text


def test_program_writes_other_formats_too(tmp_path):
    rows, target = written(tmp_path / "rows.jsonl", ROWS), tmp_path / "plan.png"
    figure.main([str(rows), "--out", str(target)])
    pixels = matplotlib.image.imread(target)
    assert pixels.shape[0] > 100 and pixels.std() > 0


def test_bad_usage(tmp_path, capsys):
    empty = written(tmp_path / "rows.jsonl", [])
    for path, message in [
        (empty, "one device"),
        (empty, "there are no rows of plans by CEM in bf16"),
        (tmp_path / "no", "No such file"),
    ]:
        with pytest.raises(SystemExit) as caught:
            figure.main([str(path), "--out", str(tmp_path / "plan.svg")])
        assert caught.value.code == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        figure.main([str(empty), "--out", str(tmp_path / "none" / "plan.svg")])
    assert caught.value.code == 2
    assert "argument --out: there is no folder" in capsys.readouterr().err


def test_peers_say_what_was_measured():
    rows = figure.read([figure.PEERS])
    fields = {"name", "device", "dtype", "seeds", "engine", "ms_per_plan", "versions"}
    for each in rows:
        assert set(each) == fields | {"date", "source"}
        assert each["ms_per_plan"] > 0 and "median" in each["source"]
    assert len({json.dumps(each) for each in rows}) == len(rows)


def test_rows_of_the_benchmark_are_what_is_drawn(tmp_path, monkeypatch):
    """In chunks, and beside bare products; what is not the paper is not drawn."""
    path = tmp_path / "rows.jsonl"
    flags = f"--tiny --seeds 2 --repeats 2 --gemm --json {path}".split()
    plan.main(flags)
    plan.main([*flags, "--chunk-size", "5", "--precision", "f32"])
    whole, chunks = figure.read([path])
    assert whole["sizes"]["engine"] == "scan" and whole["sizes"]["chunk_size"] is None
    assert chunks["sizes"]["chunk_size"] == 5
    for each in (whole, chunks):
        assert each["gemm_fraction"] > 0 and each["gemm_tflops_per_s"] > 0
    assert chunks["gemm_fraction"] == chunks["f32_gemm_fraction"]
    with pytest.raises(ValueError, match="one device"):
        figure.draw([whole, chunks], [])  # tiny is not the paper
    monkeypatch.setattr(figure, "_PAPER", figure.workloads.named_size("tiny"))
    left, _ = figure.draw([whole, chunks], []).axes
    ms = pytest.approx(whole["median_ms"] / 2)
    assert lines(left) == {"jaxpets, scan": [(2, ms)]}
