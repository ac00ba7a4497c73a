import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets import Transition
from jaxpets._src.dataset import AXES, append_stable

CAPACITY = 8
# One program each, and not one for every operation of theirs.
append = jax.jit(jaxpets.datasets.append)
grow = jax.jit(jaxpets.datasets.grow, static_argnums=1)
obs_variance = jax.jit(jaxpets.datasets.obs_variance)
num_stable = jax.jit(jaxpets.datasets.num_stable)


def numbered(first, length):
    """Rows that say when they came."""
    count = np.arange(first, first + length, dtype=np.float32)[:, None]
    rows = np.tile(count, (1, 2)), -count, np.tile(count + np.float32(0.5), (1, 2))
    return Transition(*map(jnp.asarray, rows))


def held(dataset):
    """The valid rows' numbers, sorted."""
    size, data = int(dataset.size), jax.tree.map(np.asarray, dataset.data)
    obs = data.obs[:size, 0]
    np.testing.assert_array_equal(data.action[:size, 0], -obs)
    np.testing.assert_array_equal(data.next_obs[:size, 1], obs + 0.5)
    return sorted(obs.tolist())


def held_in_order(many):
    """The valid rows' numbers of every seed; all of a row are of one number."""
    obs, action, next_obs = (np.asarray(x)[:, : int(many.size), 0] for x in many.data)
    np.testing.assert_array_equal(action, -obs)
    np.testing.assert_array_equal(next_obs, np.where(obs > 0, obs + 0.5, 0.0))
    return obs.tolist()


def test_starts_empty():
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    assert dataset.size == 0 and dataset.size.dtype == jnp.int32
    assert dataset.data.obs.shape == (CAPACITY, 2)
    assert dataset.data.action.shape == (CAPACITY, 1)


@pytest.mark.parametrize(
    "lengths", [[8], [3, 5], [3, 5, 1], [8, 1], [5, 5], [7, 8, 8], [1] * 19]
)
def test_keeps_the_newest_rows(lengths):
    """At capacity, one past it, and round and round, as a bounded queue."""
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    queue = collections.deque(maxlen=CAPACITY)
    first = 0
    for length in lengths:
        dataset = append(dataset, numbered(first, length))
        queue.extend(range(first, first + length))
        first += length
        assert int(dataset.size) == len(queue)
        assert held(dataset) == sorted(queue)


@pytest.mark.parametrize(("count", "wanted"), [(-1, 0), (0, 0), (2, 2), (3, 3), (7, 3)])
def test_no_more_rows_are_counted_than_there_are(count, wanted):
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    after = append(dataset, numbered(1, 3), jnp.int32(count))
    assert after.cursor == wanted and held(after) == [1, 2, 3][:wanted]
    assert toys.avals(after) == toys.avals(dataset)


@pytest.mark.parametrize("count", [jnp.float32(2.5), jnp.arange(3), jnp.array(True)])
def test_rows_are_counted_by_one_integer(count):
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    with pytest.raises(TypeError, match=r"count must be int32\[\], got"):
        append(dataset, numbered(1, 3), count)


def test_one_trace_while_it_grows():
    append = jax.jit(functools.partial(jaxpets.datasets.append))  # a cache of its own
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    want = toys.avals(dataset)
    for first in range(0, 20, 4):
        dataset = append(dataset, numbered(first, 4))
        assert toys.avals(dataset) == want
    assert append._cache_size() == 1


def test_eager_append_keeps_the_avals():
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    assert toys.avals(jaxpets.datasets.append(dataset, numbered(0, 3))) == toys.avals(
        dataset
    )


def test_what_comes_after_physics_diverged_is_no_data():
    rows = jax.tree.map(np.asarray, numbered(0, 5))
    cases = [rows]
    for name in Transition._fields:
        for number in (np.nan, -np.inf, 2e10):
            bad = getattr(rows, name).copy()
            bad[3, 0] = number
            cases.append(rows._replace(**{name: bad}))
    many = jax.tree.map(lambda *x: np.stack(x), *cases)
    many = jax.tree.map(lambda x: np.stack([x, x[:, ::-1]]), many)
    found = num_stable(many)
    assert found.dtype == jnp.int32
    assert found.tolist() == [[5] + [3] * 9, [5] + [1] * 9]


