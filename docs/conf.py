"""The site: the repository's own pages where they lie, and the library's docstrings.

Its source is the whole repository, so a link means the same here and on the host of the
code, and nothing is written twice. `make docs` builds it.
"""

import inspect
from pathlib import Path
from typing import Any

import jupytext
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

import jaxpets
from jaxpets import coordinates, envs, formulas, models, policies

ROOT = Path(__file__).parents[1]
LOG = logging.getLogger(__name__)

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
    "jaxpets/models/**.md",
    "results/*.md",
    "results/*/report/report.md",
]
_folders = {pattern.partition("/")[0] for pattern in include_patterns}
exclude_patterns = ["docs/_build"] + [
    path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in _folders
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # as the code's host names them
linkcheck_anchors = False  # of pages that are programs
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
html_show_copyright = False
html_math_renderer = "mathml"
html_extra_path = ["_root"]  # the way from the top to the front page
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_prompt_text = ">>> "

# Modules with public names, and whether these go without their module in a text.
MODULES = {
    jaxpets: True,
    jaxpets.optimizers: True,
    jaxpets.rewards: True,
    coordinates: False,
    jaxpets.datasets: False,
    envs: False,
    formulas: False,
    models: False,
    policies: False,
    jaxpets.typing: True,
}
PUBLIC = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in MODULES
    for name in module.__all__
}
# Full names by what a text calls them; the first module that has a name owns it.
BARE: dict[str, list[str]] = {}
for _module, _alone in MODULES.items():
    for _name in _module.__all__ if _alone else ():
        BARE.setdefault(_name, []).append(f"{_module.__name__}.{_name}")


def called(text: str) -> list[str]:
    """Returns the full names that a text may mean."""
    last = text.rpartition(".")[2]
    full = [name for name in (text, f"jaxpets.{text}") if name in PUBLIC]
    same = [name for name, x in PUBLIC.items() if full and x is PUBLIC[full[0]]]
    private = text.startswith("jaxpets._src.") or text == last
    return [*full, *same, *(BARE.get(last, []) if private else [])]


def link_names(app: Sphinx, doctree: nodes.document) -> None:
    """Links what stands in backticks in a page to where it is described.

    In the accounts of results a name without its module is that of an arm.
    """
    page = app.env.docname
    ours = page == "README" or page.startswith("docs/")
    for node in list(doctree.findall(nodes.literal)):
        text = node.astext()
        inside = isinstance(node.parent, nodes.reference | pending_xref)
        if not inside and called(text) and ("." in text or ours):
            about = {"refdomain": "py", "reftype": "obj", "reftarget": text}
            node.replace_self(pending_xref("", node.deepcopy(), refdoc=page, **about))


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Links a name by which the code knows a thing to where the thing is described."""
    domain: Any = env.get_domain("py")
    for full in called(node["reftarget"]):
        if full in domain.objects:
            page = node["refdoc"]
            return domain.resolve_xref(
                env, page, app.builder, "obj", full, node, content
            )
    return None


def check_public(app: Sphinx, env: BuildEnvironment) -> None:
    """Warns of every public thing that no page describes."""
    domain: Any = env.get_domain("py")
    described = {id(PUBLIC[full]) for full in PUBLIC.keys() & domain.objects.keys()}
    for full, thing in PUBLIC.items():
        if id(thing) not in described and not inspect.ismodule(thing):
            LOG.warning("%s is on no page", full)


def inline_math(writer: Any, node: nodes.math) -> None:
    """Writes an equation as MathML, which needs no program and no network."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_math(writer: Any, node: nodes.math_block) -> None:
    """Writes an equation that stands alone."""
    equation = tex2mathml(node.astext(), as_block=True)
    writer.body.append(f'<div class="math">{equation}</div>')
    raise nodes.SkipNode


def write_notebook(app: Sphinx) -> None:
    """Writes the tour as Jupyter and Colab want it, for the front page to link to."""
    tour = jupytext.read(ROOT / "examples" / "tour.py")
    jupytext.write(tour, ROOT / "docs" / "_build" / "tour.ipynb")


def setup(app: Sphinx) -> None:
    """Adds the above to Sphinx."""
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    app.connect("doctree-read", link_names)
    app.connect("missing-reference", resolve)
    app.connect("env-check-consistency", check_public)
    app.connect("builder-inited", write_notebook)
