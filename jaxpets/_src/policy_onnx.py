"""A policy as a model in ONNX, for programs without JAX."""

import importlib
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxpets._src.action_box import action_box
from jaxpets._src.actor_critic_networks import CLIP, layers_of
from jaxpets._src.actor_critic_records import ActorCriticParams
from jaxpets._src.check_space import check_space_size
from jaxpets._src.checks import check_array
from jaxpets._src.ensemble import delta_space
from jaxpets._src.network import NORM_EPSILON
from jaxpets._src.types import Coordinate, ModelSpace

_OPSET = 17  # the first with LayerNormalization
# The body's x and y axes in the world, as `coordinates.space` has them: a constant, and
# products of two entries of the quaternion with their factors.
_AXES = (
    (1.0, {(2, 2): -2.0, (3, 3): -2.0}),
    (0.0, {(1, 2): 2.0, (0, 3): 2.0}),
    (0.0, {(1, 3): 2.0, (0, 2): -2.0}),
    (0.0, {(1, 2): 2.0, (0, 3): -2.0}),
    (1.0, {(1, 1): -2.0, (3, 3): -2.0}),
    (0.0, {(2, 3): 2.0, (0, 1): 2.0}),
)


class _Read(NamedTuple):
    """How features are read: linear in entries, their sines, cosines and products."""

    angles: list[int]
    pairs: list[tuple[int, int]]
    matrix: np.ndarray  # [D + angles + angles + pairs, F]
    offset: np.ndarray  # [F]


