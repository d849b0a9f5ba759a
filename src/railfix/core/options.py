"""Fields of settings that are also options of the command line."""

from __future__ import annotations

from typing import Any

from pydantic import Field


def option(
    text: str,
    default: Any = ...,
    *,
    name: str | None = None,
    metavar: str | None = None,
    panel: str = "Choices",
    **limits: Any,
) -> Any:
    """Return a field of a `Settings` model that is also a command-line option; it is required if there is no `default`.

    The option is called ``--field-name`` unless `name` is given. A field with a `name`, a default and two allowed words
    (`Literal`) becomes a switch. `panel` is the heading in the help text; `limits` are passed to `pydantic.Field`.
    """
    extra: Any = {"option": name, "metavar": metavar, "panel": panel}
    return Field(default, description=text, json_schema_extra=extra, **limits)
