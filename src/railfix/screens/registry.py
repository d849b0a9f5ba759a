"""Registry of the screens: one line each, the name of the screen and of its file, in the order in which they judge."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

from railfix.screens.base import Screen

_NAMES: Final = (
    "elevation",
    "cn0",
    "doppler",
    "antenna_pair",
    "raim",
    "antenna_spacing",
)

#: All screens. Those of single antennas judge first, then those of two, then RAIM, then those of positions.
SCREENS: Final[tuple[Screen[Any], ...]] = tuple(import_module(f"railfix.screens.{name}").SCREEN for name in _NAMES)
