"""Which GPUs there are kernels for."""

import re
from typing import Any

# Hopper's instructions for a warpgroup and for clusters are in this variant alone.
HOPPER = "sm_90a"


def capability(device: Any) -> tuple[int, int]:
    """Returns the compute capability of a GPU; (0, 0) of anything else."""
    seen = re.fullmatch(r"(\d+)\.(\d)", getattr(device, "compute_capability", ""))
    return (int(seen[1]), int(seen[2])) if seen else (0, 0)


def is_hopper(device: Any) -> bool:
    """Whether a device is an H100, H200 or GH200."""
    return capability(device) == (9, 0)
