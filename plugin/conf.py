"""Sphinx settings of the documentation: the guide, the pages beside the code, and the API reference.

Pages are written for GitHub. Links to other files download them. The README above this folder begins the start page.
"""

import re
from pathlib import Path

import mitsuba_subdivision
from docutils import nodes
from sphinx.util.nodes import make_refnode

project = "mitsuba-subdivision"
release = mitsuba_subdivision.__version__
html_title = f"{project} {release}"
html_theme = "furo"

extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinxcontrib.mermaid"]
exclude_patterns = ["mitsuba_subdivision", "mitsuba_usd", "reference/build", "**/__pycache__", "**/.ipynb_checkpoints"]

myst_enable_extensions = ["dollarmath", "html_image"]
myst_fence_as_directive = ["mermaid"]
myst_heading_anchors = 3  # Deep enough for all linked headings, with GitHub's names
nb_execution_mode = "off"  # Stored outputs of notebooks; the tests run them

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # Types are in the docstrings, with the shapes of arrays
autodoc_preserve_defaults = True
numpydoc_show_class_members = False  # Members have separate entries
default_role = "py:obj"  # Names between backticks are links if the reference has them

_TOP = Path(__file__).resolve().parents[1]


def setup(app):
    """Adapt pages and docstrings."""
    app.connect("source-read", _from_here)
    # Omit Python's docstrings of the fields of named tuples; the class describes them.
    app.connect("autodoc-skip-member", _is_skipped)
    app.connect("doctree-resolved", _link_names)


def _from_here(_app, page, source):
    """Begin the start page with the README, and redirect links to the README."""
    if page == "index":
        readme = (_TOP / "README.md").read_text(encoding="utf-8")
        readme = re.sub(r'(\]\(|src=")(?=renders/|LICENSE)', r"\1../", readme)
        source[0] = readme.replace("](plugin/", "](") + source[0]
    source[0] = re.sub(r"\]\((\.\./)+README\.md\)", f"]({'../' * page.count('/')}index.md)", source[0])


def _is_skipped(_app, _what, _name, member, _skip, _options):
    return True if (member.__doc__ or "").startswith("Alias for field number") else None  # None: left to Sphinx


def _link_names(app, tree, page):
    """Link names between backticks on Markdown pages to the API reference, if it has them."""
    if page.startswith("reference/"):
        return
    objects = app.env.get_domain("py").objects
    for literal in list(tree.findall(nodes.literal)):
        name = literal.astext().removeprefix("msub.")
        # Plain lower-case words are often parameters, files or commands.
        if isinstance(literal.parent, nodes.reference) or not re.search(r"[A-Z_.]", name):
            continue
        # An object has a public name and a name where it is defined, with one target.
        places = {(entry.docname, entry.node_id) for full, entry in objects.items() if f".{full}".endswith(f".{name}")}
        if len(places) == 1:
            parent, at = literal.parent, literal.parent.index(literal)
            parent[at] = make_refnode(app.builder, page, *places.pop(), literal)
