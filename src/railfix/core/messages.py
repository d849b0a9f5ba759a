"""Base of messages between programs."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import model_validator

from railfix.core.settings import Checked, is_number


class Message(Checked):
    """Base of messages between programs, validated in one pass over all values for speed."""

    _numbers: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Store the names of the fields that are numbers."""
        cls._numbers = frozenset(name for name, field in cls.model_fields.items() if is_number(field.annotation))

    @model_validator(mode="before")
    @classmethod
    def _truth_for_a_number(cls, values: Any) -> Any:
        """Reject a boolean where a number is expected; pydantic would accept the boolean as 1 or 0."""
        for name, value in values.items() if isinstance(values, dict) else ():
            if (value is True or value is False) and name in cls._numbers:
                raise ValueError(f"{name}: a number was expected")
        return values
