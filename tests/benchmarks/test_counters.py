"""What rows say of ncu's pages: those that are committed, and pages that are none."""

import json
import tarfile
from pathlib import Path

import pytest

from benchmarks import counters

RESULTS = Path(counters.__file__).parent / "results"
SOURCE = """"Kernel Name","a_kernel"
"Address","Source","Warp Stall Sampling (All Samples)","# Samples"
"1","  MUFU.TANH R1, R2 ","1,200","0"
"2","@!P0 BRA 0x7f","600","0"
"3","@P1  MUFU.LG2 R1, R2","200","0"
"4","HGMMA.64x88x16.F32 R8, R12","","0"
"""


def test_committed_rows_are_those_of_the_committed_pages(tmp_path, capsys):
    lines = (RESULTS / "counters.jsonl").read_text().splitlines()
    committed = [json.loads(line) for line in lines]
    with tarfile.open(RESULTS / "counters.tar.xz") as pages:
        pages.extractall(tmp_path, filter="data")
    seen = set()
    for row in committed:
        engine, seeds = row["sizes"]["engine"], row["sizes"]["seeds"]
        kernel = row["kernel"] + ("-sm_90" if engine == "sm_90" else "")
        page = tmp_path / f"{kernel}-{seeds}.csv"
        flags = ["--kernel", row["kernel"], "--engine", engine, "--read", str(page)]
        (again,) = counters.main([*flags, "--seeds", str(seeds)])
        again = json.loads(json.dumps(again))
        own = again.keys() - {"date", "cpus", "git", "versions"}
        assert {x: again[x] for x in own} == {x: row[x] for x in own}
        seen.add(page)
    assert seen == {*tmp_path.iterdir()}
    printed = capsys.readouterr().out
    assert printed.count("counters on NVIDIA H100 80GB HBM3") == len(seen)


def test_the_page_shows_what_the_rows_say():
    page = (RESULTS.parent / "kernel.md").read_text()
    lines = (RESULTS / "counters.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]

    def line(label, of, form="{:.0%}"):
        cells = [form.format(of(row)).replace("%", " %") for row in found]
        assert f"| {label} | {' | '.join(cells)} |" in page

    line("us of the launch", lambda row: row["us"], "{:.0f}")
    line("blocks", lambda row: row["blocks"], "{}")
    line("multiprocessors have work", lambda row: row["used"])
    line("... while they do: tensor cores are busy", lambda row: row["tensor"])
    special = "... units for tanh, logarithms and the like are"
    line(special, lambda row: row["special"])
    line("... schedulers issue an instruction", lambda row: row["issued"])
    waits = "a warp waits for: the last instruction"
    line(waits, lambda row: row["waits"]["wait"])
    line("... others at a barrier", lambda row: row["waits"]["barrier"])


def test_samples_are_counted_by_kind_of_instruction():
    found = counters.code(SOURCE.splitlines())
    assert found == {"MUFU": 0.7, "BRA": 0.3, "HGMMA": 0.0}


def test_the_page_of_instructions_joins_the_row(tmp_path):
    with tarfile.open(RESULTS / "counters.tar.xz") as pages:
        pages.extract("fit-1.csv", tmp_path, filter="data")
    (source := tmp_path / "source.csv").write_text(SOURCE)
    flags = ["--kernel", "fit", "--read", str(tmp_path / "fit-1.csv")]
    (row,) = counters.main([*flags, "--source", str(source)])
    assert row["code"]["MUFU"] == 0.7


def test_a_page_of_several_launches_is_refused():
    with pytest.raises(SystemExit, match="not a page of one launch: 0 lines"):
        counters.counters(["==PROF== Disconnected"])


def test_without_a_gpu_there_is_nothing_to_count():
    with pytest.raises(SystemExit, match="no GPU whose counters"):
        counters.main(["--tiny"])
