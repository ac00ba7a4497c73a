"""`python -m experiments.doctor`: whether runs can start here, and how well they go.

It changes nothing but the user's cache of kernels. Its own imports are light: it is for
places where packages are missing.
"""

import argparse
import functools
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from . import calling, requirements, signals
from .errors import RunError, printable
from .requirements import Finding, Mark

_COMPILERS = ("c++", "g++", "clang++")
_MIN_MEMORY, _MIN_DISK = 2e9, 1e8  # of a run on a laptop, in bytes
_CUDA_13_DRIVER = 580  # the first that runs CUDA 13


def main(argv: Sequence[str] | None = None) -> int:
    """Prints what it finds; returns the exit code: 1 if a run could not start."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("doctor"),
        description="Says whether runs can start here, and what would help them. "
        "The exit code is 1 if none can.",
    )
    parser.parse_args(argv)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # what a user cannot act on
    worst = [finding.mark for finding in findings(_CHECKS, _show)]
    if Mark.BAD in worst:
        print(f"\nNo run can start here: see {_sign(Mark.BAD)}.")
        return 1
    poor = worst.count(Mark.POOR)
    print(f"\nRuns can start; {poor or 'nothing'} to improve.")
    return 0


def findings(
    checks: Sequence[Callable[[], Iterator[Finding]]], show: Callable[[Finding], None]
) -> list[Finding]:
    """Returns what checks find; each finding is shown as it is made."""
    found: list[Finding] = []
    for check in checks:
        try:
            own = list(check())
        except (Exception, SystemExit) as error:  # whatever is broken there
            if any(finding.mark is Mark.BAD for finding in found):
                continue  # it says why
            line, *_ = [*str(error).splitlines(), type(error).__name__]
            own = [Finding(Mark.BAD, f"{check.__name__.strip('_')}: {line}")]
        for finding in own:
            show(finding)
        found += own
    return found


def _show(finding: Finding) -> None:
    print(f"{_sign(finding.mark)} {printable(finding.text)}", flush=True)
    if finding.advice:
        print(f"      {printable(finding.advice)}", flush=True)


def _sign(mark: Mark) -> str:
    """Returns a sign in brackets, as far as what is printed to can show it."""
    sign, ascii_sign, color = mark.value
    try:
        sign.encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        sign = ascii_sign
    colored = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    return f"[\33[{color}m{sign}\33[0m]" if colored else f"[{sign}]"


# The checks, in the order of what each needs.


def _device() -> Iterator[Finding]:
    """What jax computes on, and whether there is a GPU that it does not see."""
    import jax

    driver = _driver()
    extra = "cuda13" if driver and _major(driver) >= _CUDA_13_DRIVER else "cuda12"
    install = f'pip install "jaxpets[{extra}]"'
    try:
        kinds = [device.device_kind for device in jax.devices()]
    except Exception as error:
        line, *_ = [*str(error).splitlines(), type(error).__name__]
        asked = os.environ.get("JAX_PLATFORMS")
        unset = f"; or unset JAX_PLATFORMS, which is {asked}" if asked else ""
        yield Finding(Mark.BAD, f"device: {line}", install + unset)
        return
    backend = jax.default_backend()
    from .storage.environment import environment

    kind = f"{len(kinds)} x {kinds[0]}"
    text = (
        f"device: {backend}, {environment()['processor'] if backend == 'cpu' else kind}"
    )
    text += f", driver {driver}" if driver else ""
    if driver and backend == "cpu":
        yield Finding(Mark.POOR, f"{text}; there is a GPU that jax does not use",
                      install)  # fmt: skip
        return
    yield Finding(Mark.GOOD, text)


def _planning() -> Iterator[Finding]:
    """Whether a run's plans are imagined by a kernel; it is built here, and kept."""
    import jax

    from . import presets, robots

    on_gpu = jax.default_backend() == "gpu"
    preset = presets.PRESETS["paper" if on_gpu else "laptop"]
    with robots.without_gl():
        from . import build

        planned_by = build.build(preset).explored_by
    if not planned_by.startswith(build.SCAN):
        yield Finding(Mark.GOOD, f"planning: {planned_by}")
        return
    advice = "" if on_gpu else "apt-get install g++ makes it twice as fast"
    yield Finding(Mark.POOR, f"planning: {planned_by}, no kernel", advice)


