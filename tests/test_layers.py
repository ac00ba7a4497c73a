"""Structure: who may import whom, what is public, what the library never does."""

import ast
import graphlib
import re
import subprocess
import sys
from importlib.util import resolve_name
from pathlib import Path

import pytest

import jaxpets
from jaxpets import coordinates, formulas, models

PACKAGE = Path(jaxpets.__file__).parent
REPOSITORY = Path(__file__).resolve().parents[1]

# A module may import lower layers only, and none of its own row.
LAYERS = {
    "_src": 0,
    "_src.types": 0,
    "_src.checks": 0,
    "_src.tensor_file": 0,
    "_src.filled": 0,
    "_src.moments": 1,
    "_src.symlog": 1,
    "_src.elites": 1,
    "_src.guards": 0,
    "_src.returns": 1,
    "_src.batches": 1,
    "_src.chunks": 1,
    "_src.network": 1,
    "_src.action_box": 1,
    "_src.kernel": 1,
    "_src.kernel.build": 2,
    "_src.kernel.cache": 1,
    "_src.kernel.primitives": 1,
    "_src.kernel.jaxpr_to_cpp": 2,
    "_src.kernel.gpu_layout": 1,
    "_src.kernel.wgmma_layout": 2,
    "_src.kernel.mma_layout": 2,
    "_src.kernel.cpu_layout": 1,
    "_src.kernel.device": 1,
    "_src.kernel.fit_layout": 2,
    "_src.plan": 2,
    "_src.cem": 2,
    "_src.icem": 2,
    "_src.mppi": 2,
    "_src.rollout": 2,
    "_src.per_state": 2,
    "_src.sharded": 2,
    "_src.rewards": 2,
    "_src.score": 2,
    "_src.one_step": 3,
    "_src.particle_entropy": 2,
    "_src.random_planner": 3,
    "_src.distillation": 6,
    "_src.imagined_trials": 2,
    "_src.actor_critic_records": 1,
    "_src.actor_critic_networks": 2,
    "_src.actor_critic_update": 6,
    "_src.actor_critic": 7,
    "_src.distill_records": 2,
    "_src.distill_update": 6,
    "_src.distill_trials": 7,
    "_src.distill": 8,
    "_src.pseudo_counts": 2,
    "_src.dataset": 2,
    "_src.check_space": 2,
    "_src.coordinates": 2,
    "_src.unroll": 2,
    "_src.ensemble_config": 2,
    "_src.ensemble_params": 3,
    "_src.ensemble": 4,
    "_src.by_means": 4,
    "_src.optimizer": 1,
    "_src.fit_records": 4,
    "_src.fitter": 5,
    "_src.fused_fitter": 6,
    "_src.formula": 1,
    "_src.formula_program": 2,
    "_src.formula_text": 3,
    "_src.fused_rollout": 5,
    "_src.file_facts": 5,
    "_src.model_file": 6,
    "_src.policy_file": 6,
    "_src.policy_onnx": 5,
    "_src.prior": 2,
    "_src.pretrained": 7,
    "_src.learner": 6,
    "_src.over_seeds": 7,
    "_src.agent_world": 3,
    "_src.agent_file": 7,
    "_src.agent_steps": 7,
    "_src.agent_call": 8,
    "_src.agent": 9,
    "envs.extra": 0,
    "envs.host_call": 0,
    "envs.native_c": 3,
    "envs.native": 4,
    "envs.symmetry": 4,
    "envs.observations": 5,
    "envs.engines": 5,
    "envs.half_cheetah": 7,
    "envs.trial_start": 4,
    "envs.mujoco_env": 6,
    "envs.adapters": 5,
    "envs.robot": 5,
    "envs.tolerance": 4,
    "envs.starts": 5,
    "envs.tracks": 6,
    "envs.dmc_model": 4,
    "envs.mujoco_robot": 7,
    "envs.recipe": 8,
    "envs.registries": 6,
    "envs.dmc_rewards": 9,
    "envs.dmc_starts": 7,
    "envs.dmc": 10,
    "envs.gym_rewards": 9,
    "envs.gym_starts": 7,
    "envs.gym": 10,
    "envs.named": 11,
    "envs": 12,
    "coordinates": 10,
    "datasets": 10,
    "formulas": 10,
    "models": 10,
    "optimizers": 10,
    "policies": 10,
    "rewards": 10,
    "typing": 10,
    "": 11,
}

MODULES_OF_NAMES = [
    jaxpets,
    coordinates,
    jaxpets.datasets,
    formulas,
    models,
    jaxpets.optimizers,
    jaxpets.rewards,
    jaxpets.typing,
]

# Where third parties may be imported; jax anywhere.
HOMES = {
    "flax": {"_src.network"},
    "optax": {"_src.fitter", "_src.optimizer"},
    "mujoco": {
        "envs.dmc_model",
        "envs.engines",
        "envs.half_cheetah",
        "envs.mujoco_env",
        "envs.native",
        "envs.native_c",
        "envs.observations",
        "envs.starts",
        "envs.symmetry",
        "envs.trial_start",
    },
    "dm_control": set(),
    "brax": set(),
    "gymnasium": set(),
    "onnx": {"_src.policy_onnx"},
    "orbax": set(),
    "safetensors": {"_src.tensor_file"},
    "tyro": set(),
}


