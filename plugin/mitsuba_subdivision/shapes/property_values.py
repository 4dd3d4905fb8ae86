"""Values of the properties that a scene gives to a shape, checked for their types."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def errors_about(parameter: str) -> Iterator[None]:
    """Have errors of value say which parameter they are about."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f'parameter "{parameter}": {error}') from None


def value_of(props: Any, name: str, kind: type | tuple, expected: str, default: Any) -> Any:
    """The value of a property; a default where there is none.

    Raises
    ------
    ValueError
        If it has another type; says what was expected.
    """
    if name not in props:
        return default
    value = props[name]
    # In Python true is an integer as well.
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise ValueError(f'parameter "{name}" is {value!r}; expected {expected}')
    return value
