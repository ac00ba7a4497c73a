"""XLA's flags under which CPUs compile quickly; run alone it prints them.

Nearly all time goes into compiling, and on CPUs a good part of that into LLVM's
optimisations and XLA's fused loops: without them the suite takes half of the time.
A program in one part, not in 32 for as many cores, takes a fifth less to compile, and
with XLA's own preset a tenth to a third less again.
"""

from importlib import metadata

_OF_ONE_RELEASE = (  # others may not know them
    "--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)
_KNOWS_THEM = metadata.version("jaxlib").startswith("0.10.")
FLAGS = " ".join(
    ("--xla_backend_optimization_level=0", *(_OF_ONE_RELEASE if _KNOWS_THEM else ()))
)

if __name__ == "__main__":
    print(FLAGS)
