"""Names for the arrays that kernels take and return.

Their classes depend on the backend and the precision, and are known at run time only, see `ArrayTypes`. An array has a
number or a vector for each lane. In scalar variants there is one lane, and numbers are Python's float, int and bool.

Float
    A real number: a parameter u or v, a distance, a weight.
Index
    An unsigned 32-bit integer, counted from 0: a half-edge, an element, a row of a table.
Mask
    A truth value. Inactive lanes read zeros and write nothing.
Vector2, Vector3, Vector4
    Parameters (u, v), say; a point, a direction or a normal, in `vectors` also a list of three arrays; a packet of a
    table that is read by four numbers at once.
Index4
    Four indices, such as a row of `PieceTable.half_edges` or `PieceTable.nodes`.
Matrix4
    A matrix of four rows and columns, of Dr.Jit or NumPy, which maps points as columns.
Value
    A value of a surface or of a channel, or a derivative of it: a number, or a vector of two or three.
FloatBuffer, IndexBuffer
    Numbers or indices in memory, one after the other, whatever the lanes: x, y, z of each point, say. NumPy arrays in
    scalar variants.
Ray
    An object with an origin ``o`` and a direction ``d``, such as Mitsuba's rays.
"""

from __future__ import annotations

# Imports instead of aliases: mypy resolves Dr.Jit's overloaded functions wrongly for an alias of Any.
from typing import Any as Float
from typing import Any as FloatBuffer
from typing import Any as Index
from typing import Any as Index4
from typing import Any as IndexBuffer
from typing import Any as Mask
from typing import Any as Matrix4
from typing import Any as Ray
from typing import Any as Value
from typing import Any as Vector2
from typing import Any as Vector3
from typing import Any as Vector4

__all__ = [
    "Float",
    "FloatBuffer",
    "Index",
    "Index4",
    "IndexBuffer",
    "Mask",
    "Matrix4",
    "Ray",
    "Value",
    "Vector2",
    "Vector3",
    "Vector4",
]
