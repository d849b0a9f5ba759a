"""The errors that railfix raises, and the exit code of the program for each.

Every message is one sentence that names the file (and line or field), the expected content, and the remedy.
Array functions raise `ValueError` when an argument violates their contract.

==== ===============================================================================================================
code meaning
==== ===============================================================================================================
0    done
1    an internal error of railfix (a traceback is shown)
2    the command line is wrong (unknown option, missing argument)
3    an input file is missing, unreadable, or malformed
4    a setting is misspelt, out of range, or contradicts another setting
5    the inputs are readable but do not match each other, for example because they are from different days or places
6    the track map was checked and has errors
7    the results contain no position, or the inputs contain no usable position
8    the output cannot be written
9    the two processing channels of a live session computed different outputs from the same input
==== ===============================================================================================================
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from os import PathLike
from typing import ClassVar, Final


class RailfixError(Exception):
    """Base of all errors that a user can correct, in input files, settings or outputs."""

    exit_code: ClassVar[int] = 1  #: Exit code of the program after an error of this class.


class RailfixWarning(UserWarning):
    """A limitation of a result that the caller may be unaware of; the command line prints it as a note."""


def warn_of(notes: Iterable[str]) -> None:
    """Issue each distinct note as a `RailfixWarning` that points to the call of the public function."""
    for note in dict.fromkeys(notes):
        warnings.warn(note, RailfixWarning, stacklevel=3)


class InputFileError(RailfixError):
    """An input file is missing, unreadable or malformed.

    The message states what is wrong, what was expected and what to do, without a full stop at the end; `line` counts
    from 1.
    """

    exit_code = 3

    def __init__(self, path: str | PathLike[str], message: str, *, line: int | None = None) -> None:
        self.path = str(path)
        self.line = line
        self.message = message
        where = self.path if line is None else f"{self.path}, line {line}"
        super().__init__(f"{where}: {message}")


class SettingsError(RailfixError):
    """A setting is misspelt, out of range, or contradicts another."""

    exit_code = 4


#: For each type, the function that returns an object of this type.
_MAKERS: Final = {
    "Track": "read_track",
    "Trajectory": "antenna_trajectory",
    "Vehicle": "read_vehicle",
    "Navigation": "read_navigation",
    "Observations": "read_observations",
    "SbasMessages": "read_sbas",
    "Result": "EpochProcessor.process",
    "State": "EpochProcessor.process",
    "Scenario": "load_scenario",
}


def check_type(value: object, expected: type, what: str) -> None:
    """Raise SettingsError if a value is not of the expected type; `what` names the value in the message."""
    if not isinstance(value, expected):
        maker = f"; {_MAKERS[expected.__name__]} returns one" if expected.__name__ in _MAKERS else ""
        raise SettingsError(f"{what}: expected {expected.__name__}, got {type(value).__name__}{maker}")


class MismatchError(RailfixError):
    """Inputs are readable but do not match each other, for example because they are from different days or places."""

    exit_code = 5


class MapQualityError(RailfixError):
    """The quality report of a track map contains errors."""

    exit_code = 6


class NoPositionError(RailfixError):
    """The results have no position, or the inputs have no usable position."""

    exit_code = 7


class OutputError(RailfixError):
    """The output cannot be written."""

    exit_code = 8


class ChannelsDisagreeError(RailfixError):
    """The two processing channels of a live session computed different outputs from the same input."""

    exit_code = 9