@pytest.mark.parametrize("name", Transition._fields)
def test_one_number_that_is_nan_is_found_in_many_rows(name):
    """XLA's maximum of so many rows on a CPU is that of their other numbers."""
    rows = Transition(*(np.ones((1000, size), np.float32) for size in (18, 6, 18)))
    getattr(rows, name)[700, 1] = np.nan
    assert num_stable(rows) == 700


def test_what_blew_up_to_there_is_no_data_either():
    path = np.float32([0, 1, 4, 6, 13, 80, 70, 150, np.inf])[:, None]
    rows = Transition(path[:-1], 0 * path[:-1], path[1:])
    assert num_stable(rows) == 6  # 70 is not more than 80
    for count in (2, 3, 5, 7):  # whatever has grown, if it did not diverge
        part = jax.tree.map(lambda x, count=count: x[:count], rows)
        assert num_stable(part) == count


def test_rows_that_are_there_take_the_places_of_those_that_are_lost():
    """So that the sizes of seeds are equal, wherever each of them diverged."""
    append_many = jax.jit(jax.vmap(append_stable, (AXES, 0), AXES))
    empty = jaxpets.datasets.init(CAPACITY, 2, 1)
    data = jax.tree.map(lambda x: np.stack([x] * 4), empty.data)
    many = empty._replace(data=data)
    found = []
    for first in (0, 3, 6):
        rows = jax.tree.map(lambda x: np.stack([x] * 4), numbered(first + 1, 3))
        for seed, bad in ((1, 4), (2, 0), (2, 4), (3, 7)):
            if first <= bad < first + 3:
                rows.next_obs[seed, bad - first :, 1] = np.nan
        many = append_many(many, rows)
        found.append(held_in_order(many))
    assert found[0] == [[1, 2, 3], [1, 2, 3], [0, 0, 0], [1, 2, 3]]
    assert found[1][:3] == [[1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 1, 3], [0, 0, 0, 4, 0, 0]]
    # Full, it begins with the oldest again.
    assert found[2][0] == [9, 2, 3, 4, 5, 6, 7, 8]
    assert found[2][3] == [4, 2, 3, 4, 5, 6, 7, 1]
    assert many.size == CAPACITY and many.cursor == 1


def test_a_long_trial_that_diverged_leaves_no_rows_of_zeros():
    """The product of two of its numbers of rows does not fit into int32."""
    known, length = 60_000, 100_000
    filled = append(jaxpets.datasets.init(200_000, 2, 1), numbered(1, known))
    rows = numbered(known + 1, length)
    rows = rows._replace(next_obs=rows.next_obs.at[10].set(jnp.nan))
    after = jax.jit(append_stable)(filled, rows)
    assert after.size == known + length
    again = np.asarray(after.data.obs)[known + 10 : known + length, 0]
    rows_known, num_lost = known + 10, length - 10
    np.testing.assert_array_equal(
        again, 1 + np.arange(num_lost, dtype=np.int64) * rows_known // num_lost
    )


@pytest.mark.parametrize("count", [0, 5, 8, 11])
def test_growing_keeps_every_row_and_the_oldest_goes_first(count):
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    for first in range(count):
        dataset = append(dataset, numbered(first, 1))
    grown = grow(dataset, 12)
    assert grown.data.obs.shape == (12, 2) and grown.size == dataset.size
    rows = list(range(max(0, count - CAPACITY), count))
    np.testing.assert_array_equal(np.asarray(grown.data.obs)[: len(rows), 0], rows)
    assert held(grown) == rows
    # It is a ring of the new capacity: filled to one past it, the oldest row is lost.
    room = 12 - len(rows)
    full = append(grown, numbered(count, room))
    rows += range(count, count + room)
    assert held(full) == rows
    assert held(append(full, numbered(count + room, 1))) == [
        *rows[1:],
        count + room,
    ]
    assert toys.avals(grown.size) == toys.avals(dataset.size)
    assert toys.avals(grown.cursor) == toys.avals(dataset.cursor)


