# The names of `railfix.core`, imported at their first use (lazy-loader): the command line needs only the errors.

from .errors import (
    InputFileError,
    MapQualityError,
    MismatchError,
    NoPositionError,
    OutputError,
    RailfixError,
    RailfixWarning,
    SettingsError,
)
from .files import file_sha256
from .reason_names import reason_text
from .reasons import Reason, Status
from .settings import Settings
from .settings_files import load_settings, read_toml, write_toml
from .staged_files import FilePath, write_whole

__all__ = [
    "FilePath",
    "InputFileError",
    "MapQualityError",
    "MismatchError",
    "NoPositionError",
    "OutputError",
    "RailfixError",
    "RailfixWarning",
    "Reason",
    "Settings",
    "SettingsError",
    "Status",
    "file_sha256",
    "load_settings",
    "read_toml",
    "reason_text",
    "write_toml",
    "write_whole",
]
