"""A reward as data: a short list of operations that one compiled program carries out.

`jaxpets._src.formula_text` makes it of a line of text.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_record

_LAX: Any = jax.lax  # loops and slices of JAX leave their types open

MAX_OPERATIONS = 64
"""How long a formula may be: functions, signs and numbers."""

MAX_ENTRIES = 16
"""How many different entries of an observation a formula may read."""

WORK_REGISTERS = 8
MAX_OPERANDS = 4


class Formula(NamedTuple):
    """A reward as data: it reads the state that is reached, and the action.

    A program for a machine whose registers hold a number for every particle: eight
    to work in, the first of which is the result, then the entries that it reads.

    Attributes:
      opcodes: `[64]` int32, what each operation does.
      operands: `[64, 4]` int32, the registers that it reads, as many as it needs; of
        the load of an action, its place.
      results: `[64]` int32, the register that it writes.
      constants: `[64]` float32, the number that it loads, if any.
      entries: `[16]` int32, the places in the observation of what it reads.
      size: `[]` int32, how many operations there are; the others are never looked at.
    """

    opcodes: Array
    operands: Array
    results: Array
    constants: Array
    entries: Array
    size: Array


def _tolerance(x: Array, low: Array, high: Array, margin: Array) -> Array:
    outside = jnp.maximum(jnp.maximum(low - x, x - high), 0.0)
    # Tassa et al., 2018, section 2: a Gaussian that is 0.1 at the margin.
    soft = jnp.exp(math.log(0.1) * jnp.square(outside / margin))
    return jnp.where(margin > 0.0, soft, _number(outside == 0.0))


def _number(condition: Array) -> Array:
    return condition.astype(jnp.float32)


def _is(test: Callable[..., Array]) -> Callable[..., Array]:
    """Returns a test whose answer is a number: 1 for yes, 0 for no."""
    return lambda *values: _number(test(*values))


def _where(condition: Array, x: Array, y: Array) -> Array:
    return jnp.where(condition != 0.0, x, y)


LOADS = ("constant", "action", "effort")
"""The operations that read no register; their opcodes are the first."""

# By name: how many registers it reads, and what it makes of them.
OPERATIONS: dict[str, tuple[int, Callable[..., Array]]] = {
    "copy": (1, jnp.positive),
    "negative": (1, jnp.negative),
    "not": (1, _is(jnp.logical_not)),
    "abs": (1, jnp.abs),
    "sqrt": (1, jnp.sqrt),
    "exp": (1, jnp.exp),
    "log": (1, jnp.log),
    "sin": (1, jnp.sin),
    "cos": (1, jnp.cos),
    "tanh": (1, jnp.tanh),
    "square": (1, jnp.square),
    "sign": (1, jnp.sign),
    "add": (2, jnp.add),
    "subtract": (2, jnp.subtract),
    "multiply": (2, jnp.multiply),
    "divide": (2, jnp.divide),
    "power": (2, jnp.power),
    "min": (2, jnp.minimum),
    "max": (2, jnp.maximum),
    "less": (2, _is(jnp.less)),
    "less_equal": (2, _is(jnp.less_equal)),
    "equal": (2, _is(jnp.equal)),
    "and": (2, _is(jnp.logical_and)),
    "or": (2, _is(jnp.logical_or)),
    "where": (3, _where),
    "clip": (3, jnp.clip),
    "tolerance": (4, _tolerance),
}

OPCODES = {name: i for i, name in enumerate((*LOADS, *OPERATIONS))}


def reward(formula: Formula, obs: Array, action: Array, next_obs: Array) -> Array:
    """Returns what a formula says of a step: a RewardFn whose data is the formula.

    Every formula runs in the same program, so that a planner, once compiled, takes any
    of them as `PlanParams.reward`. An operation is one pass over all particles. The
    program has a loop whose length is data: it may be mapped, over formulas too, at
    the cost of all operations in place of each, but not differentiated in reverse.

    Args:
      formula: from `formulas.parse`.
      obs: `[..., D]`, not looked at.
      action: `[..., A]`, whose leading axes broadcast with those of next_obs.
      next_obs: `[..., D]`, the state that is reached.

    Returns:
      `[...]`, in the unit of the formula. Where it has no value, as at a division by
      zero or where an entry that it reads is not finite, neither is it, which `plan`
      rejects. A comparison, `clip`, `tanh` or `tolerance` of what has no value may
      have one.

    Raises:
      TypeError: if formula is not a Formula.
    """
    check_record("formula", formula, Formula)
    shape = jnp.broadcast_shapes(action.shape[:-1], next_obs.shape[:-1])
    effort = jnp.sum(jnp.square(action), axis=-1)

    def filled(value: Array) -> Array:
        return jnp.broadcast_to(value, shape)

    def compute(
        count: int, fn: Callable[..., Array], registers: Array, operand: Array, _: Array
    ) -> Array:
        return fn(*(_at(registers, operand[k], 0) for k in range(count)))

    def constant(_: Array, __: Array, number: Array) -> Array:
        return filled(number)

    def of_action(_: Array, operand: Array, __: Array) -> Array:
        return filled(_at(action, operand[0], -1))

    def of_effort(_: Array, __: Array, ___: Array) -> Array:
        return filled(effort)

    branches = [
        constant,
        of_action,
        of_effort,
        *(functools.partial(compute, *operation) for operation in OPERATIONS.values()),
    ]

    def step(i: Array, registers: Array) -> Array:
        operand, number = formula.operands[i], formula.constants[i]
        value = _LAX.switch(formula.opcodes[i], branches, registers, operand, number)
        return _LAX.dynamic_update_index_in_dim(registers, value, formula.results[i], 0)

    # Read before the loop: in it, XLA would copy the whole path for every entry.
    entries = [
        filled(_at(next_obs, formula.entries[k], -1)) for k in range(MAX_ENTRIES)
    ]
    work = [jnp.zeros(shape, jnp.float32)] * WORK_REGISTERS
    result = _LAX.fori_loop(0, formula.size, step, jnp.stack(work + entries))[0]
    # Comparisons would answer for a NaN, too.
    known = [
        jnp.isfinite(entry) | ~is_read
        for entry, is_read in zip(entries, _are_read(formula), strict=True)
    ]
    return jnp.where(functools.reduce(jnp.logical_and, known), result, jnp.nan)


def _are_read(formula: Formula) -> Array:
    """Tells `[MAX_ENTRIES]` which entries a formula reads; slots without one hold 0."""
    is_load = formula.opcodes < len(LOADS)
    registers = jnp.where(is_load[:, None], 0, formula.operands)
    slots = WORK_REGISTERS + jnp.arange(MAX_ENTRIES, dtype=jnp.int32)
    return jnp.any(registers[..., None] == slots, axis=(0, 1))


def _at(row: Array, place: Array, axis: int) -> Array:
    return _LAX.dynamic_index_in_dim(row, place, axis, keepdims=False)
