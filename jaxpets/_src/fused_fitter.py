"""Training as one kernel: all updates of an epoch in one call."""

import warnings

import jax
import jax.numpy as jnp

from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_config import EnsembleConfig, layer_decays
from jaxpets._src.ensemble_params import NetworkParams
from jaxpets._src.fit_records import FitConfig, Fitter
from jaxpets._src.fitter import (
    Epoch,
    EpochFn,
    Progress,
    Totals,
    check_arguments,
    fitter,
    of_epochs,
)
from jaxpets._src.kernel.build import BuildError, Kernel, Kind, load_kernel
from jaxpets._src.kernel.device import HOPPER, is_hopper
from jaxpets._src.kernel.fit_layout import FitLayout
from jaxpets._src.kernel.jaxpr_to_cpp import UnsupportedError
from jaxpets._src.network import Precision
from jaxpets._src.optimizer import Adam, Optimizer, adam_of


def fused_fitter(ensemble: Ensemble, optimizer: Optimizer, config: FitConfig) -> Fitter:
    """Builds a `fitter` whose epochs are one kernel each, on Hopper GPUs.

    Update by update, training of small networks waits for its launches. The kernel
    keeps a member's weights in the shared memory of 16 blocks, and Adam's moments in
    their registers, from the first update of an epoch to the last. It shows the rows
    that `fitter` would show for the same key, in the same order, and drops the updates
    that it would drop. Hidden layers multiply in TF32 as there, but sums are added in
    another order, so the last bits differ, and what follows from them.

    It is for one seed, or few, and small batches: of one seed an update with 32 rows
    takes 26 us on an H100, where that of `fitter` takes 85. Seeds that are mapped go
    one after another: four take 97 us, and `fitter` 128; eight take as long by both.
    With batches of 256 it gains nothing.

    Where there can be no kernel the result is that of `fitter`, which then says why in
    `reason`, and a warning of one line is given:

    - the device is no GPU of compute capability 9.0 (H100, H200, GH200), or there is no
      nvcc to build the kernel with;
    - the ensemble is none of `jaxpets.ensemble`, or its precision is not TF32;
    - the optimizer is not `optax.adam` with a constant rate, or has an eps of 0;
    - the weights of a member have no room in 16 blocks (four layers of 256 fit, eight
      of 200 do not), or the members have none on the GPU at once;
    - there are four or more hidden layers, so narrow and unequal that some blocks have
      a part in some of them only.

    One process trains so on a GPU at a time. The blocks of all members wait for one
    another, and what waits for four seconds ends the process with an error of CUDA.

    Args:
      ensemble: what to train, as `jaxpets.ensemble` built it. The kernel is made from
        its config: a `loss` of your own in its place would not be seen.
      optimizer: `optax.adam(rate)`.
      config: how often and in what portions the data are shown.

    Returns:
      A Fitter.

    Raises:
      TypeError, ValueError: if an argument is not what it should be.
    """
    check_arguments(ensemble, optimizer, config)
    made = fitter_of_kind(ensemble, optimizer, config, Kind.FIT)
    if not made.uses_kernel:
        warnings.warn(f"fused_fitter trains as fitter: {made.reason}.", stacklevel=2)
    return made


def fitter_of_kind(
    ensemble: Ensemble,
    optimizer: Optimizer,
    config: FitConfig,
    kind: Kind,
    **sizes: int,
) -> Fitter:
    """Builds a `fused_fitter` with one kind of kernel, and does not warn.

    The reference's is that of a GPU, run on a CPU; `sizes` are those of the layout.
    """
    try:
        layout, adam = _layout(ensemble, **sizes), _adam(optimizer)
        if kind.is_for_gpu and not is_hopper(jax.devices()[0]):
            raise UnsupportedError("the device is no GPU of compute capability 9.0")
        arch = HOPPER if kind.is_for_gpu else ""
        kernel = load_kernel(layout.header(), kind, arch)
    except (BuildError, UnsupportedError) as error:
        return fitter(ensemble, optimizer, config)._replace(reason=str(error))
    updates = _updates(layout, kernel, adam, config, _config(ensemble))
    made = of_epochs(ensemble, optimizer, config, updates)
    return made._replace(compiler=kernel.compiler)


