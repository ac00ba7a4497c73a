"""The ensemble of mbrl-lib, trained by its own trainer on the data given."""

import logging
from typing import Any, NamedTuple

import numpy as np

from benchmarks import real_data

NEEDED = (
    "--mbrl needs mbrl-lib: pip install torch hydra-core omegaconf termcolor tqdm "
    "and pip install --no-deps mbrl==0.2.0 ({error})"
)
_WEIGHT_DECAYS = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4)  # of PETS


class Variant(NamedTuple):
    """How mbrl-lib is set up."""

    learn_logvar_bounds: bool
    learning_rate: float
    weight_decay: float | None  # None: that of PETS, per layer, on weights only


VARIANTS = {
    "matched": Variant(True, 1e-3, None),
    "fixed-bounds": Variant(False, 1e-3, None),
    # conf/overrides/pets_halfcheetah.yaml
    "shipped": Variant(False, 2.8e-4, 1e-4),
}


class Model(NamedTuple):
    """A model of mbrl-lib and what trains it."""

    wrapper: Any  # OneDTransitionRewardModel around a GaussianMLP
    trainer: Any
    batches: Any  # BootstrapIterator


def build(
    train: real_data.Arrays, variant: Variant, seed: int, batch_size: int, hidden: int
) -> Model:
    """Builds 5 members of 4 hidden layers with the preprocessing of PETS.

    Raises:
      ModuleNotFoundError: where mbrl-lib is not installed.
    """
    logging.disable(logging.WARNING)  # gym's banner
    import torch  # pyright: ignore[reportMissingImports]
    from mbrl import models  # pyright: ignore[reportMissingImports]
    from mbrl.types import TransitionBatch  # pyright: ignore[reportMissingImports]
    from mbrl.util.replay_buffer import BootstrapIterator  # pyright: ignore[reportMissingImports]

    torch.manual_seed(seed)
    net = models.GaussianMLP(
        in_size=24,
        out_size=18,
        device="cpu",
        num_layers=4,
        ensemble_size=5,
        hid_size=hidden,
        learn_logvar_bounds=variant.learn_logvar_bounds,
        activation_fn_cfg={"_target_": "torch.nn.SiLU"},
    )
    wrapper = models.OneDTransitionRewardModel(
        net,
        normalize=True,
        normalize_double_precision=True,
        learned_rewards=False,
        obs_process_fn=real_data.features,
        no_delta_list=[0],
    )
    none = np.zeros(len(train["obs"]), np.float32)
    batch = TransitionBatch(
        train["obs"], train["action"], train["next_obs"], none, none > 0, none > 0
    )
    wrapper.update_normalizer(batch)
    trainer = models.ModelTrainer(
        wrapper,
        optim_lr=variant.learning_rate,
        weight_decay=variant.weight_decay or 0.0,
    )
    if variant.weight_decay is None:
        trainer.optimizer = torch.optim.Adam(_groups(net), lr=variant.learning_rate)
    trainer.optimizer.zero_grad()  # loads parts of torch, which is no training time
    batches = BootstrapIterator(
        batch,
        batch_size,
        ensemble_size=5,
        shuffle_each_epoch=True,
        permute_indices=False,  # with replacement, as PETS
        rng=np.random.default_rng(seed),
    )
    return Model(wrapper, trainer, batches)


def train(model: Model, num_epochs: int) -> None:
    """Trains for some epochs, without early stopping."""
    model.trainer.train(
        model.batches, num_epochs=num_epochs, evaluate=False, silent=True
    )


def predict(model: Model, data: real_data.Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Returns mean and variance `[E, B, D]` of the targets."""
    import torch  # pyright: ignore[reportMissingImports]

    inputs = np.concatenate([real_data.features(data["obs"]), data["action"]], -1)
    with torch.no_grad():
        scaled = model.wrapper.input_normalizer.normalize(inputs).float()
        mean, logvar = model.wrapper.model(scaled.expand(5, -1, -1))
    return mean.double().numpy(), logvar.double().exp().numpy()


def _groups(net: Any) -> list[dict[str, Any]]:
    """Adam's decay adds `rate * w` to a gradient: that of `rate * sum(w^2) / 2`."""
    layers = [*(block[0] for block in net.hidden_layers), net.mean_and_logvar]
    decayed = [
        {"params": [layer.weight], "weight_decay": rate}
        for layer, rate in zip(layers, _WEIGHT_DECAYS, strict=True)
    ]
    rest = [*(layer.bias for layer in layers), net.min_logvar, net.max_logvar]
    return [*decayed, {"params": rest, "weight_decay": 0.0}]
