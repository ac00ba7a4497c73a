"""The site: the repository's own pages where they lie, and the library's docstrings.

Its source is the whole repository, so a link means the same here and on the host of the
code, and nothing is written twice. `make docs` builds it.
"""

import inspect
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

import jaxpets
from jaxpets import coordinates, envs, formulas, models
from jaxpets.envs import half_cheetah

project = "jaxpets"
version = release = jaxpets.__version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]

root_doc = "docs/index"
include_patterns = [
    "*.md",
    "benchmarks/*.md",
    "docs/**.md",
    "docs/**.rst",
    "experiments/README.md",
    "jaxpets/models/*.md",
    "results/*.md",
    "results/*/report/report.md",
]
_FOLDERS = {pattern.partition("/")[0] for pattern in include_patterns}
exclude_patterns = ["docs/_build"] + [
    path.name
    for path in Path(__file__).parents[1].iterdir()
    if path.is_dir() and path.name not in _FOLDERS
]

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4  # as the code's host names them
default_role = "py:obj"  # what stands in backticks in a docstring is linked
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 60
napoleon_use_ivar = True  # the fields of a record are described once
napoleon_use_rtype = False

html_theme = "furo"
html_title = "jaxpets"
html_math_renderer = "mathml"
html_extra_path = ["_root"]  # the way from the top to the front page
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_prompt_text = ">>> "

MODULES = [
    jaxpets, coordinates, jaxpets.datasets, envs, formulas, half_cheetah, models,
    jaxpets.optimizers, jaxpets.rewards, jaxpets.typing,
]  # fmt: skip


def public_names() -> dict[str, Any]:
    """Returns everything public by its full name."""
    return {
        f"{module.__name__}.{name}": getattr(module, name)
        for module in MODULES
        for name in getattr(module, "__all__", ())
    }


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Links a name by which the code knows a thing to where the thing is described."""
    domain, target = env.get_domain("py"), node["reftarget"]
    name = target.rpartition(".")[2]
    known = domain.objects  # pyright: ignore[reportAttributeAccessIssue]
    found = [full for full in public_names() if full.endswith(f".{name}")]
    for full in found:
        if full in known and (target == name or target.startswith("jaxpets.")):
            return domain.resolve_xref(
                env, node["refdoc"], app.builder, "obj", full, node, content
            )
    return None


def check_public(app: Sphinx, env: BuildEnvironment) -> None:
    """Warns of every public thing that no page describes."""
    known = env.get_domain("py").objects  # pyright: ignore[reportAttributeAccessIssue]
    things = public_names()
    described = {id(things[full]) for full in things.keys() & known.keys()}
    for full, thing in things.items():
        if id(thing) not in described and not inspect.ismodule(thing):
            logging.getLogger(__name__).warning("%s is on no page", full)


def inline_math(writer: Any, node: nodes.math) -> None:
    """Writes an equation as MathML, which needs no program and no network."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_math(writer: Any, node: nodes.math_block) -> None:
    """Writes an equation that stands alone."""
    equation = tex2mathml(node.astext(), as_block=True)
    writer.body.append(f'<div class="math">{equation}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Adds the above to Sphinx."""
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    app.connect("missing-reference", resolve)
    app.connect("env-check-consistency", check_public)
