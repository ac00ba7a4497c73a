"""Rewards as lines of text, which a planner takes as data: nothing is compiled anew."""

from jaxpets._src.formula import Formula, reward
from jaxpets._src.formula_program import FormulaError
from jaxpets._src.formula_text import FUNCTIONS, names, parse

__all__ = ["FUNCTIONS", "Formula", "FormulaError", "names", "parse", "reward"]
