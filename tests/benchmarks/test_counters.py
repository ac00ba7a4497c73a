"""What rows say of ncu's pages: those that are committed, and pages that are none."""

import json
from pathlib import Path

import pytest

from benchmarks import counters
from experiments.storage.archive import unpack

RESULTS = Path(counters.__file__).parent / "results"
SOURCE = """"Kernel Name","a_kernel"
"Address","Source","Warp Stall Sampling (All Samples)","# Samples"
"1","  MUFU.TANH R1, R2 ","1,200","0"
"2","@!P0 BRA 0x7f","600","0"
"3","@P1  MUFU.LG2 R1, R2","200","0"
"4","HGMMA.64x88x16.F32 R8, R12","","0"
"""


COMMITTED = (RESULTS / "counters.jsonl").read_text().splitlines()


def test_committed_rows_are_those_of_the_committed_pages(tmp_path, capsys):
    unpack(RESULTS / "counters.tar.xz", tmp_path)
    seen = set()
    for row in map(json.loads, COMMITTED):
        engine, seeds = row["sizes"]["engine"], row["sizes"]["seeds"]
        kernel = row["kernel"] + ("-sm_90" if engine == "sm_90" else "")
        page, source = (
            tmp_path / f"{kernel}-{seeds}{x}" for x in (".csv", ".source.csv")
        )
        flags = ["--kernel", row["kernel"], "--engine", engine, "--seeds", str(seeds)]
        (again,) = counters.main([*flags, "--read", str(page), "--source", str(source)])
        again = json.loads(json.dumps(again))
        assert again.keys() == row.keys()
        for name in again.keys() - {"date", "cpus", "git", "versions"}:
            assert again[name] == row[name], name
        seen |= {page, source}
    assert seen == {*tmp_path.iterdir()}
    printed = capsys.readouterr().out
    assert printed.count("counters on NVIDIA H200") == len(COMMITTED)


def test_the_page_shows_what_the_rows_say():
    page = (RESULTS.parent / "kernel.md").read_text()
    rows = [json.loads(line) for line in COMMITTED]

    def line(label, of, form="{:.0%}"):
        cells = [form.format(of(row)).replace("%", " %") for row in rows]
        assert f"| {label} | {' | '.join(cells)} |" in page

    def share(part, *names):
        return lambda row: sum(row[part].get(name, 0.0) for name in names)

    line("us of the launch", lambda row: row["us"], "{:.0f}")
    line("blocks", lambda row: row["blocks"], "{}")
    line("multiprocessors have work", lambda row: row["used"])
    line("... while they do: tensor cores are busy", lambda row: row["tensor"])
    special = "... units for tanh, logarithms and the like are"
    line(special, lambda row: row["special"])
    line("... schedulers issue an instruction", lambda row: row["issued"])
    line("warps a scheduler", lambda row: row["warps"], "{:.1f}")
    line("registers a thread", lambda row: row["registers"], "{}")
    line("a warp waits for: its last instruction", share("waits", "wait"))
    memory = share("waits", "long_scoreboard", "short_scoreboard")
    line("... memory and special units", memory)
    line("... a unit to take its instruction", share("waits", "dispatch_stall"))
    line("... others at a barrier", share("waits", "barrier"))
    line("... instructions to be fetched", share("waits", "no_instruction"))
    line("its samples are at: tanh and the like", share("code", "MUFU"))
    line("... products", share("code", "HGMMA", "HMMA"))
    line("... branches, most of them loops that wait", share("code", "BRA"))


def test_samples_are_counted_by_kind_of_instruction():
    found = counters.code(SOURCE.splitlines())
    assert found == {"MUFU": 0.7, "BRA": 0.3, "HGMMA": 0.0}


def test_the_page_of_instructions_joins_the_row(tmp_path):
    unpack(RESULTS / "counters.tar.xz", tmp_path, "fit-1.csv")
    (source := tmp_path / "source.csv").write_text(SOURCE)
    flags = ["--kernel", "fit", "--read", str(tmp_path / "fit-1.csv")]
    (row,) = counters.main([*flags, "--source", str(source)])
    assert row["code"]["MUFU"] == 0.7


def test_a_page_of_several_launches_is_refused():
    with pytest.raises(SystemExit, match="not a page of one launch: 0 lines"):
        counters.counters(["==PROF== Disconnected"])


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--kernel", "fit", "--engine", "sm_90"], "one kernel trains"),
        (["--json", "rows.jsonl"], "--json and --source go with --read"),
        (["--source", "page.csv"], "--json and --source go with --read"),
    ],
)
def test_flags_that_do_not_go_together_are_refused(flags, words, capsys):
    with pytest.raises(SystemExit):
        counters.main(flags)
    assert words in capsys.readouterr().err


def test_without_a_gpu_there_is_nothing_to_count():
    with pytest.raises(SystemExit, match="no GPU whose counters"):
        counters.main(["--tiny"])
