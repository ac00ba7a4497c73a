"""What JAX's primitives are in C++, for a function of one particle's numbers."""

import math

# One C++ expression per element; {0}, {1}, ... are the operands.
ELEMENTWISE = {
    "abs": "fabsf({0})",
    "add": "({0} + {1})",
    "and": "({0} && {1})",
    "atan2": "atan2f({0}, {1})",
    "ceil": "ceilf({0})",
    "clamp": "lower(higher({1}, {0}), {2})",
    "copy": "{0}",
    "cos": "cosine({0})",
    "div": "({0} / {1})",
    "eq": "({0} == {1})",
    "exp": "fast_exp({0})",
    "floor": "floorf({0})",
    "ge": "({0} >= {1})",
    "gt": "({0} > {1})",
    "is_finite": "(fabsf({0}) <= 3.402823466e38f)",
    "le": "({0} <= {1})",
    "log": "logf({0})",
    "log1p": "log1pf({0})",
    "logistic": "fast_inverse(1.0f + fast_exp(-{0}))",
    "lt": "({0} < {1})",
    "max": "higher({0}, {1})",
    "min": "lower({0}, {1})",
    "mul": "({0} * {1})",
    "ne": "({0} != {1})",
    "neg": "(-{0})",
    "not": "(!{0})",
    "or": "({0} || {1})",
    "pow": "powf({0}, {1})",
    "rsqrt": "(1.0f / sqrtf({0}))",
    "select_n": "({0} ? {2} : {1})",
    "sin": "sine({0})",
    "sqrt": "sqrtf({0})",
    "square": "({0} * {0})",
    "stop_gradient": "{0}",
    "sub": "({0} - {1})",
    "tan": "tanf({0})",
    "tanh": "tanhf({0})",
}
# What to do with two elements, and what is left without any.
REDUCTIONS = {
    "reduce_sum": ("add", 0.0),
    "reduce_max": ("max", -math.inf),
    "reduce_min": ("min", math.inf),
}
# They only move elements: what they do to numbers, they do to names.
MOVES = {
    "broadcast_in_dim",
    "concatenate",
    "dynamic_slice",
    "expand_dims",
    "gather",
    "pad",
    "reshape",
    "rev",
    "slice",
    "split",
    "squeeze",
    "stack",
    "tile",
    "transpose",
    "unstack",
}
CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")