def test_growing_to_the_same_capacity_keeps_the_rows():
    dataset = append(jaxpets.datasets.init(CAPACITY, 2, 1), numbered(0, 8))
    toys.assert_trees_close(jaxpets.datasets.grow(dataset, CAPACITY), dataset, rtol=0)


def test_a_dataset_does_not_shrink():
    with pytest.raises(ValueError, match="capacity must be at least 8, got 7"):
        jaxpets.datasets.grow(jaxpets.datasets.init(CAPACITY, 2, 1), 7)


def test_too_many_rows_fail():
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    with pytest.raises(ValueError, match="capacity of 8, got 9 rows"):
        jaxpets.datasets.append(dataset, numbered(0, 9))


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("obs", jnp.zeros((3, 4)), r"float32\[.*2\], got float32\[3, 4\]"),
        ("action", jnp.zeros((2, 1)), r"float32\[3, 1\], got float32\[2, 1\]"),
        ("next_obs", jnp.zeros((3, 2), jnp.int32), r"float32\[3, 2\], got int32"),
        ("obs", jnp.zeros(2), r"float32\[.*\], got float32\[2\]"),
        ("obs", jnp.float32(0), r"float32\[.*\], got float32\[\]"),
    ],
)
def test_rows_that_do_not_fit_fail(name, value, wanted):
    rows = numbered(0, 3)._replace(**{name: value})
    with pytest.raises(ValueError, match=rf"transitions\.{name} must be {wanted}"):
        jaxpets.datasets.append(jaxpets.datasets.init(CAPACITY, 2, 1), rows)


@pytest.mark.parametrize("sizes", [(0, 2, 1), (8, 0, 1), (8, 2, 0)])
def test_sizes_are_positive(sizes):
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        jaxpets.datasets.init(*sizes)


def test_sizes_are_integers():
    with pytest.raises(TypeError, match="capacity must be a Python int"):
        jaxpets.datasets.init(1e4, 2, 1)


def test_the_variance_is_that_of_the_rows_that_are_there():
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    np.testing.assert_array_equal(obs_variance(dataset), [1.0, 1.0])
    dataset = append(dataset, numbered(3, 5))
    want = np.arange(3.0, 8.0).var()
    np.testing.assert_allclose(obs_variance(dataset), [want, want], rtol=1e-6)
    dataset = append(dataset, numbered(8, 7))  # the oldest go
    want = np.arange(7.0, 15.0).var()
    np.testing.assert_allclose(obs_variance(dataset), [want, want], rtol=1e-6)


@pytest.mark.parametrize(
    "use",
    [
        jaxpets.datasets.obs_variance,
        lambda many: jaxpets.datasets.grow(many, 16),
        lambda many: jaxpets.datasets.append(many, numbered(0, 2)),
        lambda many: jaxpets.rewards.visited_states(many, 4),
        lambda many: jaxpets.rewards.count_states(jnp.ones((3, 2)), many),
    ],
    ids=["obs_variance", "grow", "append", "visited_states", "count_states"],
)
def test_datasets_of_several_seeds_are_to_be_mapped(use):
    """The variance of one seed's was ones, of the wrong shape, without a word."""
    one = jaxpets.datasets.init(CAPACITY, 2, 1)
    many = one._replace(data=jax.tree.map(lambda x: x[None], one.data))
    with pytest.raises(ValueError, match=r"dataset.data.\w+ must be float32\[C, D\]"):
        use(many)


def test_a_dataset_of_numpy_grows_as_any_other():
    """As one that was on the host, or in a file."""
    dataset = append(jaxpets.datasets.init(CAPACITY, 2, 1), numbered(0, 3))
    found = jaxpets.datasets.append(jax.device_get(dataset), numbered(3, 2))
    assert held(found) == [0, 1, 2, 3, 4]


def test_a_trial_without_steps_adds_none():
    dataset = append(jaxpets.datasets.init(CAPACITY, 2, 1), numbered(0, 3))
    assert num_stable(numbered(0, 0)) == 0
    toys.assert_trees_close(append_stable(dataset, numbered(0, 0)), dataset)
