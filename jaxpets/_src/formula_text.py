"""A formula from a line of text: names, arithmetic and a dozen functions."""

import ast
import itertools
import keyword
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, cast

import numpy as np

from jaxpets._src.checks import check_count, check_records, check_text, nearest
from jaxpets._src.formula import OPERATIONS, Formula
from jaxpets._src.formula_program import FormulaError, Node, Program, fail
from jaxpets._src.types import Coordinate

MAX_LENGTH = 1000

FUNCTIONS = (
    "abs", "sqrt", "exp", "log", "sin", "cos", "tanh", "square", "sign", "min", "max",
    "where", "clip", "tolerance",
)  # fmt: skip
"""What may stand in front of a bracket; `min` and `max` take two arguments or more."""

_BINARY: dict[type[ast.AST], str] = {
    ast.Add: "add",
    ast.Sub: "subtract",
    ast.Mult: "multiply",
    ast.Div: "divide",
    ast.Pow: "power",
    ast.And: "and",
    ast.Or: "or",
}
_UNARY: dict[type[ast.AST], str] = {
    ast.USub: "negative",
    ast.UAdd: "copy",
    ast.Not: "not",
}
# By what they compare: the operation, and whether its operands change places.
_COMPARISONS: dict[type[ast.AST], tuple[str, bool]] = {
    ast.Lt: ("less", False),
    ast.LtE: ("less_equal", False),
    ast.Gt: ("less", True),
    ast.GtE: ("less_equal", True),
    ast.Eq: ("equal", False),
}
_CONSTANTS = {"pi": float(np.pi)}


def names(
    coordinates: Sequence[Coordinate], aliases: Mapping[str, int] | None = None
) -> dict[str, int]:
    """Returns how the entries of an observation are written in a formula.

    Whatever cannot stand in a word becomes an underscore, so that `qvel/rootx` is
    `qvel_rootx` and `qpos/root.z` is `qpos_root_z`; a digit in front gets one as well.
    Where this gives a word that is taken, by another entry, a function or Python, an
    underscore follows it, and one more until it is free.

    Args:
      coordinates: D entries, as `Env.coordinates`.
      aliases: more words, by the entry that they mean, as those of `Robot.axes`:
        `{axis.name: axis.entry for axis in robot.axes}`.

    Returns:
      Words and the places of their entries, in the order given.

    Raises:
      TypeError, ValueError: if these are no entries, or an alias is of an entry that is
        none; the last would be read for it, without a word.

    >>> names([Coordinate("qvel/rootx"), Coordinate("qpos/root.z")], {"velocity": 0})
    {'qvel_rootx': 0, 'qpos_root_z': 1, 'velocity': 0}
    """
    rows = check_records("coordinates", coordinates, Coordinate)
    others = _places("aliases", {} if aliases is None else aliases)
    for alias, place in others.items():
        if place >= len(rows):
            raise ValueError(
                f"aliases[{alias!r}] must be one of {len(rows)} entries, got {place}."
            )
    found: dict[str, int] = {}
    entries = [(row.name, i) for i, row in enumerate(rows)]
    for name, place in [*entries, *others.items()]:
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        word = word if word[:1].isalpha() or word[:1] == "_" else f"_{word}"
        while _is_taken(word) or found.get(word, place) != place:
            word += "_"
        found[word] = place
    return found


def _places(name: str, words: Any) -> Mapping[str, int]:
    """Returns an argument that is places of entries by words, or raises."""
    if not isinstance(words, Mapping):
        kind = type(words).__name__
        raise TypeError(f"{name} must be places by words, as a dict, got {kind}.")
    found = cast(Mapping[str, int], words)
    for word, place in found.items():
        check_text(f"a word of {name}", word)
        check_count(f"{name}[{word!r}]", place, 0, 2**31 - 1)
    return found


