"""Work in threads: compiled kernels and numpy's loops release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Value = TypeVar("Value")


def in_threads(function: Callable[[Item], Value], items: Iterable[Item]) -> list[Value]:
    """Return what a function returns for each item, several computed at a time; raises what the function raises."""
    every = list(items)
    if len(every) < 2:
        return [function(item) for item in every]
    with ThreadPoolExecutor() as threads:
        return list(threads.map(function, every))
