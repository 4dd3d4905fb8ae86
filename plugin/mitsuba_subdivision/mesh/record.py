"""Records: classes that only hold values, without the code that Python compiles for dataclasses and named tuples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from typing_extensions import Self, dataclass_transform
else:

    def dataclass_transform(**_):
        """Stand in for what Python has from 3.11 on, and only type checkers need."""
        return lambda cls: cls


@dataclass_transform(frozen_default=True, eq_default=False)
class Record:
    """Base of classes that hold values, which are set once.

    A subclass annotates its values in their order, as a frozen dataclass does. What has a default may be left out. A
    record equals itself only, unless its class says otherwise.
    """

    def __init__(self, *values: Any, **named: Any) -> None:
        vars(self).update(zip(type(self).__annotations__, values, strict=False), **named)

    def replaced(self, **changes: Any) -> Self:
        """Record with some other values."""
        kept = {name: getattr(self, name) for name in type(self).__annotations__}
        return type(self)(**{**kept, **changes})

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        from dataclasses import FrozenInstanceError

        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        from dataclasses import FrozenInstanceError

        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in type(self).__annotations__)
        return f"{type(self).__qualname__}({values})"