def _is_taken(word: str) -> bool:
    own = {*FUNCTIONS, *_CONSTANTS, "effort"}
    is_action = re.fullmatch(r"action_\d+", word) is not None
    return word in own or is_action or keyword.iskeyword(word)


def parse(
    text: str, names: Mapping[str, int], action_size: int | None = None
) -> Formula:
    """Returns the formula that a line of text means. Nothing is evaluated.

    A formula has numbers, `pi`, names of entries in the state that is reached,
    `action_0` and so on, `effort` (the sum of the squares of the action), `+ - * / **`,
    comparisons with `< <= > >= == !=`, which give 1 or 0 and may be chained, `and`,
    `or` and `not`, to which all but 0 is true, and these functions:

    - `abs sqrt exp log sin cos tanh square sign` of one argument,
    - `min` and `max` of two or more,
    - `where(c, a, b)`, a where c is not 0 and b where it is,
    - `clip(x, low, high)`,
    - `tolerance(x, low, high, margin)`, 1 within the bounds, and outside of them less,
      0.1 at the margin (Tassa et al., "DeepMind Control Suite", 2018, section 2).

    Everything is float32. A formula has at most 64 operations and 16 different names.

    Args:
      text: what somebody types.
      names: words, and the places of their entries in the observation, as `names`
        returns them.
      action_size: A, for the words `action_0` to `action_{A-1}`; None for no such word.

    Returns:
      What `reward` takes, as data for `PlanParams.reward`.

    Raises:
      FormulaError: if the text is no formula, whatever it is; it says why and where.
      TypeError, ValueError: if another argument is not what it should be.

    >>> entries = {"velocity": 0, "height": 1}
    >>> formula = parse("-(velocity - 2)**2 - 0.1 * effort + height", entries)
    >>> int(formula.size)
    9
    """
    if not isinstance(text, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"text must be a str, got {text!r}.")
    if action_size is not None:
        action_size = check_count("action_size", action_size)
    words = _places("names", names)
    actions = {f"action_{i}": i for i in range(action_size or 0)}
    try:
        tree = _Reader(words, actions).read(_tree(text))
        return Program().formula(tree)
    except RecursionError as error:  # where the caller has used up the stack
        raise FormulaError("This is nested too deeply.", 0) from error


def _tree(text: str) -> ast.expr:
    """Returns what Python reads, with columns as in the text."""
    if len(text) > MAX_LENGTH:
        message = f"A formula has at most {MAX_LENGTH} characters, not {len(text)}."
        raise FormulaError(message, MAX_LENGTH)
    strange = re.search(r"[^A-Za-z0-9_.,+\-*/()<>=!\s]", text, re.ASCII)
    if strange:
        raise FormulaError(f"{strange[0]!r} has no meaning here.", strange.start())
    # Of one line, that starts at once: as Python wants it.
    line = re.sub(r"\s", " ", text, flags=re.ASCII)
    start = len(line) - len(line.lstrip())
    if start == len(line):
        raise FormulaError("A formula is wanted, as -(velocity - 2)**2.", 0)
    try:
        with warnings.catch_warnings(action="ignore"):
            tree = ast.parse(line[start:], mode="eval").body
    except SyntaxError as error:
        column = start + error.offset - 1 if error.offset else len(text)
        message = f"This cannot be read: {error.msg}."
        raise FormulaError(message, min(column, len(text))) from error
    except (ValueError, MemoryError, RecursionError) as error:
        raise FormulaError("This is nested too deeply.", 0) from error
    for node in ast.walk(tree):
        if isinstance(node, ast.expr):
            node.col_offset += start
    return tree


