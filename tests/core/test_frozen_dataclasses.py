"""Frozen dataclasses with shared methods behave as those of the standard library."""

from __future__ import annotations

import dataclasses
import inspect
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from railfix.core import arrays


def made_by(dataclass: Callable[..., Any]) -> tuple[type[Any], type[Any]]:
    """A frozen dataclass and one derived from it, with each kind of field."""

    @dataclass(frozen=True, kw_only=True)
    class Place:
        """A place."""

        chainage_m: float
        side: str = "left"
        names: list[str] = dataclasses.field(default_factory=list)
        remark: str = dataclasses.field(default="", repr=False, compare=False)

    @dataclass(frozen=True)
    class Mast(Place):
        """A mast."""

        height_m: float = 8.0
        count: int = dataclasses.field(init=False, default=0)
        seen: list[int] = dataclasses.field(init=False, default_factory=list)

        def __post_init__(self) -> None:
            object.__setattr__(self, "count", len(self.names))

    return Place, Mast


OURS, THEIRS = made_by(arrays.dataclass), made_by(dataclasses.dataclass)


@pytest.mark.parametrize("which", [0, 1])
def test_signature_words_and_fields_are_those_of_the_standard_library(which: int) -> None:
    ours, theirs = OURS[which], THEIRS[which]
    own, expected = (inspect.signature(kind).parameters.values() for kind in (ours, theirs))
    assert [str(p) for p in own] == [str(p) for p in expected]
    assert [(f.name, f.type, f.init) for f in dataclasses.fields(ours)] == [
        (f.name, f.type, f.init) for f in dataclasses.fields(theirs)
    ]
    given: dict[str, Any] = {"chainage_m": 12.5, "names": ["a"], "remark": "seen twice"}
    one, other = ours(**given), theirs(**given)
    assert repr(one) == repr(other)
    assert vars(one) == vars(other)
    assert dataclasses.asdict(one) == dataclasses.asdict(other)


def test_equal_values_are_equal_and_unequal_classes_are_not() -> None:
    place, mast = OURS
    assert place(chainage_m=1.0, remark="x") == place(chainage_m=1.0)
    assert place(chainage_m=1.0) != place(chainage_m=2.0)
    assert place(chainage_m=1.0) != mast(chainage_m=1.0)
    with pytest.raises(TypeError, match="unhashable"):
        hash(place(chainage_m=1.0))  # a list among its values

    @arrays.dataclass(frozen=True)
    class Pair:
        """Two numbers."""

        first: int
        second: int

    assert hash(Pair(1, 2)) == hash(Pair(1, 2))
    assert len({Pair(1, 2), Pair(1, 2), Pair(2, 1)}) == 2


def test_a_factory_makes_a_value_for_each_instance() -> None:
    one, other = OURS[0](chainage_m=1.0), OURS[0](chainage_m=1.0)
    assert one.names == other.names
    assert one.names is not other.names


def test_fields_cannot_be_assigned_or_deleted() -> None:
    place = OURS[0](chainage_m=1.0)
    for name in ("chainage_m", "unknown"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(place, name, 2.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        del place.chainage_m
    assert place.chainage_m == 1.0
    for given in ({}, {"chainage_m": 1.0, "unknown": 2.0}):
        with pytest.raises(TypeError):
            OURS[0](**given)


def test_methods_of_its_own_are_kept() -> None:
    @arrays.dataclass(frozen=True)
    class Own:
        """A number that equals all."""

        value: int

        def __eq__(self, other: object) -> bool:
            return isinstance(other, Own)

        def __repr__(self) -> str:
            return "own"

    assert Own(1) == Own(2)
    assert repr(Own(1)) == "own"


@arrays.dataclass(frozen=True, kw_only=True)
class Carried:
    """What another process receives."""

    value: int
    more: tuple[int, ...] = ()


def test_copies_are_equal() -> None:
    one = Carried(value=1, more=(2, 3))
    assert pickle.loads(pickle.dumps(one)) == one
    assert dataclasses.replace(one, value=2) == arrays.copy_with(one, value=2) == Carried(value=2, more=(2, 3))


def test_others_are_those_of_the_standard_library() -> None:
    @arrays.dataclass(kw_only=True)
    class Counted:
        """A number that changes."""

        value: int = 0

    counted = Counted()
    counted.value = 3
    assert counted == Counted(value=3)


def test_rows_with_other_arrays_are_not_joined() -> None:
    """A column that one part lacks would be lost without a word."""

    @arrays.dataclass(frozen=True, kw_only=True)
    class Points(arrays.RowArrays):
        x_m: np.ndarray
        y_m: np.ndarray | None = None

    both, bare = Points(x_m=np.arange(2.0), y_m=np.ones(2)), Points(x_m=np.arange(3.0))
    assert arrays.join_rows([both, both.take(np.array([True, False]))]).x_m.tolist() == [0.0, 1.0, 0.0]
    for parts in ([both, bare], [bare, both]):
        with pytest.raises(ValueError, match="rows with other arrays than x_m"):
            arrays.join_rows(parts)
