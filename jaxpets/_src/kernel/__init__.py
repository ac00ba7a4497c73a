"""The rollout of an ensemble as one compiled kernel: a map of this folder.

`jaxpets.fused_rollout` puts these together. Two kernels compute the same rollout: one
for Hopper GPUs in float16 (`gpu_*`), one for CPUs in float32 (`cpu_*`). The GPU's has a
reference in plain C++, for tests on machines without one.

The code. What depends on the model is generated, all else is fixed source:

    ModelSpace -> jaxpr -> C++   jaxpr_to_cpp.cpp_function ┐
    sizes -> constants           {gpu,cpu}_layout.header   ├> model.h
    tensor core instructions     gpu_layout.products       ┘
    model.h + sources -> .so -> FFI target                   build.load_kernel

The numbers. They are laid out once per plan, and handed over at every call:

    EnsembleParams -> weights, in the order of reading     {gpu,cpu}_layout.pack
    weights, shared numbers, keys, obs, actions -> path    the FFI call

Who includes whom; an arrow points at what is included:

    gpu_rollout.cu    -> gpu_layout.h, handler.h, wgmma.h  (tensor core instructions)
    gpu_reference.cc  -> gpu_layout.h, handler.h
    cpu_rollout.cc    -> cpu_layout.h, handler.h
    handler.h         -> rollout.h, XLA's FFI              (operands from XLA)
    rollout.h         -> sizes.h                           (operands, steps of one)
    {gpu,cpu}_layout.h -> sizes.h                          (where each weight lies)
    sizes.h -> model.h -> particle.h                       (functions of one particle)

The layout comes before handler.h: the operands are of its type `Weight`.
"""
