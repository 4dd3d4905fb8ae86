"""Records: classes that only hold values, without the code that Python compiles for dataclasses and named tuples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

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
    record equals itself only, unless its class says otherwise. `_asdict` and `_replace` are those of named tuples.
    """

    _names: ClassVar[tuple[str, ...]] = ()
    _required: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls) -> None:
        own = [name for name, kind in cls.__annotations__.items() if "ClassVar" not in str(kind)]
        cls._names = tuple(dict.fromkeys((*cls._names, *own)))
        cls._required = frozenset(name for name in cls._names if not hasattr(cls, name))

    def __init__(self, *values: Any, **named: Any) -> None:
        own = vars(self)
        own.update(zip(self._names, values, strict=False), **named)
        if named or len(values) != len(self._names):
            # Some are named, have defaults, or are wrong.
            given = len(values) + len(named)
            if len(own) < given or not self._required <= own.keys() <= set(self._names):
                expected = ", ".join(self._names)
                raise TypeError(f"{type(self).__name__} takes {expected}; got {len(values)} values and {[*named]}")

    def _asdict(self) -> dict[str, Any]:
        """All values."""
        return {name: getattr(self, name) for name in self._names}

    def _replace(self, **changes: Any) -> Self:
        """Record with some other values."""
        return type(self)(**{**self._asdict(), **changes})

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        from dataclasses import FrozenInstanceError

        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        from dataclasses import FrozenInstanceError

        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self._asdict().items())
        return f"{type(self).__qualname__}({values})"
