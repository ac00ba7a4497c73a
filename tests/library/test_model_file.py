"""A model as a file: what was saved comes back, and what was not is refused."""

import json
import pickle
import struct

import chex
import jax
import numpy as np
import pytest
import toys
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import jaxpets
from jaxpets import coordinates, envs, models
from jaxpets._src import tensor_file
from jaxpets.coordinates import Coordinate

ABOUT = {"environment": "my/cart", "licence": "MIT", "training": {"trials": 3}}
ROWS = (Coordinate("x"), Coordinate("pitch", "angle", is_bounded=False))


@pytest.fixture(scope="module")
def saved(model, params, tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "cart.safetensors"
    jaxpets.save_model(path, model, params, about=ABOUT)
    return path


def mean_and_variance(model, params):
    obs = np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 2, 2)
    return jax.jit(model.predict)(params, obs, np.ones((2, 1), np.float32))


def test_what_was_saved_predicts_the_same(model, params, saved):
    again, found = jaxpets.load_model(saved)
    assert again.config == model.config
    assert again.space == jaxpets.delta_space()
    toys.assert_trees_close(found, params, rtol=0)
    want = mean_and_variance(model, params)
    toys.assert_trees_close(mean_and_variance(again, found), want, rtol=0)
    assert models.about(saved) == ABOUT
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_another_activation_comes_back(tmp_path):
    model, path = toys.small_ensemble(activation="gelu"), tmp_path / "m"
    params = jax.jit(model.init)(jax.random.key(1))
    jaxpets.save_model(path, model, params)
    again, found = jaxpets.load_model(path)
    assert again.config == model.config and again.config.activation == "gelu"
    chex.assert_trees_all_equal(found, params)


def test_numbers_of_numpy_are_saved_as_any_others(tmp_path):
    """An obs_size is often `np.prod(space.shape)`."""
    path = tmp_path / "m"
    model = toys.small_ensemble(
        obs_size=np.int64(2),
        num_members=np.int64(2),
        hidden_sizes=(np.int32(4),),
        weight_decays=None,
        bound_decay=np.float32(0.5),
    )
    about = {"trials": np.int64(3), "kept": np.bool_(True)}
    jaxpets.save_model(path, model, jax.jit(model.init)(jax.random.key(1)), about=about)
    again, _ = jaxpets.load_model(path)
    assert again.config == model.config and again.obs_size == 2
    assert models.about(path) == {"trials": 3, "kept": True}


def test_half_the_room_is_a_rounding(model, params, saved, tmp_path):
    path = tmp_path / "half.safetensors"
    jaxpets.save_model(path, model, params, half=True)
    _, found = jaxpets.load_model(path)
    chex.assert_trees_all_equal_dtypes(found, params)
    chex.assert_trees_all_equal(found.scaler, params.scaler)
    chex.assert_trees_all_close(found.network, params.network, rtol=2**-11, atol=1e-7)
    weights = jax.tree.leaves(params.network.members)
    rounded = jax.tree.leaves(found.network.members)
    assert any(np.any(x != y) for x, y in zip(weights, rounded, strict=True))
    small = 2 * sum(x.size for x in weights)
    assert saved.stat().st_size - path.stat().st_size > small - 500
    large = jax.tree.map(lambda x: x + 1e5, params.network.members)
    wild = params._replace(network=params.network._replace(members=large))
    with pytest.raises(ValueError, match="weights beyond 65504: not for half"):
        jaxpets.save_model(path, model, wild, half=True)


def test_coordinates_are_saved_and_own_functions_are_not(tmp_path):
    path = tmp_path / "m"
    space = coordinates.space(ROWS)
    model = toys.small_ensemble(space=space)
    params = jax.jit(model.init)(jax.random.key(1))
    jaxpets.save_model(path, model, params)
    again, found = jaxpets.load_model(path)
    assert again.space.coordinates == ROWS
    toys.assert_trees_close(found, params, rtol=0)
    own = space._replace(coordinates=())
    jaxpets.save_model(path, toys.small_ensemble(space=own), params)
    with pytest.raises(ValueError, match="author's own functions, which a file cannot"):
        jaxpets.load_model(path)
    again, _ = jaxpets.load_model(path, space=own)
    assert again.space is own
    # Another number of features than the file was trained with.
    with pytest.raises(ValueError, match="networks read 4 numbers, but get 3"):
        jaxpets.load_model(path, space=jaxpets.delta_space())