def name_of(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def imports(tree, package=None):
    """Dotted names of everything that is imported, wherever it stands.

    Relative imports are read as those of a module of `package`.
    """
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level or package, "imports are absolute"
            module = node.module or ""
            if node.level:
                module = resolve_name("." * node.level + module, package)
            found += [f"{module}.{alias.name}" for alias in node.names]
            found.append(module)
    return found


def own_imports(name):
    """Modules of jaxpets that `name` imports, by their names in LAYERS."""
    found = set()
    for dotted in imports(TREES[name]):
        if dotted.split(".")[0] == "jaxpets":
            inner = dotted.removeprefix("jaxpets").lstrip(".")
            # `from jaxpets._src.plan import plan` also reads as a name in a module.
            while inner and inner not in LAYERS:
                inner = inner.rpartition(".")[0]
            if inner or dotted == "jaxpets":
                found.add(inner)
    packages = {module.rpartition(".")[0] for module in found if "." in module}
    return found - packages - ({""} if len(found) > 1 else set())


def test_every_module_has_a_layer():
    assert set(MODULES) == set(LAYERS)


@pytest.mark.parametrize("name", sorted(LAYERS))
def test_imports_go_down(name):
    for other in own_imports(name):
        assert LAYERS[other] < LAYERS[name], f"{name} imports {other}"


def test_the_rule_sees_what_is_imported():
    assert "_src.types" in own_imports("_src.plan")
    assert {"_src.ensemble", "_src.types"} <= own_imports("_src.fitter")
    assert "_src.rewards" in own_imports("rewards")


@pytest.mark.parametrize("name", sorted(MODULES))
def test_third_parties_have_one_home(name):
    for dotted in imports(TREES[name]):
        home = HOMES.get(dotted.split(".")[0])
        assert home is None or name in home, f"{name} imports {dotted}"


def calls(tree):
    """Dotted names of everything called or used as a decorator."""
    nodes = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            nodes.append(node.func)
        nodes += getattr(node, "decorator_list", [])
    return {ast.unparse(node) for node in nodes}


@pytest.mark.parametrize("name", sorted(MODULES))
def test_the_library_never_jits_or_prints(name):
    tree = TREES[name]
    used = {ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    # These speak NumPy, and so compile what they call.
    if name not in ("_src.agent", "_src.agent_call"):
        assert not {"jax.jit", "jax.pmap"} & (used | calls(tree))
        assert not any(dotted == "jax.jit" for dotted in imports(tree))
    assert not {"print", "input", "open"} & calls(tree)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_sizes_stay_small(name):
    assert len(MODULES[name].read_text().splitlines()) <= 300


OUTSIDE = [
    path
    for part in ("examples", "experiments", "benchmarks")
    for path in sorted((REPOSITORY / part).rglob("*.py"))
]


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: path.stem)
def test_the_outside_uses_public_names_only(path):
    tree = ast.parse(path.read_text())
    package = ".".join(path.relative_to(REPOSITORY).parent.parts)
    for dotted in imports(tree, package):
        assert not dotted.startswith("jaxpets._src"), f"{path.name} imports {dotted}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            assert node.attr != "_src", f"{path.name} reaches into _src"


@pytest.mark.parametrize("path", [*MODULES.values(), *OUTSIDE], ids=lambda x: x.stem)
def test_nothing_that_is_read_becomes_code(path):
    """What SECURITY.md says: no pickle, no eval and no shell."""
    tree = ast.parse(path.read_text())
    modules = {dotted.split(".")[0] for dotted in imports(tree, "x.y.z")}
    assert not modules & {
        "pickle",
        "cloudpickle",
        "dill",
        "shelve",
        "marshal",
        "joblib",
    }
    runs = {"eval", "exec", "compile", "os.system", "os.popen", "subprocess.getoutput"}
    assert not calls(tree) & runs
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg in ("shell", "allow_pickle"):
            assert ast.unparse(node.value) == "False"


# The doors of experiments: what a room may import from the others. What is not here is
# on top of them, and the commands in `tools` on top of all.
ROOMS = {
    "errors": set(),
    "parallel": {"errors"},
    "storage": {"errors", "parallel"},
    "report": {"errors", "storage", "config", "entries"},
}
# digests reads what any version wrote, without the code of any.
ORBAX = {"storage.checkpoint", "tools.digests"}


def experiments_imports():
    """Returns for every module of experiments the names of all that it imports."""
    root = REPOSITORY / "experiments"
    found = {}
    for path in sorted(root.rglob("*.py")):
        if path.name != "__init__.py":
            parts = path.relative_to(root).with_suffix("").parts
            package = ".".join(("experiments", *parts[:-1]))
            found[".".join(parts)] = imports(ast.parse(path.read_text()), package)
    return found


IMPORTED = experiments_imports()
# For every module of experiments what else of them it imports.
EXPERIMENTS = {
    name: {x.removeprefix("experiments.") for x in dotted} & IMPORTED.keys() - {name}
    for name, dotted in IMPORTED.items()
}


def room(name):
    return name.partition(".")[0]


def path_of(name):
    return REPOSITORY.joinpath("experiments", *name.split(".")).with_suffix(".py")


@pytest.mark.parametrize("name", [n for n in EXPERIMENTS if room(n) in ROOMS])
def test_rooms_have_walls(name):
    others = {room(other) for other in EXPERIMENTS[name]} - {room(name)}
    assert others <= ROOMS[room(name)]


def test_only_commands_open_the_tools():
    users = {name for name, found in EXPERIMENTS.items() if "tools" in map(room, found)}
    doors = {"doctor", "run", "play.recorder"}
    assert {name for name in users if room(name) != "tools"} <= doors


def test_nothing_below_knows_the_page():
    users = {name for name, found in EXPERIMENTS.items() if "play" in map(room, found)}
    viewers = {
        name
        for name, dotted in IMPORTED.items()
        if {x.split(".")[0] for x in dotted} & {"viser", "trimesh"}
    }
    assert {room(name) for name in users | viewers} == {"play"}


def test_no_circle_of_experiments():
    graphlib.TopologicalSorter(EXPERIMENTS).prepare()


def test_the_walls_are_seen():
    assert {"acting", "storage.folder", "progress"} <= EXPERIMENTS["loop"]
    assert {"phases", "report.report", "tools.video"} <= EXPERIMENTS["run"]
    assert set(ROOMS) <= {room(name) for name in EXPERIMENTS}


def test_orbax_has_one_home():
    found = {
        name
        for name, dotted in IMPORTED.items()
        if any(x.split(".")[0] == "orbax" for x in dotted)
    }
    assert found == ORBAX


# Who may write a file where it stands: the writer itself, which also opens what is
# appended to, and the seal of a checkpoint that is still a draft.
WRITERS = {"storage.disk", "storage.step_folders"}
WRITING = {
    "write_text", "write_bytes", "savez", "savez_compressed", "savefig", "copy",
    "copy2", "copyfile", "write_frames",
}  # fmt: skip


def writes(tree):
    """Returns the calls that write a file which is no draft."""
    found, drafts = [], {"target"}  # a target is what a caller has given
    for node in ast.walk(tree):
        match node:
            case ast.withitem(
                ast.Call(ast.Attribute(attr="replaced" | "draft")), ast.Name(id)
            ):
                drafts.add(id)
            case _:
                pass
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = ast.unparse(call.func).rpartition(".")[2]
        words = [x.value for x in call.args if isinstance(x, ast.Constant)]
        mode = any(set(str(word)) & set("wax+") for word in words)
        if name in WRITING or (name == "open" and mode):
            text = ast.unparse(call)
            if not drafts & set(re.findall(r"\w+", text)):
                found.append(text)
    return found


@pytest.mark.parametrize("name", sorted(EXPERIMENTS.keys() - WRITERS))
def test_files_are_replaced_at_once(name):
    assert not writes(ast.parse(path_of(name).read_text()))


def test_writing_is_seen():
    assert all(writes(ast.parse(path_of(name).read_text())) for name in WRITERS)
    torn = "np.savez(path, x=1); file.open('rb'); open(path, 'w').write('x')"
    assert len(writes(ast.parse(torn))) == 2


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_sizes_stay_small_outside(name):
    assert len(path_of(name).read_text().splitlines()) <= 300


def test_sizes_of_benchmarks_and_kernels_stay_small():
    kernels = PACKAGE.joinpath("_src/kernel").iterdir()
    sources = [path for path in kernels if path.suffix in (".cc", ".cu", ".h")]
    assert sources
    for path in [*REPOSITORY.joinpath("benchmarks").glob("*.py"), *sources]:
        assert len(path.read_text().splitlines()) <= 300, path.name


@pytest.mark.parametrize("module", MODULES_OF_NAMES)
def test_public_names_are_those_listed(module):
    public = {
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and not isinstance(value, type(ast))
    }
    listed = set(module.__all__)
    assert public <= listed
    assert all(hasattr(module, name) for name in listed)
    assert len(module.__all__) == len(listed)


@pytest.mark.parametrize("module", MODULES_OF_NAMES)
def test_public_functions_are_documented(module):
    for name in module.__all__:
        value = getattr(module, name)
        if callable(value):
            assert value.__doc__, name


def test_import_is_light_and_silent():
    """No simulator, no optional package, no output, no compilation."""
    code = (
        "import sys, jaxpets\n"
        "heavy = ['mujoco', 'brax', 'gymnasium', 'orbax', 'tyro', 'matplotlib']\n"
        "sys.exit(','.join(m for m in heavy if m in sys.modules) or 0)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=PACKAGE.parent,
    )
    assert result.returncode == 0, result.stderr
    assert not result.stdout and not result.stderr


def test_version_is_that_of_the_package():
    assert jaxpets.__version__.count(".") == 2
    assert "__version__" in vars(jaxpets)
