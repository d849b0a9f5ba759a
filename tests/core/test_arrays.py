"""Copies and rows of frozen dataclasses, and sums over channels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest

from railfix.core.arrays import RowArrays, channel_sums, copy_with, join_rows


def test_copies_are_equal() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Place:
        value: int
        more: tuple[int, ...] = ()

    place = Place(value=1, more=(2, 3))
    assert dataclasses.replace(place, value=2) == copy_with(place, value=2) == Place(value=2, more=(2, 3))
    with pytest.raises(dataclasses.FrozenInstanceError):
        place.value = 3  # type: ignore[misc]


def test_rows_with_other_arrays_are_not_joined() -> None:
    """A column that one part lacks would be lost without a word."""

    @dataclass(frozen=True, kw_only=True)
    class Points(RowArrays):
        x_m: np.ndarray
        y_m: np.ndarray | None = None

    both, bare = Points(x_m=np.arange(2.0), y_m=np.ones(2)), Points(x_m=np.arange(3.0))
    assert join_rows([both, both.take(np.array([True, False]))]).x_m.tolist() == [0.0, 1.0, 0.0]
    for parts in ([both, bare], [bare, both]):
        with pytest.raises(ValueError, match="dataclasses with different array fields; expected x_m"):
            join_rows(parts)


@pytest.mark.requirement("A8")
def test_sums_over_channels_are_those_without_channels_of_zeros_to_the_last_bit() -> None:
    """As for the epochs of a log, with all its channels, and for a single one, with its own."""
    random = np.random.default_rng(2)
    own = random.normal(0.0, 1.0, (200, 13))
    for channels in (20, 47):
        wide = np.zeros((200, channels))
        wide[:, np.sort(random.permutation(channels)[:13])] = own
        np.testing.assert_array_equal(channel_sums(wide), channel_sums(own))
        assert (wide.sum(axis=1) != own.sum(axis=1)).any()  # numpy's order depends on the number of channels
    np.testing.assert_allclose(channel_sums(own), own.sum(axis=1), rtol=0.0, atol=1e-13)
    assert channel_sums(np.zeros((3, 0))).tolist() == [0.0, 0.0, 0.0]