class _Reader:
    """Makes operations of what Python reads, and says what is none."""

    def __init__(self, names: Mapping[str, int], actions: Mapping[str, int]) -> None:
        self._names = names
        self._actions = actions

    def read(self, node: ast.expr) -> Node:  # noqa: PLR0911, one for each kind
        at = node.col_offset
        match node:
            case ast.Constant(value):
                return self._number(value, at)
            case ast.Name(word):
                return self._word(word, at)
            case ast.UnaryOp(op, operand) if type(op) in _UNARY:
                return Node(_UNARY[type(op)], at, (self.read(operand),))
            case ast.BinOp(left, ast.Pow(), ast.Constant(2)):
                return Node("square", at, (self.read(left),))
            case ast.BinOp(left, op, right) if type(op) in _BINARY:
                parts = (self.read(left), self.read(right))
                return Node(_BINARY[type(op)], at, parts)
            case ast.BoolOp(op, values):
                return _chain(_BINARY[type(op)], at, [self.read(x) for x in values])
            case ast.Compare(left, ops, right):
                return self._comparison(at, ops, [left, *right])
            case ast.Call(ast.Name(word), arguments, keywords):
                return self._call(word, at, arguments, keywords)
            case ast.Attribute():
                fail("Names are written with an underscore for a dot or a slash.", at)
            case _:
                fail("A formula has names, numbers, + - * / **, comparisons and "
                      f"{', '.join(FUNCTIONS)}, and not this.", at)  # fmt: skip

    def _number(self, value: object, at: int) -> Node:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            fail(f"{value!r} is no number.", at)
        try:
            with np.errstate(over="ignore"):
                number = float(np.float32(float(value)))
        except OverflowError:
            number = np.inf
        if not np.isfinite(number):
            fail("This number is too large: a float32 is not finite.", at)
        return Node("constant", at, constant=number)

    def _word(self, word: str, at: int) -> Node:
        if word in self._names:
            return Node("entry", at, place=self._names[word])
        if word in self._actions:
            return Node("action", at, place=self._actions[word])
        if word == "effort":
            return Node("effort", at)
        if word in _CONSTANTS:
            return Node("constant", at, constant=_CONSTANTS[word])
        if word in FUNCTIONS:
            fail(f"{word} is a function: its arguments in brackets are missing.", at)
        _unknown(word, [*self._names, *self._actions, "effort", *_CONSTANTS], at)

    def _comparison(
        self, at: int, ops: Sequence[ast.cmpop], sides: Sequence[ast.expr]
    ) -> Node:
        read = [self.read(side) for side in sides]
        found: list[Node] = []
        for op, (left, right) in zip(ops, itertools.pairwise(read), strict=True):
            if isinstance(op, ast.NotEq):
                equal = Node("equal", at, (left, right))
                found.append(Node("not", at, (equal,)))
            elif type(op) in _COMPARISONS:
                name, is_turned = _COMPARISONS[type(op)]
                parts = (right, left) if is_turned else (left, right)
                found.append(Node(name, at, parts))
            else:
                fail("Comparisons are < <= > >= == and !=.", at)
        return _chain("and", at, found)

    def _call(
        self,
        word: str,
        at: int,
        arguments: Sequence[ast.expr],
        keywords: Sequence[ast.keyword],
    ) -> Node:
        if word not in FUNCTIONS:
            _unknown(word, FUNCTIONS, at)
        if keywords:
            fail(f"{word} takes its arguments in their order, without names.", at)
        wanted = OPERATIONS[word][0]
        has_more = word in ("min", "max")
        count = len(arguments)
        if count < wanted or (count > wanted and not has_more):
            more = " or more" if has_more else ""
            fail(f"{word} takes {wanted}{more}, not {count}, arguments.", at)
        parts = [self.read(argument) for argument in arguments]
        return _chain(word, at, parts) if has_more else Node(word, at, tuple(parts))


def _unknown(word: str, known: Sequence[str], at: int) -> NoReturn:
    near = ", ".join(nearest(word, known) or known[:8])
    fail(f"There is no {word!r}, but {near}.", at)


def _chain(name: str, at: int, parts: Sequence[Node]) -> Node:
    """Returns an operation of two, done to one part after the other."""
    first, *others = parts
    for other in others:
        first = Node(name, at, (first, other))
    return first
