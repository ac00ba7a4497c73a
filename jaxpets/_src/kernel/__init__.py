"""Rollout and training of an ensemble as compiled kernels: a map of this folder.

`jaxpets.fused_rollout` puts the parts together. Three kernels compute the same rollout:
one for Hopper GPUs (wgmma_*), one for all GPUs from Ampere on (mma_*), both in float16,
and one for CPUs in float32 (cpu_*). Those for GPUs have a reference in plain C++, for
tests on machines without one.

`jaxpets.fused_fitter` has a kernel of its own, fit_*, for Hopper GPUs: an epoch of
training. Its reference is the same source, run by fibers on a CPU.

physics.cc is no kernel: C MuJoCo as XLA calls it, for `jaxpets.envs`.

The code. What depends on the model is generated into model.h, all else is fixed:

    ModelSpace -> jaxpr -> C++               jaxpr_to_cpp.cpp_function, primitives
    sizes -> constants                       {wgmma,mma,cpu}_layout: header
    widths -> tensor core instructions       wgmma_layout.products
    sizes -> constants of training           fit_layout: header
    model.h and sources -> .so -> FFI target    build.load_kernel
    .so -> the next process                     cache.library

The numbers. Parameters are packed once per plan, and handed over at every call:

    parameters -> weights, as the kernel reads them    {gpu,cpu}_layout: pack
    weights, shared numbers, keys, obs, actions -> path    the FFI call
    parameters and moments -> the same, an epoch later    fit_layout: pack, unpack

Who includes whom:

    wgmma_rollout.cu    gpu_layout.h, gpu_launch.h, wgmma.h, wgmma_{feed,slice}.h
    mma_rollout.cu      gpu_layout.h, gpu_launch.h, gpu_particles.h, mma_product.h
    wgmma_slice.h       mma.h, wgmma_memory.h: a few particles that share their columns
    wgmma_feed.h        wgmma_memory.h: the producer, of weights and noise
    wgmma_memory.h      hopper.h, wgmma_warp.h: what a block shares, who waits for what
    wgmma_warp.h        gpu_particles.h: a warp's particles, as Hopper's kernel has them
    hopper.h            gpu_particles.h: barriers, and copies that arrive at them
    mma_product.h       gpu_layout.h, mma.h: what a warp multiplies, and its weights
    gpu_launch.h        xla_call.h: how XLA's call becomes a launch
    gpu_particles.h     handler.h: what a warp or a block does with its particles
    gpu_reference.cc    gpu_layout.h, handler.h
    cpu_rollout.cc      cpu_layout.h, handler.h
    physics.cc          gpu_copy.h, and C MuJoCo
    gpu_copy.h          xla_call.h: copies between a GPU and the host
    fit_epoch.cu        fit_epoch.h, gpu_launch.h
    fit_reference.cc    fit_epoch.h
    fit_epoch.h         fit_forward.h, fit_backward.h, fit_state.h: parts of an epoch
    these three         fit_block.h: what a block works with
    fit_block.h         fit_operands.h, which includes fit_sizes.h and xla_call.h
    fit_sizes.h         fit_device.h: Hopper's instructions, or fit_emulator.h: a CPU's
    fit_emulator.h      fit_machine.h: clusters of fibers in place of a GPU
    handler.h           rollout.h and xla_call.h: the operands as XLA hands them over
    xla_call.h          XLA's c_api.h: what XLA calls
    rollout.h           sizes.h: the operands, and how far apart their numbers lie
    *_layout.h          sizes.h: where each weight lies, and their type
    sizes.h             model.h, and that particle.h: functions of one particle

A layout comes before handler.h, which needs the type of the weights.
"""
