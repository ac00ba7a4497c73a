"""The kernel's sizes fit the GPU, and parameters lie where it reads them."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from layers import PLACES, SIZES, fragment_place, layers_of, unpacked

from jaxpets._src.kernel.mma_layout import MmaLayout
from jaxpets._src.kernel.wgmma_layout import SHARED_MEMORY, WgmmaLayout
from jaxpets._src.network import ACTIVATIONS

WGMMA = {f"wgmma {name}": WgmmaLayout(*sizes) for name, sizes in SIZES.items()}
LAYOUTS = WGMMA | {f"mma {name}": MmaLayout(*sizes) for name, sizes in SIZES.items()}
SMALL, PAPER = WGMMA["wgmma small"], WGMMA["wgmma paper"]


@pytest.mark.parametrize("name", LAYOUTS)
def test_parameters_lie_as_documented(name):
    layout, layers = LAYOUTS[name], layers_of(LAYOUTS[name])
    packed = jax.jit(layout.pack)(layers)
    assert packed.dtype == jnp.float16
    rest = np.float64(packed)
    width, left, head = layout.width, layout.left, layout.head
    cut, place = isinstance(layout, WgmmaLayout), PLACES[type(layout)]
    assert 0 < width - left <= left if cut else left == width
    rows = [layout.input_size] + [width] * len(layout.hidden_sizes)
    for i, (layer, size) in enumerate(zip(layers, rows, strict=True)):
        kernel, bias = (np.float64(layer[name]) for name in ("kernel", "bias"))
        is_head = i == len(layers) - 1
        if is_head:
            found, rest = unpacked(rest, size, 2 * head, place)
            entries = np.arange(layout.obs_size)
            columns = np.concatenate([entries, head + entries])
            if not cut:  # 8 means and their log-variances in turn
                columns = np.arange(2 * head).reshape(-1, 2, 8).swapaxes(0, 1)
                columns = columns.reshape(2, head)[:, : layout.obs_size].ravel()
        else:
            halves = []
            for columns in (left, width - left):
                half, rest = unpacked(rest, size, columns, place)
                halves.append(half)
            found = np.concatenate(halves, axis=-1)
            columns = np.arange(kernel.shape[2])
            kernel, bias = kernel / 2, bias / 2  # swish(2 h) = h + h tanh(h)
        inner = kernel.shape[1]
        # Float16 has 11 bits, two of them 22; but 2^-24 is the least number.
        got = found[:, :inner, columns]
        np.testing.assert_allclose(got, kernel, rtol=2**-11, atol=2**-25)
        got = found[:, size, columns] + found[:, size + 1, columns]
        np.testing.assert_allclose(got, bias, rtol=2**-21, atol=2**-24)
        # Everything else is zero.
        found[:, :inner, columns] = found[:, size : size + 2, columns] = 0
        assert not found.any()
    assert rest.shape == (2, 0)


@pytest.mark.gpu
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_gpu_packs_the_same(name):
    """Also what rounding leaves of a bias, where XLA may leave out the rounding."""
    layout, layers = LAYOUTS[name], layers_of(LAYOUTS[name])
    expected = jax.jit(layout.pack)(layers)
    with jax.default_device(jax.devices("gpu")[0]):
        packed = jax.jit(layout.pack)(layers)
    np.testing.assert_array_equal(packed, expected)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_sources_have_the_same_sizes(assert_constants, name):
    layout = LAYOUTS[name]
    packed = jax.eval_shape(layout.pack, layers_of(layout))
    sizes = {
        "LEFT": layout.left,
        "RIGHT": layout.width - layout.left,
        "HEAD": layout.head,
        "MEMBER_WEIGHTS": packed.shape[1],
        "mean_column(OBS - 1)": layout.obs_size - 1,
        "variance_column(OBS - 1)": layout.head + layout.obs_size - 1,
    }
    place = PLACES[type(layout)]
    if place is fragment_place:
        last, in_eight = divmod(layout.obs_size - 1, 8)
        sizes["mean_column(OBS - 1)"] = 16 * last + in_eight
        sizes["variance_column(OBS - 1)"] = 16 * last + 8 + in_eight
    for row, column in np.ndindex(16, layout.left):
        name = f"place({row}, {column}, LEFT)"
        sizes[name] = int(place(row, column, layout.left))
    assert_constants("gpu_layout.h", layout.header(), sizes)


def test_what_float16_cannot_hold_is_as_large_as_can_be():
    layers = layers_of(SMALL)
    layers[0]["kernel"][0, 0, 0] = 1e6
    layers[0]["kernel"][0, 0, 1] = -np.inf
    layers[0]["kernel"][1, 0, 0] = np.nan
    packed = np.float64(jax.jit(SMALL.pack)(layers))
    found, _ = unpacked(packed, SMALL.input_size, SMALL.left)
    assert found[0, 0, 0] == 65504 and found[0, 0, 1] == -65504
    assert np.isnan(found[1, 0, 0])
    assert np.isfinite(packed[0]).all()


def test_a_bias_that_is_tiny_huge_or_no_number_lies_in_two_rows_as_well():
    layers, rows = layers_of(SMALL), SMALL.input_size
    biases = np.array([2e-5, -1e-6, 70_000, 1e9, -np.inf, np.nan], np.float32)
    layers[0]["bias"][0, : biases.size] = 2 * biases
    packed = np.float64(jax.jit(SMALL.pack)(layers))
    found, _ = unpacked(packed, rows, SMALL.left)
    got = found[0, rows, : biases.size] + found[0, rows + 1, : biases.size]
    expected = np.clip(biases, -2 * 65504, 2 * 65504)
    np.testing.assert_allclose(got, expected, rtol=2**-21, atol=2**-25)


def test_members_do_not_mix():
    layers = layers_of(SMALL, members=3)
    pack = jax.jit(SMALL.pack)
    packed = pack(layers)
    for e in range(3):
        one = pack(jax.tree.map(lambda x, e=e: x[e : e + 1], layers))
        np.testing.assert_array_equal(packed[e], one[0])


def bytes_of(layout, streaming):
    """Shared memory as wgmma_memory.h declares it."""
    inputs = -(-(layout.input_size + 2) // 16)
    hidden = -(-(layout.width + 2) // 16)
    right = layout.width - layout.left
    numbers = inputs * 16 * layout.width + hidden * 16 * 2 * layout.head
    for _ in layout.hidden_sizes[1:]:
        numbers += (hidden - streaming.left) * 16 * layout.left
        numbers += (hidden - streaming.right) * 16 * right
    numbers += streaming.slots * streaming.unit * 16 * layout.left
    words = -(-layout.obs_size // 4)
    shared = 2 * 4 * -(-layout.input_size // 4) + 4 * 4 * words
    stride = 4 * (words if words % 2 else words + 1)
    row = 4 * 2 * stride + 2 * (inputs * 16 + 8) + 4 * 2  # state, target, offsets
    rows = 64 * row + max(64 * row, 16 * (row + 2 * (hidden * 16 + 8)))
    barriers = 8 * (1 + 2 * streaming.slots + 4)
    return 2 * numbers + 4 * shared + rows + barriers


def test_every_model_that_is_accepted_fits_into_shared_memory():
    """And keeps there as much as it can."""
    fitting = []
    for width in (1, 24, 25, 32, 64, 100, 128, 200, 240, 256):
        for depth in (1, 2, 4, 8):
            for obs_size, inputs in ((1, 1), (8, 4), (18, 6), (47, 30), (128, 128)):
                layout = WgmmaLayout(obs_size, inputs, obs_size, (width,) * depth)
                streaming = layout.streaming()
                if streaming is None:
                    assert layout.problem() is not None
                    continue
                assert layout.problem() is None
                fitting.append((width, depth, obs_size))
                hidden = -(-(layout.width + 2) // 16)
                assert bytes_of(layout, streaming) <= SHARED_MEMORY
                for part in (streaming.left, streaming.right):
                    assert 0 <= part <= hidden and part % streaming.unit == 0
                assert 0 < streaming.unit <= hidden and streaming.slots in (2, 3)
                if streaming.right:  # the left half streams first, as far as it can
                    assert streaming.left == hidden // streaming.unit * streaming.unit
                if streaming.left:
                    assert bytes_of(layout, stayed(streaming)) > SHARED_MEMORY - 2048
    assert (256, 8, 18) in fitting and (128, 8, 47) in fitting
    assert (256, 1, 128) not in fitting


def stayed(streaming):
    """The same, but one unit less streams."""
    name = "right" if streaming.right else "left"
    less = getattr(streaming, name) - streaming.unit
    return dataclasses.replace(streaming, **{name: less})


def test_a_small_model_stays_in_shared_memory():
    streaming = SMALL.streaming()
    assert (streaming.left, streaming.right) == (0, 0)
    assert PAPER.streaming().left > 0


TOO_LARGE = "the model does not fit into the GPU's shared memory"


@pytest.mark.parametrize(
    ("layout", "sizes", "problem"),
    [
        (WgmmaLayout, (18, 6, 18, (256, 8)), None),
        (WgmmaLayout, (18, 6, 18, ()), "there is no hidden layer"),
        (WgmmaLayout, (18, 6, 18, (8, 257)), "hidden layers are wider than 256"),
        (WgmmaLayout, (128, 6, 18, (64,)), None),
        (WgmmaLayout, (129, 6, 18, (64,)), "observations have more than 128 entries"),
        (WgmmaLayout, (18, 56, 200, (64,)), None),
        (WgmmaLayout, (18, 57, 200, (64,)), "features and action have more than 256"),
        (WgmmaLayout, (128, 128, 128, (256,)), TOO_LARGE),
        # Where all weights stream there is room for some particles of any model.
        (MmaLayout, (256, 256, 256, (512,) * 8), None),
        (MmaLayout, (18, 6, 18, ()), "there is no hidden layer"),
        (MmaLayout, (18, 6, 18, (8, 513)), "hidden layers are wider than 512"),
        (MmaLayout, (257, 6, 18, (64,)), "observations have more than 256 entries"),
        (MmaLayout, (18, 57, 456, (64,)), "features and action have more than 512"),
    ],
)
def test_what_is_too_large_is_said(layout, sizes, problem):
    found = layout(*sizes).problem()
    assert found is None if problem is None else found.startswith(problem)


def test_only_what_a_kernel_doubles_is_halved():
    layers = layers_of(SMALL)
    packed = {name: SMALL.pack(layers, name) for name in ACTIVATIONS}
    assert (packed["gelu"] == packed["swish"]).all()
    assert (packed["tanh"] == packed["relu"]).all()
    assert (packed["tanh"] != packed["swish"]).any()


def test_the_header_has_every_constant():
    streaming = PAPER.streaming()
    pairs = re.findall(r"constexpr int (\w+) = (\d+);", PAPER.header())
    assert len(pairs) == len(PAPER.header().splitlines())
    assert {name: int(value) for name, value in pairs} == {
        "OBS": 18,
        "ACTION": 6,
        "FEATURES": 18,
        "WIDTH": 200,
        "LAYERS": 4,
        "LEFT": 112,
        "FRAGMENTS": 0,
        "LEFT_STREAMED": streaming.left,
        "RIGHT_STREAMED": streaming.right,
        "UNIT": streaming.unit,
        "SLOTS": streaming.slots,
    }


@pytest.mark.parametrize("name", WGMMA)
def test_one_instruction_for_each_width_of_products(name):
    layout = LAYOUTS[name]
    text = layout.products()
    widths = {layout.left, layout.width - layout.left, 2 * layout.head}
    assert text.count("template <> struct Wgmma<") == len(widths)
    for width in widths:
        assert width % 8 == 0 and 8 <= width <= 256  # what the instruction takes
        (body,) = re.findall(
            rf"template <> struct Wgmma<{width}> {{(.*?)\n}};", text, re.DOTALL
        )
        assert f"m64n{width}k16.f32.f16.f16" in body
        assert f"float (&sums)[{width // 2}]" in body
        assert re.findall(r'"\+f"\(sums\[(\d+)\]\)', body) == [
            str(i) for i in range(width // 2)
        ]
        operands = sorted({int(i) for i in re.findall(r"%(\d+)", body)})
        assert operands == list(range(width // 2 + 6))  # a0 to a3, weights, add


def consumer(streaming, layers, steps):
    """What a consumer of wgmma_rollout.cu does with the ring and its turns."""
    fits = streaming.left + streaming.right <= streaming.unit * streaming.slots
    done, unit = [], 0
    for _ in range(steps):
        done += ["begin", "pass"]  # the input layer streams nothing
        for _ in range(layers - 1):
            done.append("begin")
            pending = None
            for half in (streaming.left, streaming.right):
                units = range(unit, unit + half // streaming.unit)
                if fits:
                    done += [("wait", u) for u in units]
                for u in units:
                    done += [] if fits else [("wait", u)]
                    done += [] if pending is None else [("release", pending)]
                    pending = u
                unit = units.stop
            done.append("pass")
            done += [] if pending is None else [("release", pending)]
    return done, unit, fits


def slice_consumer(streaming, layers, steps):
    """What a slice does with the ring: it has no turns, and hands back half by half."""
    done, unit = [], 0
    for _ in range(steps * (layers - 1)):
        for half in (streaming.left, streaming.right):
            units = range(unit, unit + half // streaming.unit)
            for u in units:
                done.append(("wait", u))
                done += [("release", u - 1)] if u > units.start else []
            done += [("release", units.stop - 1)] if units else []
            unit = units.stop
    return done


def finishes(streaming, layers, tiles, slices=0, steps=3):
    """Whether consumers and producer all come to their end."""
    program, num_units, fits = consumer(streaming, layers, steps)
    programs = [program] * tiles + [slice_consumer(streaming, layers, steps)] * slices
    at, fed = [0] * len(programs), 0
    released = [set() for _ in programs]
    passed, begun = [0, 1], [0, 0]  # consumer 1 passes its first turn
    while any(i < len(p) for i, p in zip(at, programs, strict=True)):
        before = fed, list(at)
        free = all(fed - streaming.slots in r for r in released)
        if fed < num_units and (fed < streaming.slots or free):
            fed += 1
        for c, program in enumerate(programs):
            step = program[at[c]] if at[c] < len(program) else ("wait", num_units)
            if step == "begin" and fits and tiles == 2:
                if passed[1 - c] <= begun[c]:
                    continue
                begun[c] += 1
            elif step == "pass":
                passed[c] += 1
            elif step[0] == "release":
                released[c].add(step[1])
            elif step[0] == "wait" and step[1] >= fed:
                continue
            at[c] += 1
        if before == (fed, at):
            return False
    return True


def test_consumers_and_producer_never_wait_for_each_other():
    seen = set()
    for width in range(8, 257, 8):
        for layers in (1, 2, 4, 8):
            streaming = WgmmaLayout(18, 6, 18, (width,) * layers).streaming()
            if streaming is None:
                continue
            assert finishes(streaming, layers, tiles=1)
            assert finishes(streaming, layers, tiles=2)
            assert finishes(streaming, layers, tiles=1, slices=1)
            seen.add(streaming)
    assert len(seen) > 10
    # One slot is too few: a consumer hands a unit back when the next one has begun.
    assert not finishes(dataclasses.replace(PAPER.streaming(), slots=1), 4, tiles=2)
