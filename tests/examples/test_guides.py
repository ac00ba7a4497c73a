"""The code of the README and the guides runs, and what they quote is said."""

import ast
import contextlib
import importlib.util
import io
import re
import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
from PIL import Image

import jaxpets
from experiments import cli
from experiments.errors import CheckpointError

# How many blocks of a page are in no example. Tests run these: those below, and that of
# examples/own_robot.py.
OWN = {
    "first_ten_minutes": 2,
    "own_model": 2,
    "own_objective": 1,
    "own_robot": 3,
    "own_world": 1,
    "scale": 1,
}


def test_the_readme_shows_lines_of_examples():
    assert pages.blocks("README.md")
    assert not pages.own("README.md")


@pytest.mark.parametrize("guide", pages.GUIDES)
def test_a_guide_shows_lines_of_examples_or_what_is_run_here(guide):
    assert len(pages.own(f"docs/{guide}.md")) == OWN.get(guide, 0)


def test_the_robot_of_a_page_earns_and_can_be_drawn(tmp_path):
    (block,) = pages.blocks("experiments/README.md")
    (tmp_path / "cart.xml").write_text(
        """<mujoco><worldbody><body><geom size=".1"/>
        <joint name="x" type="slide" axis="1 0 0" range="-2 2"/></body></worldbody>
        <actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
    )
    names = {"__file__": str(tmp_path / "my_robot.py")}
    exec(block, names)
    robot = names["robot"]("mujoco")
    obs, action = jnp.array([0.5, 2.0]), jnp.zeros(1)
    got = [robot.tasks.reward_fn(x, obs, action, obs) for x in robot.tasks.params]
    np.testing.assert_allclose(got, [-0.25, 2.0])
    assert robot.qpos_fn(obs[None]) == 0.5 and robot.axes[0].entry == 0


def test_the_models_of_a_guide_plan():
    names = pages.execute("docs/own_model.md")
    assert names["plan"].action.shape == (1,)
    assert names["plan"].value < 0.0


def test_an_own_loop_awaits_its_action_in_pinned_memory():
    device = jax.devices()[0]
    if "pinned_host" not in {memory.kind for memory in device.addressable_memories()}:
        pytest.skip("this device has no such memory")
    one, obs = jnp.ones(1), jnp.zeros(2)
    planner = jaxpets.random_planner(-one, one, noise_beta=1.0)
    names = pages.execute("docs/own_world.md", {"jax": jax, "planner": planner})
    step, state, key = names["step"], names["state"], jax.random.key(0)
    for _ in range(2):
        action, state = step(None, key, state, obs)
    assert action.sharding.memory_kind == "pinned_host" and action.shape == (1,)
    assert jax.tree.leaves(state)[0].sharding == names["here"]
    assert step._cache_size() == 1


@pytest.mark.slow
def test_the_first_ten_minutes_end_with_a_robot_that_does_what_is_typed(capsys):
    pages.execute("docs/first_ten_minutes.md")
    forward, backward = map(float, capsys.readouterr().out.split())
    assert backward < -0.5 < 0.5 < forward  # m/s, on average over 2.5 s from rest


@pytest.fixture(scope="module")
def tour(tmp_path_factory):
    """The tour at small size: its names, what it printed, and the pictures it left."""
    folder = tmp_path_factory.mktemp("tour")
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setenv("MPLBACKEND", "agg")
        return *pages.run("tour.py", "--tiny"), folder


@pytest.mark.slow
def test_the_tour_explores_draws_and_performs_what_is_typed(tour):
    names, lines, folder = tour
    assert len(lines) == 2 + len(names["LINES"])
    last = [float(re.findall(r"-?\d+\.\d+", line)[0]) for line in lines]
    assert np.isfinite(last).all()
    # Three rewards, one program.
    assert names["perform"]._cache_size() == 1
    values = names["disagreement"](names["state"])
    assert values.shape == (61 * 41,) and bool(jnp.all(values > 0.0))
    with Image.open(folder / "pendulum.gif") as film:
        assert film.n_frames == 10
    assert (folder / "disagreement.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_tour_goes_on_with_many_seeds(tour):
    names, _, _ = tour
    many = pages.execute("docs/scale.md", names)
    assert many["outs"].fit.mse.shape == (4,)
    assert many["states"].dataset.size == 10


def commands():
    """Yields the command lines of the README and the guides, without comments."""
    for page in ("README.md", *(f"docs/{guide}.md" for guide in pages.GUIDES)):
        for block in pages.blocks(page, "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:2] == ["python", "-m"] and words[2].startswith("experiments"):
                    yield pytest.param(words[2], words[3:], id=f"{page}: {line}")


@pytest.mark.parametrize(("module", "words"), list(commands()))
def test_commands_are_understood(module, words, tmp_path, monkeypatch):
    assert importlib.util.find_spec(module)
    if module != "experiments.run":
        return
    (objective,) = pages.own("docs/own_objective.md")
    (tmp_path / "my_bonus.py").write_text(objective)
    monkeypatch.chdir(tmp_path)
    missing = pytest.raises(CheckpointError, match="no exploration run")
    is_later = words[0] in ("zero-shot", "finetune") and "--from" not in words
    with missing if is_later else contextlib.nullcontext():
        cli.parse(words)  # which tries a file of the user's


def quoted():
    """Yields the parts of the messages that a page quotes; dots are what differs."""
    page = (pages.REPOSITORY / "docs" / "when_it_does_not_work.md").read_text()
    for text in re.findall(r'"([^"]+)"', page):
        if "XLA" not in page[page.index(text) :].splitlines()[0]:
            yield [part for part in text.split("...") if part.strip()]


def test_messages_are_quoted_as_they_are():
    said = io.StringIO()
    for folder in (Path(jaxpets.__file__).parent, Path(cli.__file__).parent):
        for path in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    print(" ".join(node.value.split()), file=said)
    for part in [part.strip() for parts in quoted() for part in parts]:
        assert part in said.getvalue(), part
