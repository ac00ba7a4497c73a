"""Damaged configs of a run: each is read as it is, or refused in one line."""

import json
import operator
from collections import Counter
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.config import Config
from experiments.entries import from_json, to_json
from experiments.errors import RunError
from experiments.storage import rundir
from experiments.validate import validate

GOOD = to_json(Config())
GOOD_ENDS = ("refused", "read")  # see `damaged`
SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
    | st.sampled_from(["3", "adam", "../x", "/etc/x", "\x1b[2J", "NaN", -1, 0, 2**64])
)  # fmt: skip
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=9), inner, max_size=3)
    ),
    max_leaves=5,
)


def _places(data: dict[str, Any], before: tuple[str, ...] = ()) -> Iterator[tuple]:
    for name, value in data.items():
        yield (*before, name)
        if isinstance(value, dict):
            yield from _places(value, (*before, name))


PLACES = sorted(_places(GOOD))


@st.composite
def texts(draw: st.DrawFn) -> bytes:
    """Draws a config.json that something has happened to, or several things."""
    data = json.loads(json.dumps(GOOD))
    for place in draw(st.lists(st.sampled_from(PLACES), min_size=1, max_size=2)):
        *groups, name = place
        group = reduce(
            lambda x, y: x.get(y) if isinstance(x, dict) else None, groups, data
        )
        what = draw(st.sampled_from(["replace", "replace", "drop", "rename"]))
        value = group.pop(name, None) if isinstance(group, dict) else None
        if not isinstance(group, dict) or what == "drop":
            continue
        named = draw(st.text(max_size=9)) if what == "rename" else name
        group[named] = draw(VALUES) if what == "replace" else value
    text = json.dumps(data, indent=draw(st.sampled_from([None, 2]))).encode()
    what = draw(st.sampled_from(["nothing"] * 6 + ["cut", "flip", "twice", "other"]))
    at = draw(st.integers(0, len(text) - 1))
    if what == "cut":
        return text[:at]
    if what == "flip":
        bit = 1 << draw(st.integers(0, 7))
        return text[:at] + bytes([text[at] ^ bit]) + text[at + 1 :]
    if what == "twice":
        pair = f'{{"{draw(st.sampled_from(PLACES))[0]}": null, '
        return pair.encode() + text.lstrip()[1:]
    return json.dumps(draw(VALUES)).encode() if what == "other" else text


def damaged(count: int, folder: Path) -> Counter[str]:
    """Reads so many damaged configs; counts what came of them.

    Returns:
      refused, in one line; read, as it is; and what should not be: altered, unclear,
      and the names of exceptions that are no RunError.
    """
    path, found = folder / "config.json", Counter()

    @settings(
        max_examples=count, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(texts())
    def tries(text: bytes) -> None:
        path.write_bytes(text)
        found[_outcome(path, text)] += 1

    tries()
    return found


def _outcome(path: Path, text: bytes) -> str:
    try:
        config = from_json(rundir.read_json(path), Config(), str(path))
        validate(config)
    except RunError as error:
        said = str(error)
        return "refused" if said.isprintable() and len(said) < 1000 else "unclear"
    except Exception as error:
        return type(error).__name__
    return "read" if _is_in(json.loads(text), to_json(config)) else "altered"


def _is_in(given: Any, read: Any) -> bool:
    """Tells whether everything that was given was read as it is."""
    if isinstance(given, dict) and isinstance(read, dict):
        return all(name in read and _is_in(given[name], read[name]) for name in given)
    whole = operator.xor(isinstance(given, bool), isinstance(read, bool))
    return given == read and not whole
