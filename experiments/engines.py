"""What imagines and what trains, as a run keeps it and says it."""

import jaxpets

from .build import KERNEL, SCAN
from .storage.folder import RunFolder


def say_engines(
    run: RunFolder, rollout: str, **fitters: jaxpets.typing.Fitter | None
) -> None:
    """Warns where numbers may be others than those so far, or come slowly.

    Args:
      run: that is told, and keeps what computes it.
      rollout: what imagines.
      fitters: what trains, by the name that env.json has for it.
    """
    train = {name: fitter for name, fitter in fitters.items() if fitter}
    kinds = {
        name: f"{KERNEL} of {fitter.compiler}" if fitter.uses_kernel else SCAN
        for name, fitter in train.items()
    }
    changed = run.computes(rollout=rollout, **kinds)
    lines = [f"{line}; the last bits may differ" for line in changed]
    if not lines and rollout.startswith(f"{SCAN} ("):
        lines = [f"planning takes twice as long as in a kernel: it is a {rollout}"]
    reasons = (fitter.reason for fitter in train.values() if fitter.reason)
    lines += [f"no kernel trains: {reason}" for reason in reasons]
    for line in lines:
        run.say(f"warning: {line}")