def _compilers() -> Iterator[Finding]:
    """What C MuJoCo and a CPU's kernels are built with, C++, and a GPU's, nvcc."""
    import jax

    on_gpu = jax.default_backend() == "gpu"
    for what, names, needed, advice in (
        ("C++ compiler", _COMPILERS, True, "apt-get install g++"),
        ("nvcc", ("nvcc",), on_gpu, "install the CUDA toolkit, or jaxpets[cuda13]"),
    ):
        found = next(filter(None, map(shutil.which, names)), None)
        if found is not None:
            said = _said([found, "--version"])
            version = re.search(r"\d+\.\d+[.\d]*", said)
            number = version[0] if version else "of unknown version"
            yield Finding(Mark.GOOD, f"{what}: {number}, {found}")
        elif needed:
            yield Finding(Mark.POOR, f"{what}: none", advice)
        else:
            yield Finding(Mark.NOTE, f"{what}: none, and none is needed here")


def _opengl() -> Iterator[Finding]:
    """What videos are drawn with."""
    from .tools import opengl

    try:
        yield Finding(Mark.GOOD, f"OpenGL: {opengl.backend()}")
    except RunError as error:
        reason, _, advice = str(error).rpartition(". ")
        yield Finding(Mark.POOR, f"OpenGL: {reason}", f"for videos, {advice}")


def _machine() -> Iterator[Finding]:
    """Cores, memory, and the disk that runs are written to."""
    own = getattr(os, "sched_getaffinity", None)  # which Linux has
    cores = len(own(0)) if own else os.cpu_count()
    yield Finding(Mark.GOOD, f"cores: {cores}, {platform.machine()}")
    free = _free_memory()
    if free is not None:
        poor = free < _MIN_MEMORY
        advice = "close other programs; a run on a laptop takes 2 GB" if poor else ""
        text = f"memory: {free / 1e9:.1f} GB free"
        yield Finding(Mark.POOR if poor else Mark.GOOD, text, advice)
    place = next(x for x in (Path("runs").absolute(), *Path("runs").absolute().parents)
                 if x.exists())  # fmt: skip
    disk = shutil.disk_usage(place).free
    text = f"disk: {disk / 1e9:.1f} GB free in {place}"
    if not os.access(place, os.W_OK):
        text, advice = f"disk: {place} cannot be written", "name another with --out"
        yield Finding(Mark.BAD, text, advice)
    elif disk < _MIN_DISK:
        yield Finding(Mark.BAD, text, "free some, or name another disk with --out")
    else:
        yield Finding(Mark.GOOD, text)


_CHECKS = (
    requirements.python, requirements.packages, requirements.extras,
    _device, _planning, _compilers, _opengl, _machine,
)  # fmt: skip


@functools.cache
def _driver() -> str | None:
    """Returns the version of NVIDIA's driver, None without a GPU of theirs."""
    if shutil.which("nvidia-smi") is None:
        return None
    said = _said(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"])
    found = re.match(r"\d+\.\d[.\d]*", said)
    return found[0] if found else None


def _major(version: str) -> int:
    return int(version.partition(".")[0])


def _said(command: Sequence[str]) -> str:
    """Returns what a command prints, nothing if it fails."""
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=20, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return ""


def _free_memory() -> int | None:
    """Returns the bytes that a program may take here, None without a /proc."""
    try:
        text = Path("/proc/meminfo").read_text()
        limits = [int(re.findall(r"MemAvailable: *(\d+) kB", text)[0]) * 1024]
    except (OSError, IndexError):
        return None
    group = Path("/sys/fs/cgroup")
    try:
        allowed = int((group / "memory.max").read_text())
        limits.append(allowed - int((group / "memory.current").read_text()))
    except (OSError, ValueError):  # `max`, or groups of another kind
        pass
    return min(limits)


if __name__ == "__main__":
    signals.as_program(main)
