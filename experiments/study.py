"""`python -m experiments.study`: explores, performs all tasks, and reports.

It is what `make explore` does: phases of `experiments.run` one after the other, in one
process, with one bar for the time that all of them take.
"""

import argparse
import contextlib
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import tqdm
from tqdm.contrib import DummyTqdmFile

from . import calling, cli, robots, run, signals, user_files
from .config import UNPLANNED, Config
from .errors import RunError, UsageError, last_line
from .forecast import Forecast, Sizes
from .parallel import distributed
from .progress import Watch
from .report import logs
from .storage import metrics, rundir
from .validate import require

_BAR = "{percentage:3.0f}% |{bar}| {elapsed}{postfix}  {desc}"
_REFRESH = 1.0  # seconds


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the phases with flags of `explore`; returns the exit code, as `run.main`."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("study"),
        usage="%(prog)s [FLAG ...]",
        description="Explores, performs all tasks, makes videos of them, and reports.",
        epilog=f"Its flags are those of `{calling.usage('run', 'explore')}`, whose "
        "help explains them.",
        allow_abbrev=False,
    )
    _, arguments = parser.parse_known_args(argv)
    try:
        with robots.without_gl():
            config = cli.parse(["explore", *arguments])
            tasks = robots.of(config).tasks.names
        alone = config.coordinator_address is None
        valid = "left out; a study is of one process"
        require(alone, "--coordinator-address", config.coordinator_address, valid)
        _check_report(config)
    except RunError as error:
        signals.say(last_line(error))
        return error.exit_code
    begin = time.monotonic()
    watch = _Whole(_sizes(config, len(tasks)))
    with watch.drawn():
        code = _phases(config, arguments, watch)
    if code == 0:
        distributed.say(_last_screen(config, tasks, time.monotonic() - begin))
    return code


def _check_report(config: Config) -> None:
    """Refuses a run beside which the report would count a seed twice."""
    own, study = cli.explored_run(config), rundir.study(vars(config))
    arm = metrics.arm_label(config.arm, vars(config))
    for log in logs.files(config.out, rundir.METRICS):
        other = logs.config(log.parent)
        if other.get("phase") != "explore" or log.parent.resolve() == own:
            continue
        its = metrics.arm_label(other.get("arm", "epistemic"), other)
        twice = sorted({*config.seeds} & {*other.get("seeds", ())})
        is_same = (rundir.study(other), its) == (study, arm)
        if is_same and twice and metrics.rows_by_trial(log):
            raise UsageError(
                f"{log.parent} has seed {twice[0]} of {arm} already, which the report "
                "would count twice. Choose other --seeds or another --out, or move it."
            )


def _phases(config: Config, arguments: Sequence[str], watch: "_Whole") -> int:
    """Runs the phases until one does not end well; returns its exit code."""
    later = [*_source(config), "--out", str(config.out)]
    later += ["--track", str(config.track)] * (config.track is not None)
    later += ["--allow-cpu"] * config.allow_cpu + ["--debug"] * config.debug
    words = {
        "explore": list(arguments),
        "zero-shot": [*later, "--video", str(_video(config))],
        "report": ["--out", str(config.out)],
    }
    for phase, flags in words.items():
        watch.begin(phase)
        if code := run.main([phase, *flags], watch):
            return code
    return 0


def _source(config: Config) -> list[str]:
    """Returns the flags of phase 2 that name the run, and the user's files in it."""
    named = ["--from", str(config.out / cli.run_name(config))]
    return named + user_files.flags(config.env, config.arm)


def _video(config: Config) -> Path:
    return config.out / f"{cli.run_name(config)}.mp4"


def _sizes(config: Config, num_tasks: int) -> Sizes:
    at_random = config.arm in UNPLANNED
    return Sizes(
        num_trials=config.num_trials,
        num_random=config.num_trials if at_random else config.random_trials,
        trial_length=config.trial_length,
        num_branches=num_tasks * config.eval_trials,  # compared with one of each seed
        task_length=config.task_length,
        num_videos=num_tasks,
    )


def _last_screen(config: Config, tasks: Sequence[str], seconds: float) -> str:
    """Returns what was made, and what to open or to do next."""
    out, video = config.out, _video(config)
    videos = [video.with_stem(f"{video.stem}-{task}") for task in tasks]
    made = {
        out / "report" / "report.md": "tables and figures of all runs",
        **{path: "the robot at that task" for path in [video, *videos]},
        out / cli.run_name(config): "the explored model, its log and settings",
    }
    found = {str(path): text for path, text in made.items() if path.exists()}
    width = max(map(len, found))
    lines = [
        f"\ndone in {_time(seconds)}. This is what was made:",
        *(f"  {path:<{width}}  {text}" for path, text in found.items()),
        "\nOpen the report first. To go on, with the rewards of the tasks:",
        f"  {calling.line('run', 'finetune', *_source(config))}",
    ]
    return "\n".join(lines)


class _Whole(Watch):
    """One bar for all phases, over the time that they take."""

    has_bar = True

    def __init__(self, sizes: Sizes) -> None:
        self._forecast = Forecast(sizes)
        self._start = self._since = time.monotonic()
        self._what = ""
        self._lock = threading.Lock()

    def begin(self, phase: str, done: int = 0) -> None:
        with self._lock:
            self._forecast.begin(phase, done)
            self._what, self._since = phase, time.monotonic()

    def did(self, kind: str, units: int, *, first: bool = False) -> None:
        with self._lock:
            now = time.monotonic()
            self._forecast.did(kind, units, now - self._since, first=first)
            self._since = now

    def says(self, what: str) -> None:
        with self._lock:
            self._what = what

    def draw(self, bar: Any) -> None:
        """Draws the bar as far as the time that is over goes in that of the whole."""
        with self._lock:
            now, what = time.monotonic(), self._what
            left = self._forecast.left(now - self._since)
        if left is not None:
            elapsed = now - self._start
            share = 100.0 * elapsed / (elapsed + left)
            bar.n = max(bar.n, round(share, 1))  # it never goes back
            bar.set_postfix_str(f"about {_time(left)} left", refresh=False)
        bar.set_description_str(what)

    @contextlib.contextmanager
    def drawn(self) -> Iterator[None]:
        """Draws the bar every second; what is printed meanwhile stands above it."""
        if not sys.stderr.isatty():
            yield
            return
        over = threading.Event()
        bar = tqdm.tqdm(total=100.0, bar_format=_BAR, dynamic_ncols=True, leave=False)

        def draw() -> None:
            while not over.wait(_REFRESH):
                self.draw(bar)

        thread = threading.Thread(target=draw, daemon=True)
        thread.start()
        try:
            above: Any = DummyTqdmFile(sys.stderr)
            with contextlib.redirect_stderr(above):
                yield
        finally:
            over.set()
            thread.join()
            bar.close()


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


if __name__ == "__main__":
    signals.as_program(main)
