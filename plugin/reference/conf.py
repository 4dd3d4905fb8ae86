"""Settings of Sphinx for the API reference, which is made from the docstrings of the package."""

import mitsuba_subdivision

project = "mitsuba-subdivision"
release = mitsuba_subdivision.__version__
html_title = f"{project} {release}"

extensions = ["sphinx.ext.autodoc", "numpydoc"]
exclude_patterns = ["html"]
autodoc_default_options = {"members": True, "member-order": "bysource"}
# Types are in the docstrings, with the shapes of arrays.
autodoc_typehints = "none"
autodoc_preserve_defaults = True
# Members have entries of their own.
numpydoc_show_class_members = False
# Names between backticks are links where the reference has them.
default_role = "py:obj"


def setup(app):
    """Leave out what Python says of each field of a named tuple; the docstring of the class describes them."""
    app.connect("autodoc-skip-member", _is_skipped)


def _is_skipped(_app, _what, _name, member, _skip, _options):
    # None leaves it to Sphinx.
    return True if (member.__doc__ or "").startswith("Alias for field number") else None
