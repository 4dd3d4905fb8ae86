"""Settings of Sphinx for the documentation: the guide, the pages beside the code, and the API reference.

Pages are written for GitHub, and read here as they are. Links to other files download them. The README lies above this
folder; it begins the start page.
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
# Deep enough for every heading that a link leads to, with GitHub's names.
myst_heading_anchors = 3
# Notebooks are shown as they are stored; the tests run them.
nb_execution_mode = "off"

autodoc_default_options = {"members": True, "member-order": "bysource"}
# Types are in the docstrings, with the shapes of arrays.
autodoc_typehints = "none"
autodoc_preserve_defaults = True
# Members have entries of their own.
numpydoc_show_class_members = False
# Names between backticks are links where the reference has them.
default_role = "py:obj"

_TOP = Path(__file__).resolve().parents[1]


def setup(app):
    """Have pages and docstrings read in another way than they are written."""
    app.connect("source-read", _from_here)
    # Leave out what Python says of each field of a named tuple; the docstring of the class describes them.
    app.connect("autodoc-skip-member", _is_skipped)
    app.connect("doctree-resolved", _link_names)


def _from_here(_app, page, source):
    """Begin the start page with the README, and lead links to the README to the start page."""
    if page == "index":
        readme = (_TOP / "README.md").read_text(encoding="utf-8")
        readme = re.sub(r'(\]\(|src=")(?=renders/|LICENSE)', r"\1../", readme)
        source[0] = readme.replace("](plugin/", "](") + source[0]
    source[0] = re.sub(r"\]\((\.\./)+README\.md\)", f"]({'../' * page.count('/')}index.md)", source[0])


def _is_skipped(_app, _what, _name, member, _skip, _options):
    # None leaves it to Sphinx.
    return True if (member.__doc__ or "").startswith("Alias for field number") else None


def _link_names(app, tree, page):
    """Lead names between backticks on Markdown's pages to the API reference, where it has one of that name."""
    if page.startswith("reference/"):
        return
    objects = app.env.get_domain("py").objects
    for literal in list(tree.findall(nodes.literal)):
        name = literal.astext().removeprefix("msub.")
        # Plain words of small letters are often something else: parameters, files, commands.
        if isinstance(literal.parent, nodes.reference) or not re.search(r"[A-Z_.]", name):
            continue
        # An object has a name where it is public, and one where it is defined: both lead to one place.
        places = {(entry.docname, entry.node_id) for full, entry in objects.items() if f".{full}".endswith(f".{name}")}
        if len(places) == 1:
            parent, at = literal.parent, literal.parent.index(literal)
            parent[at] = make_refnode(app.builder, page, *places.pop(), literal)
