"""Error for optional packages that are not installed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from railfix.core.errors import SettingsError

#: Names of optional packages, and of the extras of railfix that install them.
_EXTRAS: Final = {
    **dict.fromkeys(("cbor2", "serial", "h11"), "live"),
    "paho": "mqtt",
    **dict.fromkeys(("aioquic", "cryptography", "starlette", "uvicorn", "sqlalchemy"), "ground"),
    "distributed": "cluster",
    "mcap_ros2": "mcap",
    **dict.fromkeys(("pyogrio", "shapely", "rasterio", "jgdtrans", "rdflib"), "maps"),
}


@contextmanager
def needs_extra(what: object = "this") -> Iterator[None]:
    """Raise SettingsError if an optional package imported in the with-block is not installed.

    The message states that `what` needs the package, and names the extra of railfix that installs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get(str(error.name).partition(".")[0])
        if extra is None:
            raise
        needed = f"{what} needs {error.name}, which is not installed; pip install 'railfix[{extra}]'"
        raise SettingsError(needed) from None
