"""The page of the plugin ``subdivision``, in the form that Mitsuba's documentation has for its plugins."""

from __future__ import annotations

from textwrap import fill

from .parameter_table import PARAMETERS, STATE_PARAMETERS, Parameter

_PAGE = """\
.. _shape-subdivision:

Subdivision surface (:monosp:`subdivision`)
-------------------------------------------

.. pluginparameters::
 :extra-rows: {count}

{rows}

This shape is the limit surface of a control cage. Every vertex of its tessellation lies on the limit surface and has
its normal, also at extraordinary vertices. The tessellation has no cracks.

When ``control_points`` or ``to_world`` are updated, the shape evaluates its vertices again and keeps its triangles, so
that a cage can be animated or optimised. An adaptive tessellation is chosen anew when its limit is updated, or by the
method ``retessellate()``. Attributes follow updates of their values at the cage, ``cage_NAME``.

Gradients of a rendering reach the control points, ``to_world``, attributes of the cage and displacements, in reverse
and in forward mode. Use one of the ``*_projective`` integrators where silhouettes move. Edges along creases and texture
seams do not count as silhouettes. For losses of several views, see ``mitsuba_subdivision.loss_of_views``.

With exact shading in JIT variants, ``traverse`` also shows the arrays that gradients pass through:
``shading_coefficients``, polynomials of the surface in object space; ``shading_to_world``, the matrix that takes them
to world space; and ``shading_cage_NAME``, the values that hits interpolate.

.. warning::
    The number of control points cannot change after loading, and all must be finite. With ``evaluator`` or
    ``sample_offset``, no gradients reach them, and the surface cannot be displaced. In forward mode, update before each
    view. Exact shading needs Mitsuba 3.9 and CPython on Linux on x86-64.

.. tabs::
    .. code-tab:: xml
        :name: subdivision-xml

        <shape type="subdivision">
            <string name="filename" value="cage.obj"/>
            <integer name="tessellation_rate" value="16"/>
            <bsdf type="principled"/>
        </shape>

    .. code-tab:: python

        import mitsuba_subdivision as msub

        'type': 'subdivision',
        **msub.ControlCage.from_file('cage.obj').as_properties(mi),
        'tessellation_rate': 16,
        'bsdf': {{
            'type': 'principled'
        }}
"""


def plugin_page() -> str:
    """The page as reStructuredText, with the parameter table."""
    rows = "\n\n".join(map(_row, (*PARAMETERS, *STATE_PARAMETERS)))
    return _PAGE.format(count=len(PARAMETERS), rows=rows)


def _row(parameter: Parameter) -> str:
    types = (f":paramtype:`{kind}`" if "[" in kind else f"|{kind}|" for kind in parameter.type.split(" or "))
    cells = [parameter.name, " or ".join(types), parameter.text]
    if parameter.flags:
        cells.append(", ".join(f"|{flag}|" for flag in parameter.flags))
    lines = (fill(cell, 110, subsequent_indent="     ", break_on_hyphens=False) for cell in cells)
    return " * - " + "\n   - ".join(lines)
