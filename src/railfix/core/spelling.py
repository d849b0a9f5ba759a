"""Suggestions for misspelt names of columns, properties and settings."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def misspelt(names: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """Names that are close to a known one but not it, with that one.

    Examples
    --------
    >>> misspelt(["lattitude_deg", "remark"], ["latitude_deg", "height_m"])
    {'lattitude_deg': 'latitude_deg'}
    """
    known = list(known)
    close = {
        name: difflib.get_close_matches(name.lower().replace(" ", "_"), known, n=1, cutoff=0.75)
        for name in names
        if name not in known
    }
    return {name: matches[0] for name, matches in close.items() if matches}
