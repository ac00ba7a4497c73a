"""Operations of a formula, as few registers as will do, and what is wrong with one."""

from typing import NamedTuple, NoReturn

import jax.numpy as jnp
import numpy as np

from jaxpets._src.formula import (
    MAX_ENTRIES,
    MAX_OPERANDS,
    MAX_OPERATIONS,
    OPCODES,
    WORK_REGISTERS,
    Formula,
)


class FormulaError(ValueError):
    """A text is no formula.

    Attributes:
      message: one sentence that says why.
      column: where in the text, from 0; its length at the end.
    """

    def __init__(self, message: str, column: int) -> None:
        super().__init__(f"{message} (character {column + 1})")
        self.message = message
        self.column = column


class Node(NamedTuple):
    """An operation, or an entry that is read, with what it is done to."""

    name: str  # of an operation; "entry" for what needs none
    column: int
    parts: tuple["Node", ...] = ()
    place: int = 0  # of an entry or an action
    constant: float = 0.0


def fail(message: str, column: int) -> NoReturn:
    """Raises FormulaError."""
    raise FormulaError(message, column)


class Program:
    """Writes a tree down as operations, in as few registers as will do."""

    def __init__(self) -> None:
        self._opcodes = np.zeros(MAX_OPERATIONS, np.int32)
        self._operands = np.zeros((MAX_OPERATIONS, MAX_OPERANDS), np.int32)
        self._results = np.zeros(MAX_OPERATIONS, np.int32)
        self._constants = np.zeros(MAX_OPERATIONS, np.float32)
        self._entries: list[int] = []
        self._size = 0

    def formula(self, tree: Node) -> Formula:
        """Returns the program of a tree; call it once."""
        if tree.name == "entry":  # the result must be in the first register
            tree = Node("copy", tree.column, (tree,))
        if _num_operations(tree, {}) > MAX_OPERATIONS:
            fail(f"This is longer than {MAX_OPERATIONS} operations.", tree.column)
        self._write(tree, 0)
        entries = np.zeros(MAX_ENTRIES, np.int32)
        entries[: len(self._entries)] = self._entries
        return Formula(
            jnp.asarray(self._opcodes),
            jnp.asarray(self._operands),
            jnp.asarray(self._results),
            jnp.asarray(self._constants),
            jnp.asarray(entries),
            jnp.asarray(self._size, jnp.int32),
        )

    def _write(self, node: Node, free: int) -> int:
        """Appends a tree that works from register `free` on, and returns its result."""
        if node.name == "entry":
            return WORK_REGISTERS + self._entry(node)
        # What needs the most registers goes first, while all of them are free.
        order = sorted(range(len(node.parts)), key=lambda i: -_need(node.parts[i]))
        operands = [0] * len(node.parts)
        held = free
        for i in order:
            operands[i] = self._write(node.parts[i], held)
            held += operands[i] < WORK_REGISTERS
        if free >= WORK_REGISTERS:
            fail("This is nested too deeply.", node.column)
        here = self._size
        self._opcodes[here] = OPCODES[node.name]
        self._operands[here, : len(operands)] = operands
        if node.name == "action":
            self._operands[here, 0] = node.place
        self._results[here] = free
        self._constants[here] = node.constant
        self._size += 1
        return free

    def _entry(self, node: Node) -> int:
        if node.place not in self._entries:
            if len(self._entries) == MAX_ENTRIES:
                fail(f"This is the name after {MAX_ENTRIES} others.", node.column)
            self._entries.append(node.place)
        return self._entries.index(node.place)


def _num_operations(node: Node, known: dict[int, int]) -> int:
    """Returns how many operations a tree is, of which shared parts count each time.

    Comparisons in a chain share sides: each in the next doubles what would be written.
    """
    if id(node) not in known:
        parts = sum(_num_operations(part, known) for part in node.parts)
        known[id(node)] = parts + (node.name != "entry")
    return known[id(node)]


def _need(node: Node) -> int:
    """Returns how many registers a tree needs (Sethi and Ullman, 1970)."""
    if node.name == "entry":
        return 0
    needs = sorted((_need(part) for part in node.parts), reverse=True)
    return max([1, *(need + i for i, need in enumerate(needs) if need)])
