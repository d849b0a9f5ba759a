"""Checks that the settings of the simulator share: each names the table, the field and what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from railfix.core.errors import SettingsError


def _values(table: Any, name: str) -> tuple[float, ...]:
    value = getattr(table, name)
    return tuple(value) if isinstance(value, Sequence) else (value,)


def require_positive(table: Any, *names: str) -> None:
    """Raise `SettingsError` unless the fields (numbers) are finite and above zero."""
    for name in names:
        if not all(np.isfinite(v) and v > 0 for v in _values(table, name)):
            raise SettingsError(f"{type(table).__name__}.{name} must be positive, got {getattr(table, name)!r}")


def require_not_negative(table: Any, *names: str) -> None:
    """Raise `SettingsError` unless the fields (numbers, or several) are finite and at least zero."""
    for name in names:
        if not all(np.isfinite(v) and v >= 0 for v in _values(table, name)):
            raise SettingsError(f"{type(table).__name__}.{name} must not be negative, got {getattr(table, name)!r}")


def require_finite(table: Any, *names: str) -> None:
    """Raise `SettingsError` unless the fields (numbers, or several) are finite."""
    for name in names:
        if not all(np.isfinite(v) for v in _values(table, name)):
            raise SettingsError(f"{type(table).__name__}.{name} must be finite, got {getattr(table, name)!r}")


def require_share(table: Any, *names: str) -> None:
    """Raise `SettingsError` unless the fields lie in [0, 1]."""
    for name in names:
        if not 0.0 <= getattr(table, name) <= 1.0:
            raise SettingsError(f"{type(table).__name__}.{name} must lie in [0, 1], got {getattr(table, name)!r}")


def require_one_of(table: Any, name: str, allowed: Sequence[object]) -> None:
    """Raise `SettingsError` unless the field is one of some words."""
    if getattr(table, name) not in allowed:
        raise SettingsError(f"{type(table).__name__}.{name} must be one of {allowed}, got {getattr(table, name)!r}")


def require_interval(table: Any) -> None:
    """Raise `SettingsError` unless ``start_s < end_s`` (an end of None is the end of the run)."""
    if not (np.isfinite(table.start_s) and (table.end_s is None or table.end_s > table.start_s)):
        raise SettingsError(
            f"{type(table).__name__}.end_s must lie after start_s, got start_s = {table.start_s}, end_s = {table.end_s}"
        )
