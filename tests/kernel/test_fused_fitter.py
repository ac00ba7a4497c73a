"""The kernel that trains, run by fibers on a CPU, trains as `jaxpets.fitter` does."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from fits import (
    CAPACITY,
    SMALL,
    Fit,
    assert_same_fit,
    both,
    dataset_of,
    distance,
    start,
)

import jaxpets
from jaxpets._src.fused_fitter import fitter_of_kind
from jaxpets._src.kernel.build import Kind
from jaxpets._src.network import ACTIVATIONS

# Other features than the observation, and more of them.
SPACE = jaxpets.delta_space()._replace(
    features=lambda obs: jnp.concatenate([jnp.sin(obs), jnp.cos(obs[..., 1:])], -1)
)
# 64 threads, so that the gradients of biases do not need two rounds.
COSINE = SMALL.but(batch_size=10, final_rate=0.1, bootstrap=False, threads=64)
CASES = {
    # Of 70 rows: batches of 32, and one of 6; of 10; of 40, in chunks of 32 and 8.
    "small": SMALL,
    "batches of 10, cosine, all rows": COSINE,
    "batches of 40, a decay per layer": SMALL.but(
        batch_size=40, weight_decays=(0.1, 0.3, 0.2), bound_decay=0.3
    ),
    "batches of 64, no decay": SMALL.but(
        batch_size=64, weight_decays=0.0, bound_decay=0.0
    ),
    "ragged": Fit((13, 9, 21), 5, 1, 3, "tanh", batch_size=40, threads=64),
    "five layers": Fit(
        (8, 8, 16, 8, 8), activation="relu", weight_decays=0.1, ctas=2, threads=64
    ),
    "one layer": Fit((20,), 4, 1, activation="gelu", space=SPACE),
    "blocks without a column": Fit((5, 7), num_members=5, ctas=8, batch_size=24),
    "one block, one member": Fit((9, 6), 17, 3, 1, ctas=1, final_rate=0.0),
    "more dimensions than blocks": Fit((70, 45), 17, 6, threads=64),
    "chunks of 16": Fit((24, 16), 200, 1, 1, ctas=2, threads=128, batch_size=40),
}


@pytest.mark.parametrize("name", CASES)
def test_it_trains_as_the_fitter(name):
    case = CASES[name]
    got, want = both(case, case.dataset(70))
    assert_same_fit(got, want)
    assert want[2].num_skipped == 0 and want[2].num_updates >= 6


def test_the_cases_are_those_meant():
    rows = {name: case.layout().rows for name, case in CASES.items()}
    assert rows.pop("chunks of 16") == 16 and set(rows.values()) == {32}
    assert CASES["one layer"].layout().feature_size == 7 != CASES["one layer"].obs_size
    assert {case.activation for case in CASES.values()} == set(ACTIVATIONS)


def test_a_warm_start():
    """Two calls: Adam goes on, the rate starts anew."""
    got, want = both(COSINE, COSINE.dataset(53), calls=2)
    assert_same_fit(got, want)
    assert want[1].opt_state[0].count == 2 * want[2].num_updates == 2 * 3 * 6


def test_in_whichever_order_blocks_run_the_bits_are_the_same():
    """A call of one epoch is an order; the third differs from the first most."""
    case = CASES["ragged"].but(num_epochs=1)
    step, _ = case.steps()
    params, key, state = start(case)
    dataset = case.dataset(70)
    first, *others = (step(params, key, state, dataset) for _ in range(3))
    for other in others:
        chex.assert_trees_all_equal(other, first)


@pytest.mark.parametrize("size", [0, 1, 32, CAPACITY])
def test_any_number_of_rows(size):
    """What lies behind them is NaN."""
    got, want = both(SMALL, SMALL.dataset(size))
    assert_same_fit(got, want)
    assert want[2].num_updates == 3 * -(-size // 32) and want[2].num_skipped == 0
    if not size:
        params, _, state = start(SMALL)
        chex.assert_trees_all_equal(got[0].network, params.network)
        chex.assert_trees_all_equal(got[1], state)


# A target whose square is no number of float32; what is none from the start. A batch of
# 10 does not fill a chunk of 32, one of 40 takes two.
@pytest.mark.parametrize("batch_size", [10, 40])
@pytest.mark.parametrize(
    ("entry", "bad"),
    [("next_obs", 1e25), ("next_obs", np.nan), ("obs", np.nan), ("action", -np.inf)],
)
def test_an_update_that_is_not_finite_is_dropped(batch_size, entry, bad):
    case = {10: COSINE, 40: CASES["batches of 40, a decay per layer"]}[batch_size]
    data = case.transitions(70)
    getattr(data, entry)[5, 0] = bad
    got, want = both(case, dataset_of(data, 70))
    assert_same_fit(got, want)
    assert 0 < want[2].num_skipped < want[2].num_updates


def test_an_epoch_that_ends_without_numbers_is_undone():
    case = SMALL.but(rate=1e30)
    got, want = both(case, case.dataset(70))
    assert_same_fit(got, want)
    assert want[2].num_skipped > 0 and want[2].num_updates == 9


def test_bounds_that_meet_stay_in_order():
    case = SMALL.but(bound_decay=300.0)  # which pulls them together
    params, *rest = start(case)
    low = params.network.min_logvar + 9.0
    network = params.network._replace(min_logvar=low, max_logvar=low + 0.101)
    begin = params._replace(network=network), *rest
    got, want = both(case, case.dataset(70), begin=begin)
    assert_same_fit(got, want)
    met = want[0].network.max_logvar - want[0].network.min_logvar
    np.testing.assert_allclose(met, 0.1, rtol=1e-5)  # the least there may be


# -- many seeds ----------------------------------------------------------------------


def stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@pytest.mark.parametrize("sizes", [(70, 70, 70), (70,), (0, 70, 33)])
def test_vmap_equals_the_loop(sizes):
    """Over seeds whose data are of one size, over one seed, over sizes of their own."""
    same = len(set(sizes)) == 1
    axes = jaxpets.datasets.AXES if same else 0
    starts = [start(SMALL, seed) for seed in range(len(sizes))]
    datasets = [SMALL.dataset(size, seed=i) for i, size in enumerate(sizes)]
    many = stacked(datasets)
    if same:
        many = many._replace(size=many.size[0], cursor=many.cursor[0])
    params, keys, states = stacked(starts)
    reference, step = SMALL.reference(), SMALL.steps()[1]
    mapped = jax.jit(jax.vmap(reference.step, (0, 0, 0, axes)))
    got = mapped(params, keys, states, many)
    for i, (one, dataset) in enumerate(zip(starts, datasets, strict=True)):
        want = step(*one, dataset)
        assert_same_fit(jax.tree.map(lambda x, i=i: x[i], got), want)


def test_vmap_may_be_nested():
    """Both axes for starts and keys, the inner one for data, none for their size."""
    starts = [[start(SMALL, 3 * i + j) for j in range(3)] for i in range(2)]
    datasets = [SMALL.dataset(40, seed=seed) for seed in range(3)]
    many = stacked(datasets)._replace(size=datasets[0].size, cursor=datasets[0].cursor)
    mapped = jax.vmap(SMALL.reference().step, (0, 0, 0, jaxpets.datasets.AXES))
    mapped = jax.jit(jax.vmap(mapped, (0, 0, 0, None)))
    got = mapped(*stacked([stacked(row) for row in starts]), many)
    _, step = SMALL.steps()
    for i, j in np.ndindex(2, 3):
        one = jax.tree.map(lambda x, i=i, j=j: x[i, j], got)
        assert_same_fit(one, step(*starts[i][j], datasets[j]))


def test_a_learner_over_seeds_trains_with_it():
    env, case = toys.cart_env(), Fit((12, 10), 2, 1, num_epochs=2, batch_size=8)
    keys = jax.random.split(jax.random.key(3), 2)
    rows = [toys.transitions(10, seed=seed) for seed in range(2)]

    def learned(fitter):
        learner = jaxpets.learner(
            env,
            case.ensemble(),
            fitter,
            jaxpets.RewardData(),
            trial_length=10,
            capacity=30,
        )
        seeds = jaxpets.over_seeds(learner, 2)
        state = jax.jit(seeds.init)(keys)
        for _ in range(2):
            state, metrics = jax.jit(seeds.learn)(keys, state, stacked(rows))
        return (state.params, state.fit, metrics), state.dataset

    (got, seen), (want, shown) = learned(case.reference()), learned(case.plain())
    chex.assert_trees_all_equal(seen, shown)
    assert_same_fit(got, want)
    assert np.all(want[2].num_updates == 2 * 3)


# -- the paper's size ----------------------------------------------------------------


@pytest.mark.slow  # 32 blocks of 256 fibers
def test_the_size_of_the_paper():
    """With two members of the five; within what an order of sums does to the fitter.

    Adam makes a whole step of the smallest gradient, so of 130,000 weights a member
    some differ by a good part of a step after any change in the last bits: by 2e-5 of a
    leaf's largest number, and 6e-5 with five members, where the fitter with its hidden
    units in another order is 5e-5 from itself. As a share of the way from the start
    the ends are 4e-6 apart.
    """
    case = Fit((200,) * 4, 18, 6, 2, "relu", num_epochs=1, ctas=16, threads=256)
    dataset = case.dataset(50)
    got, want = both(case, dataset)
    assert_same_fit(got, want, close=2e-4)
    way = distance(want[0], start(case)[0])
    assert distance(got[0], want[0]) < 1e-4 * way


def test_data_of_another_type_are_refused():
    """The kernel would read them as they are not."""
    ensemble, optimizer, config = SMALL.arguments()

    def encode(scaler, data):
        return tuple(x.astype(jnp.float16) for x in ensemble.encode(scaler, data))

    sizes = dict(ctas=SMALL.ctas, threads=SMALL.threads)
    made = fitter_of_kind(
        ensemble._replace(encode=encode), optimizer, config, Kind.FIT_REFERENCE, **sizes
    )
    params = SMALL.params()
    args = params, jax.random.key(0), made.init(params), SMALL.dataset(20)
    with pytest.raises(TypeError, match=r"inputs .* must be float32, got float16"):
        jax.eval_shape(made.step, *args)