def to_onnx(
    params: ActorCriticParams,
    space: ModelSpace,
    *,
    obs_size: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
) -> bytes:
    """Returns a policy as an ONNX model, which runs without JAX.

    Its inputs are `obs`, float32 `[N, D]`, and, if the policy sees anything of its
    task, `task`, float32 `[N, G]`, what `Goals.features` says of it. Its output is
    `action`, `[N, A]`. It is what the policy of `distill` or `policies.actor_critic`
    does, to rounding. Needs the extra `jaxpets[onnx]`.

    In a loop, bind arrays once by `io_binding()` of the session, `bind_cpu_input` and
    `bind_output`: `run_with_iobinding` then reads and writes them where they are, in
    four fifths of the time of `run`, 13 to 23 microseconds on one core.

    Args:
      params: of the policy.
      space: that it was built with: `delta_space` or one of `coordinates.space`.
      obs_size: D.
      action_low: `[A]`, likewise.
      action_high: `[A]`.

    Raises:
      TypeError, ValueError: if an argument is not what it should be, or the features
        of the space are functions of your own.
      ImportError: without the package onnx.
    """
    check_space_size(space, obs_size)
    layers = layers_of(params)
    box = action_box(action_low, action_high)
    read = _read(space, obs_size)
    mean, std = np.asarray(params.mean), np.asarray(params.std)
    goal_size = mean.shape[0] - read.offset.shape[0]
    if goal_size < 0:
        raise ValueError(
            f"space must have at most the {mean.shape[0]} features that the policy "
            f"reads, got {read.offset.shape[0]} of obs_size {obs_size}."
        )
    bias = layers["Dense_2"]["bias"]
    check_array("the last bias of params.actor", bias, [box.center.shape[0]])
    graph = _Graph()
    # An entry that is not read may be anything: times 0, a NaN would be one.
    plain = np.flatnonzero(read.matrix[:obs_size].any(1)).tolist()
    read_rows = np.concatenate([read.matrix[plain], read.matrix[obs_size:]])
    parts = [graph.entries(plain)] if plain else []
    if read.angles:
        angle = graph.entries(read.angles)
        parts += [graph.node("Sin", angle), graph.node("Cos", angle)]
    if read.pairs:
        first, second = (graph.entries(list(x)) for x in zip(*read.pairs, strict=True))
        parts.append(graph.node("Mul", first, second))
    if goal_size:
        parts.append("task")
    x = graph.node("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]
    size = read_rows.shape[0] + goal_size
    matrix = np.zeros((size, mean.shape[0]), np.float32)
    matrix[: size - goal_size, : mean.shape[0] - goal_size] = read_rows
    matrix[size - goal_size :, mean.shape[0] - goal_size :] = np.eye(goal_size)
    if read.pairs:
        offset = np.concatenate([read.offset, np.zeros(goal_size, np.float32)])
        x = graph.node("Gemm", x, graph.array(matrix), graph.array(offset))
    else:  # the features, but in another order, which means and weights take over
        order, layer = matrix.argmax(axis=1), layers["Dense_0"]
        mean, std = mean[order], std[order]
        kernel = np.asarray(layer["kernel"])[order]
        layers = {**layers, "Dense_0": {**layer, "kernel": kernel}}
    # Not part of a product: digits are lost where the mean is large beside the std.
    x = graph.node("Sub", x, graph.array(mean))
    x = graph.node("Div", x, graph.array(std))
    x = graph.node("Clip", x, graph.array(-CLIP), graph.array(CLIP))
    for i in range(2):
        x = graph.dense(x, layers[f"Dense_{i}"])
        norm = layers[f"LayerNorm_{i}"]
        scaled = (graph.array(norm["scale"]), graph.array(norm["bias"]))
        x = graph.node("LayerNormalization", x, *scaled, epsilon=NORM_EPSILON)
        x = graph.node("Elu", x)
    x = graph.node("Tanh", graph.dense(x, layers["Dense_2"]))
    # Each node takes a microsecond; a box from -1 to 1 needs none of these.
    if np.any(box.half_width != 1.0):
        x = graph.node("Mul", x, graph.array(box.half_width))
    if np.any(box.center != 0.0):
        graph.node("Add", x, graph.array(box.center))
    inputs = {"obs": obs_size} | ({"task": goal_size} if goal_size else {})
    return graph.model(inputs, "action", box.center.shape[0])


class _Graph:
    """Nodes and constants, as they come."""

    def __init__(self) -> None:
        self._onnx: Any = _package()
        self._nodes: list[Any] = []
        self._arrays: list[Any] = []

    def node(self, kind: str, *inputs: str, **options: Any) -> str:
        """Adds a node and returns the name of its output."""
        name = f"x{len(self._nodes)}"
        make = self._onnx.helper.make_node
        self._nodes.append(make(kind, inputs, [name], **options))
        return name

    def array(self, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant and returns its name."""
        name, make = f"c{len(self._arrays)}", self._onnx.numpy_helper.from_array
        self._arrays.append(make(np.asarray(value, dtype), name))
        return name

    def dense(self, x: str, layer: Any) -> str:
        """Adds a layer of Flax."""
        weights = (self.array(layer["kernel"]), self.array(layer["bias"]))
        return self.node("Gemm", x, *weights)

    def entries(self, which: list[int]) -> str:
        """Adds columns of the observation."""
        return self.node("Gather", "obs", self.array(which, np.int64), axis=1)

    def model(self, inputs: dict[str, int], output: str, size: int) -> bytes:
        """Returns all of it as a file has it, rows of any number.

        Args:
          inputs: how many entries each has.
          output: what the last node's is named.
          size: its entries.
        """
        self._nodes[-1].output[0] = output
        helper, float32 = self._onnx.helper, self._onnx.TensorProto.FLOAT

        def rows(sizes: dict[str, int]) -> list[Any]:
            make = helper.make_tensor_value_info
            return [make(name, float32, ["N", size]) for name, size in sizes.items()]

        graph = helper.make_graph(
            self._nodes, "policy", rows(inputs), rows({output: size}), self._arrays
        )
        opset = helper.make_opsetid("", _OPSET)
        # The oldest format that has this opset, so that old runtimes read it.
        model = helper.make_model(graph, opset_imports=[opset], ir_version=8)
        self._onnx.checker.check_model(model)
        return model.SerializeToString()


def _package() -> Any:
    # Not before it is needed: all else of the library works without it.
    try:
        return importlib.import_module("onnx")
    except ImportError as error:
        raise ImportError(
            "to_onnx needs the extra jaxpets[onnx]: pip install 'jaxpets[onnx]'"
        ) from error


def _read(space: ModelSpace, obs_size: int) -> _Read:
    if not space.coordinates:
        if space != delta_space():
            raise ValueError(
                "space must be delta_space() or of coordinates.space; its features are "
                "functions of your own, which ONNX cannot hold."
            )
        rows = tuple(Coordinate(str(i)) for i in range(obs_size))
    else:
        rows = space.coordinates
    inputs = [i for i, row in enumerate(rows) if row.is_input]
    angles = [i for i in inputs if rows[i].kind == "angle"]
    turns = [i for i in inputs if rows[i].kind == "quaternion"][::4]
    products = sorted({pair for _, terms in _AXES for pair in terms})
    pairs = [(start + a, start + b) for start in turns for a, b in products]
    size = obs_size + 2 * len(angles) + len(pairs)
    columns: list[tuple[float, dict[int, float]]] = []
    for i in inputs:
        if rows[i].kind == "angle":
            sine = obs_size + angles.index(i)
            columns += [(0.0, {sine: 1.0}), (0.0, {sine + len(angles): 1.0})]
        elif rows[i].kind == "quaternion":
            if i not in turns:
                continue
            first = size - len(pairs) + turns.index(i) * len(products)
            for offset, terms in _AXES:
                where = {first + products.index(x): terms[x] for x in terms}
                columns.append((offset, where))
        else:
            columns.append((0.0, {i: 1.0}))
    matrix = np.zeros((size, len(columns)), np.float32)
    for j, (_, terms) in enumerate(columns):
        for i, factor in terms.items():
            matrix[i, j] = factor
    return _Read(angles, pairs, matrix, np.asarray([x for x, _ in columns], np.float32))
