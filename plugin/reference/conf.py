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