def _config(ensemble: Ensemble) -> EnsembleConfig:
    if ensemble.config is None or ensemble.space is None:
        raise UnsupportedError("the ensemble is none of jaxpets.ensemble")
    return ensemble.config


def _layout(ensemble: Ensemble, **sizes: int) -> FitLayout:
    """Returns how training lies in memory.

    Raises:
      UnsupportedError: if there is no kernel for it.
    """
    config = _config(ensemble)
    assert ensemble.space is not None
    obs = jnp.zeros((ensemble.obs_size,), jnp.float32)
    layout = FitLayout(
        config.num_members,
        ensemble.obs_size,
        ensemble.action_size,
        ensemble.space.features(obs).shape[-1],
        config.hidden_sizes,
        config.activation,
        **sizes,
    )
    if config.precision is not Precision.TF32:
        raise UnsupportedError(f"the precision is {config.precision.value}, not tf32")
    if problem := layout.problem():
        raise UnsupportedError(problem)
    return layout


def _adam(optimizer: Optimizer) -> Adam:
    adam = adam_of(optimizer)
    if adam is None:
        raise UnsupportedError(
            "the optimizer is not optax.adam with a constant rate, or its numbers were "
            "not found"
        )
    return adam


def _updates(
    layout: FitLayout,
    kernel: Kernel,
    adam: Adam,
    config: FitConfig,
    model: EnsembleConfig,
) -> EpochFn:
    """Returns all updates of an epoch as one call of a kernel."""
    members, size = layout.num_members, layout.obs_size
    of_params = jax.ShapeDtypeStruct((members, layout.num_params), jnp.float32)
    bounds = jax.ShapeDtypeStruct((6, size), jnp.float32)
    number = jax.ShapeDtypeStruct((), jnp.float32)
    count = jax.ShapeDtypeStruct((), jnp.int32)
    totals = jax.ShapeDtypeStruct((members, layout.ctas, 2), jnp.float32)
    scratch = jax.ShapeDtypeStruct((layout.scratch_words,), jnp.uint32)
    results = (*(of_params,) * 3, bounds, count, totals, number, count, scratch)
    call = jax.ffi.ffi_call(kernel.target, results, vmap_method="broadcast_all")
    same = {
        **adam._asdict(),
        "one_b1": 1.0 - adam.b1,
        "one_b2": 1.0 - adam.b2,
        "final": config.final_rate,
        "epochs": config.num_epochs,
        "batch": config.batch_size,
        "bound_decay": model.bound_decay,
    }

    def updates(progress: Progress, epoch: Epoch) -> Progress:
        state = progress.opt_state[0]
        trees = (progress.network, state.mu, state.nu)
        packed = [layout.pack(tree.members["params"]) for tree in trees]
        rows = [b for tree in trees for b in (tree.min_logvar, tree.max_logvar)]
        for name, x in zip(("inputs", "targets"), epoch.data, strict=True):
            if x.dtype != jnp.float32:
                raise TypeError(
                    f"{name} of the ensemble must be float32, got {x.dtype}."
                )
        *new, low_high, count, totals, num_rows, skipped, _ = call(
            *packed,
            jnp.stack(rows),
            state.count,
            epoch.size.astype(jnp.int32),
            *epoch.data,
            epoch.rows.astype(jnp.int32),
            layout.hyper(layer_decays(model), **same, epoch=epoch.number),
        )

        def tree(i: int) -> NetworkParams:
            members = {"params": layout.unpack(new[i])}
            return NetworkParams(members, low_high[2 * i], low_high[2 * i + 1])

        state = state._replace(count=count, mu=tree(1), nu=tree(2))
        opt_state = (state, *progress.opt_state[1:])
        nll, mse = jnp.sum(totals, axis=(0, 1))
        # The loss has the mean over members of mse, and their sum of nll.
        shown = Totals(nll, mse / members, num_rows)
        return Progress(tree(0), opt_state, progress.num_skipped + skipped, shown)

    return updates
