"""Says which lines no test has reached; fails if they are too many.

Usage: coverage.py FILE PACKAGE=PERCENT...; the file is slipcover's, in JSON.
"""

import json
import sys
from pathlib import Path


def main(file: str, *least: str) -> int:
    """Returns how many packages have less than they need."""
    files = json.loads(Path(file).read_text())["files"]
    failed = 0
    for package, percent in (text.split("=") for text in least):
        reached = missing = 0
        for path, lines in sorted(files.items()):
            if package in Path(path).parts:
                reached += len(lines["executed_lines"])
                missing += len(lines["missing_lines"])
                if lines["missing_lines"]:
                    print(path, *lines["missing_lines"])
        found = 100 * reached / max(1, reached + missing)
        print(f"{package}: {found:.2f} % of {reached + missing} lines, want {percent}")
        failed += found < float(percent)
    return failed


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
