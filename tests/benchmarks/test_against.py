"""Today's rows beside committed ones."""

import json

import pytest

from benchmarks import against


def row(ms, benchmark="plan", device="card", **sizes):
    return {"benchmark": benchmark, "device": device, "min_ms": ms,
            "median_ms": 1.25 * ms, "sizes": sizes}  # fmt: skip


def plain(ms, device="card"):
    """The program that all others are measured by."""
    sizes = {"engine": "scan", "precision": "bf16", "seeds": 1, "plans": 1}
    return row(ms, device=device, num_samples=500, **sizes)


COMMITTED = [
    plain(10.0), row(2.0, "fit", seeds=1), row(4.0, "fit", seeds=4),
    # Another day, on which all was slower by half; and another device.
    plain(15.0), row(6.0, "fit", seeds=4), plain(1.0, "other"),
    row(0.1, "fit", "other", seeds=1), row(9.0, "fit", "other", seeds=16),
]  # fmt: skip


def test_speeds_are_multiples_of_the_plain_programs_of_their_day():
    today = [plain(20.0), row(4.0, "fit", seeds=1), row(16.0, "fit", seeds=4),
             row(1.0, "fit", seeds=16)]  # fmt: skip
    found = list(against.pairs(today, COMMITTED))
    assert [pair.row for pair in found] == today
    speeds = [pair.speed for pair in found]
    # The machine is half as fast today. The second fit has become slower than that:
    # 20 / 16 of the plain program's rate, where it had 15 / 6.
    assert speeds[:3] == [pytest.approx(x) for x in (1.0, 1.0, 0.5)]
    assert speeds[3] is None  # only the other device has it


def test_a_device_has_a_plain_program_of_its_own():
    alone = [row(4.0, "fit", "other", seeds=1)]
    (pair,) = against.pairs(alone, [plain(10.0), *alone])
    assert pair.committed == alone[0] and pair.speed is None


def test_a_row_without_the_plain_program_of_its_commit_is_not_compared():
    committed = [*COMMITTED, {**row(1.0, "fit", seeds=1), "git": "later"}]
    today = [plain(10.0), row(2.0, "fit", seeds=1)]
    (_, pair) = against.pairs(today, committed)
    assert pair.committed == COMMITTED[1] and pair.speed == 1.0


@pytest.mark.parametrize(
    "other",
    [{"optimizer": "icem"}, {"chunk_size": 25}, {"horizon": 5}, {"hidden_sizes": [8]}],
)
def test_another_plan_of_the_same_size_is_no_unit(other):
    found = plain(1.0)
    found["sizes"] |= other
    pairs = list(
        against.pairs([plain(10.0), found, row(2.0, "fit", seeds=1)], COMMITTED)
    )
    assert pairs[-1].speed == 1.0


def test_c_mujoco_is_measured_by_the_plain_loop_of_its_host():
    """Which is timed after it."""

    def day(gpu, host):
        return [plain(gpu), row(4.0 * host, "env", engine="mujoco", batch=1),
                row(gpu, "env", engine="mjx", batch=1),
                row(host, "env", engine="mujoco-loop", batch=1)]  # fmt: skip

    today, slower = day(10.0, 2.0), day(10.0, 2.0)
    slower[1]["min_ms"] *= 2
    for found, speed in ((today, 1.0), (slower, 0.5)):
        speeds = [pair.speed for pair in against.pairs(found, day(20.0, 1.0))]
        assert speeds == [1.0, pytest.approx(speed), 1.0, 1.0]
    # Two hosts of one commit: a step on the second takes as much of its own loop.
    twice = list(against.pairs([*day(10.0, 2.0), *day(10.0, 1.0)], day(10.0, 1.0)))
    assert [pair.speed for pair in twice] == [pytest.approx(1.0)] * 8
    alone = today[:2]
    assert [x.speed for x in against.pairs(alone, day(10.0, 1.0))] == [1.0, None]


def test_what_became_slower_is_returned_and_all_is_printed(tmp_path, capsys):
    lines = [*COMMITTED, {"benchmark": "accuracy", "device": "card", "sizes": {}}]
    rival = {"name": "rival", "device": "card", "engine": "jit", "dtype": "f32",
             "seeds": 1, "ms_per_plan": 44.0, "source": "measured by hand"}  # fmt: skip
    (tmp_path / "card.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (tmp_path / "peers.jsonl").write_text(json.dumps(rival))
    today = [plain(10.0), row(2.2, "fit", seeds=1), row(4.6, "fit", seeds=4)]
    committed = against.committed_rows(tmp_path)
    (slower,) = against.report(today, committed)
    against.peers(committed, "card")
    against.peers(committed, "another card")
    assert slower["sizes"] == {"seeds": 4}
    text = capsys.readouterr().out.splitlines()
    assert text[2].split() == ["2.75", "2.5", "0.91", "fit", "seeds=1"]
    assert text[3].split()[:3] == ["5.75", "7.5", "0.87"]
    assert text[4].split()[:3] == ["44", "rival,", "jit,"]
    assert len(text) == 5
    assert against.report([], against.committed_rows(tmp_path)) == []


def test_a_variant_of_an_earlier_day_is_not_the_last_row(tmp_path):
    days = {"a": "2026-11-28", "z_variants": "2026-11-22"}
    for name, day in days.items():
        line = json.dumps({**row(1.0, "trace"), "date": day})
        (tmp_path / f"{name}.jsonl").write_text(line)
    found = against.committed_rows(tmp_path)
    assert [one["date"] for one in found] == sorted(days.values())


def test_what_is_committed_can_be_measured_against():
    """The newest row of each program beside itself, as if all were of today."""
    path = against.RESULTS / "h200.jsonl"
    committed = [json.loads(line) for line in path.read_text().splitlines()]
    found = [pair for pair in against.pairs(committed, committed) if pair.speed]
    known = {pair.row["benchmark"] for pair in found}
    assert {"plan", "fit", "rollout", "env", "trace"} <= known
    assert found[-1].row == found[-1].committed and found[-1].speed == 1.0