def test_what_cannot_be_saved_is_said(model, params, tmp_path):
    path = tmp_path / "m"
    own = model._replace(config=None)
    with pytest.raises(ValueError, match="an ensemble of your own"):
        jaxpets.save_model(path, own, params)
    with pytest.raises(ValueError, match="about must be JSON"):
        jaxpets.save_model(path, model, params, about={"rate": float("nan")})
    with pytest.raises(ValueError, match="about must be JSON"):
        jaxpets.save_model(path, model, params, about={"rate": jax.numpy.ones(2)})
    bad = params._replace(scaler=params.scaler._replace(mean=params.scaler.std / 0 * 0))
    with pytest.raises(ValueError, match=r"scaler\.mean of params must have no NaN"):
        jaxpets.save_model(path, model, bad)
    with pytest.raises(ValueError, match="params"):
        jaxpets.save_model(path, model, params._replace(scaler=()))
    with pytest.raises(TypeError, match=r"about must be a mapping, got 'a note' .str"):
        jaxpets.save_model(path, model, params, about="a note")
    with pytest.raises(TypeError, match="path must be a text or a Path, got None"):
        jaxpets.save_model(None, model, params)
    with pytest.raises(FileNotFoundError, match=r"path must be in a folder .*, but "):
        jaxpets.save_model(tmp_path / "no" / "m", model, params)
    assert not path.exists()


def changed(saved, path, tensors=lambda arrays: arrays, **metadata):
    """Writes a file that is like the saved one but for some of its parts."""
    with safe_open(saved, "np") as file:
        texts = dict(file.metadata())
    texts = {name: text for name, text in (texts | metadata).items() if text}
    save_file(tensors(load_file(saved)), path, texts)
    return path


def facts(saved, **changes):
    with safe_open(saved, "np") as file:
        found = json.loads(file.metadata()["model"])
    config = found["config"] | changes.pop("config", {})
    return json.dumps(found | {"config": config} | changes)


METADATA = {
    "no format": (lambda saved: {"format": ""}, "no format 'jaxpets model'"),
    "newer": (lambda saved: {"version": "2"}, "of version 2 .* install a newer"),
    "no version": (lambda saved: {"version": "new"}, "version must be a number"),
    "no model": (lambda saved: {"model": ""}, "lacks 'model'"),
    "no JSON": (lambda saved: {"model": "{"}, "no JSON"),
    "deep": (lambda saved: {"model": "[" * 100_000}, "no JSON"),
    "NaN": (lambda saved: {"model": '{"config": NaN}'}, "NaN is none"),
    "a list": (lambda saved: {"model": "[]"}, "must be an object"),
    "a key less": (lambda saved: {"model": '{"space": 1}'}, "config, obs_size, .*got"),
    "config": (lambda saved: {"model": facts(saved, config={"x": 1})}, "its config"),
    "huge": (
        lambda saved: {"model": facts(saved, config={"bound_decay": 10**400})},
        "its config",
    ),
    "actions": (
        lambda saved: {"model": facts(saved, action_size=2**63)},
        "action_size must be at most",
    ),
    "no number": (lambda saved: {"model": facts(saved, obs_size="2")}, "obs_size"),
    "too large": (
        lambda saved: {"model": facts(saved, obs_size=10**15)},
        "max_logvar must be of shape",
    ),
    "too wide": (
        lambda saved: {"model": facts(saved, config={"hidden_sizes": [10**12] * 2})},
        "layer_0.bias must be of shape",
    ),
    "precision": (
        lambda saved: {"model": facts(saved, config={"precision": "f8"})},
        "f8",
    ),
    "space": (lambda saved: {"model": facts(saved, space="os.system")}, "its space"),
    "rows": (
        lambda saved: {"model": facts(saved, space=json.loads(NAMES))},
        "names of coordinates must be texts",
    ),
    "too few rows": (
        lambda saved: {"model": facts(saved, space=[ROWS[0]._asdict()])},
        "must have 2 entries, got 1",
    ),
}
NAMES = json.dumps([row._asdict() | {"name": ["x"]} for row in ROWS])


