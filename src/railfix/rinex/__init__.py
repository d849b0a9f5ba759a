"""Readers of RINEX files, and what they are stored in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from railfix.rinex.observations import read_observations, scan_observations

if TYPE_CHECKING:
    from railfix.rinex.navigation import read_navigation

__all__ = ["read_navigation", "read_observations", "scan_observations"]


def __getattr__(name: str) -> Any:
    # On first use only: it reads SP3 too, and the reader of SP3 takes its lines from this room.
    if name == "read_navigation":
        from railfix.rinex.navigation import read_navigation

        return read_navigation
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
