"""Registry of the screens of railfix, and of screens that other packages provide as entry points."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Final

from railfix.core.errors import SettingsError
from railfix.screens.base import ObservationScreen, Screen
from railfix.screens.pairs import PairScreen, PositionScreen

#: Entry-point group of the screens in other packages.
GROUP: Final = "railfix.screens"
_NAMES: Final = ("elevation", "cn0", "doppler", "antenna_pair", "raim", "antenna_spacing")


def in_order(screens: Iterable[Screen[Any]]) -> tuple[Screen[Any], ...]:
    """Return screens in order of execution: single-antenna screens, antenna-pair screens, RAIM, position screens."""
    return tuple(sorted(screens, key=_rank))


def _rank(screen: Screen[Any]) -> int:
    kinds = ((ObservationScreen, 0), (PairScreen, 1), (PositionScreen, 3))
    return next((rank for kind, rank in kinds if isinstance(screen, kind)), 2)


def _find_installed() -> list[Screen[Any]]:
    """Load the screens of installed packages; raise SettingsError if an object is no screen or its name is taken."""
    found: list[Screen[Any]] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        package = entry.dist.name if entry.dist else "?"
        screen = entry.load()
        if not isinstance(screen, Screen):
            raise SettingsError(
                f"the entry point {entry.name} of the package {package} (group {GROUP}) is {type(screen).__name__}, "
                "but must be a railfix.screens.Screen; correct or uninstall the package"
            )
        if screen.name in (*_NAMES, *(other.name for other in found)):
            raise SettingsError(
                f"the package {package} has a screen {screen.name}, a name that is taken; "
                "rename the screen or uninstall the package"
            )
        found.append(screen)
    return found


#: All screens in their order of execution.
SCREENS: Final[tuple[Screen[Any], ...]] = in_order(
    (*(import_module(f"railfix.screens.{name}").SCREEN for name in _NAMES), *_find_installed())
)