@pytest.mark.parametrize("case", METADATA)
def test_a_strangers_metadata_are_refused(saved, tmp_path, case):
    change, words = METADATA[case]
    path = changed(saved, tmp_path / "m", **change(saved))
    with pytest.raises(ValueError, match=words) as caught:
        jaxpets.load_model(path)
    assert str(path) in str(caught.value)


def test_a_file_that_says_too_much_of_itself_is_refused(saved, tmp_path):
    path = changed(saved, tmp_path / "m", about="7")
    assert jaxpets.load_model(path)
    with pytest.raises(ValueError, match=r"'about' .* must be an object"):
        models.about(path)


BIAS, STD = "network.members.params.layer_0.bias", "scaler.std"
ARRAYS = {
    "missing": (lambda x: {k: v for k, v in x.items() if k != BIAS}, BIAS),
    "one more": (lambda x: x | {"payload": x[BIAS]}, "payload"),
    "shape": (lambda x: x | {BIAS: x[BIAS][:, 1:]}, BIAS),
    "dtype": (
        lambda x: x | {BIAS: x[BIAS].astype(np.int32)},
        "must be float32 or float16",
    ),
    "kind": (lambda x: x | {BIAS: x[BIAS].astype(np.int64)}, "dtype of F32"),
    "NaN": (lambda x: x | {BIAS: x[BIAS] * np.float32("nan")}, "must have no NaN"),
    "infinite": (lambda x: x | {BIAS: x[BIAS] + np.float32("inf")}, "must be finite"),
    "no width": (lambda x: x | {STD: 0 * x[STD]}, "std of .* must be positive"),
    "axes": (lambda x: x | {"scaler.mean": x[BIAS]}, "scaler.mean must be of one axis"),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_a_strangers_arrays_are_refused(saved, tmp_path, case):
    change, words = ARRAYS[case]
    path = changed(saved, tmp_path / "m", change)
    with pytest.raises(ValueError, match=words):
        jaxpets.load_model(path)


def test_what_is_no_safetensors_is_refused(saved, tmp_path):
    path = tmp_path / "m"
    content = saved.read_bytes()
    for bad in (b"", pickle.dumps(ABOUT), content[:-1], struct.pack("<Q", 2**60)):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="must be a safetensors file"):
            jaxpets.load_model(path)
    with pytest.raises(FileNotFoundError, match="path must be a file"):
        jaxpets.load_model(tmp_path / "none")
    with pytest.raises(TypeError, match="path must be a text or a Path, got 3"):
        jaxpets.load_model(3)


def test_only_what_can_be_read_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"x must be of float32, .* got int64"):
        tensor_file.write(tmp_path / "m", {"x": np.arange(3)}, {})
    assert not list(tmp_path.iterdir())


def test_what_comes_with_the_library_is_read():
    assert {"best", "epistemic", "dmc/walker"} < {*models.names()}
    for name in models.names():
        model, params = jaxpets.pretrained(name)
        found = models.about(models.path(name))
        robot = envs.make(found["environment"], backend="mujoco")
        assert found["environment"] in (name, "pets/half_cheetah")
        assert robot.space.coordinates == model.space.coordinates
        assert robot.env.action_low.shape == (model.action_size,)
        assert np.isfinite(params.scaler.low).all()
        assert found["training"]["num_trials"] in (60, 100)
        search = getattr(jaxpets.optimizers, found["search"]["optimizer"])
        high = np.ones(model.action_size)
        search(action_low=-high, action_high=high, **found["search"]["settings"])
    with pytest.raises(ValueError, match="name must be a model, as best, got 'bst'"):
        jaxpets.pretrained("bst")
    with pytest.raises(ValueError, match="name must be a model, as"):
        models.path("policies/best")
