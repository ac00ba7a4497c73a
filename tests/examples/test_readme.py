"""The README's Python is lines of the examples, which run, so that it cannot rot."""

import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def test_every_block_is_a_stretch_of_an_example():
    readme = (REPOSITORY / "README.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", readme, re.DOTALL | re.MULTILINE)
    examples = [path.read_text() for path in (REPOSITORY / "examples").glob("*.py")]
    assert blocks
    for block in blocks:
        assert any(f"\n{block}" in f"\n{text}" for text in examples), block
