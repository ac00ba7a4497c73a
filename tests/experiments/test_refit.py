"""The fit between exploration and phase 2, in whole runs of the preset smoke."""

import shutil

import jax
import numpy as np
import optax
import pytest
import runs
import toys

import jaxpets
from experiments import cli, exploration
from experiments.build import REFIT, build, trial_keys
from experiments.run import main
from experiments.storage import checkpoint
from jaxpets.envs import half_cheetah

FLAGS = (
    "--task", "front-flip", "--eval-trials", "1",
    "--refit.num-epochs", "3", "--refit.batch-size", "16", "--refit.final-rate", "0.1",
)  # fmt: skip
SAID = "refit: 3 epochs of 60 transitions"
TASK = "zero-shot-003-front-flip"


@pytest.fixture(scope="module")
def explored(explored_copy):
    return explored_copy(0, 7)


@pytest.fixture(scope="module")
def performed(explored):
    """The folder of a zero-shot with a refit."""
    assert main(["--phase", "zero-shot", "--from", str(explored), *FLAGS]) == 0
    return explored / TASK


def model(folder, config):
    template = exploration.model_of(exploration.template(config, build(config)))
    found = checkpoint.restore(folder / "checkpoints", template, warn=pytest.fail)
    assert found is not None and found[0] == runs.LAST
    return found[1].params


@pytest.mark.slow
def test_the_model_that_performs_is_refit_on_all_data(explored, performed):
    config = cli.parse(["--phase", "zero-shot", "--from", str(explored), *FLAGS])
    state = runs.learner(explored)
    fitter = jaxpets.fitter(
        jaxpets.ensemble(
            jaxpets.EnsembleConfig(
                num_members=3,
                hidden_sizes=(16, 16),
                weight_decays=(2.5e-5, 5e-5, 1e-4),
                state_margin=0.5,
            ),
            half_cheetah.model_space(),
            obs_size=18,
            action_size=6,
        ),
        optax.adam(1e-3),
        jaxpets.FitConfig(3, 16, 0.1),
    )
    keys = trial_keys(config, REFIT, runs.LAST)
    for i in range(2):
        own = jax.tree.map(lambda x, i=i: x[i] if x.ndim else x, state)
        want, _, metrics = jax.jit(fitter.step)(
            own.params, keys[i], own.fit, own.dataset
        )
        assert metrics.num_updates == 3 * 4  # 60 rows in batches of 16
        got = jax.tree.map(lambda x, i=i: x[i], model(performed, config))
        toys.assert_trees_close(got, want, rtol=1e-3, atol=1e-5)
        moved = jax.tree.leaves(got.network)[1] - jax.tree.leaves(own.params.network)[1]
        assert np.abs(moved).max() > 1e-4


@pytest.mark.slow
def test_a_stopped_zero_shot_does_not_refit_again(
    performed, explored, tmp_path, capsys
):
    again = tmp_path / runs.NAME
    shutil.copytree(explored, again)
    (again / TASK / "metrics.jsonl").unlink()
    assert main(["--phase", "zero-shot", "--from", str(again), *FLAGS]) == 0
    assert "refit" not in capsys.readouterr().err
    want = [runs.numbers(row) for row in runs.rows(performed)]
    assert [runs.numbers(row) for row in runs.rows(again / TASK)] == want


@pytest.mark.slow
def test_a_variant_takes_the_refit_of_another(performed, explored, tmp_path, capsys):
    """It is the same fit with the same keys; of other settings it is another one."""
    again = tmp_path / runs.NAME
    shutil.copytree(explored, again)
    command = ["--phase", "zero-shot", "--from", str(again), *FLAGS]
    assert main([*command, "--tag", "longer", "--refit.num-epochs", "4"]) == 0
    assert "refit: 4 epochs" in capsys.readouterr().err
    variant = ["--tag", "pessimist", "--pessimism", "0.5"]
    assert main([*command, *variant]) == 0
    assert f"refit: as in {TASK}\n" in capsys.readouterr().err
    config = cli.parse(command)
    wanted, found = model(performed, config), model(again / f"{TASK}-pessimist", config)
    jax.tree.map(np.testing.assert_array_equal, found, wanted)
    # Nor is that of another exploration, were the folder used anew.
    copy = tmp_path / "other" / runs.NAME
    shutil.copytree(again, copy)
    for folder in copy.glob("zero-shot-*"):
        config_file = folder / "config.json"
        text = config_file.read_text().replace(
            '"random_trials": 1', '"random_trials": 2'
        )
        config_file.write_text(text)
    flags = ["--phase", "zero-shot", "--from", str(copy), *FLAGS, "--tag", "anew"]
    assert main(flags) == 0
    assert SAID in capsys.readouterr().err
    # A damaged one is not used, and costs the time of a refit.
    for folder in (again / TASK, again / f"{TASK}-pessimist"):
        for file in (folder / "checkpoints").rglob("d/*"):
            file.write_bytes(b"")
    assert main([*command, "--tag", "third", "--pessimism", "0.2"]) == 0
    assert SAID in capsys.readouterr().err


@pytest.mark.slow
def test_finetune_refits_once(explored, tmp_path, capsys):
    again = tmp_path / runs.NAME
    shutil.copytree(explored, again, ignore=shutil.ignore_patterns("zero-shot*"))
    command = ["--phase", "finetune", "--from", str(again), *FLAGS]
    assert main(command) == 0
    assert capsys.readouterr().err.count(SAID) == 1
    tuned = again / "finetune-003-front-flip"
    want = [runs.numbers(row) for row in runs.rows(tuned)]
    shutil.rmtree(tuned / "checkpoints" / "5")
    assert main(command) == 0
    assert "refit" not in capsys.readouterr().err
    assert [runs.numbers(row) for row in runs.rows(tuned)] == want
