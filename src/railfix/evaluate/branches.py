"""Stated probability of the place against its correctness: calibration of the filter's hypotheses over branches."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import polars as pl

from railfix.evaluate.epochs import OF_FILTER
from railfix.evaluate.figures import ALL, KEYS
from railfix.evaluate.scores import WRONG_PLACE_M

#: Limits of the classes of probability.
_EDGES: Final = (0.0, 0.5, 0.9, 0.99, 0.999, 1.0)

_USED: Final = ("in_reference", "reference_good", "positioned", "branch_probability", "distance_m", "block")

#: Columns of the table of probabilities beside its keys, with their unit and meaning.
BRANCH_COLUMNS: Final[dict[str, str]] = {
    "probability": "class of the stated probability of the place; `all` for every epoch",
    "judged": "positions of the class with an error",
    "probability_mean": "mean of the stated probabilities",
    "right_share": "share of the places within 50 m of the reference, straight distance",
    "wrong_places": "places further away",
    "blocks": "blocks of time with such an epoch: about the number of independent ones",
    "wrong_blocks": "blocks with a wrong place",
}


def branch_table(epochs: pl.DataFrame) -> pl.DataFrame | None:
    """Stated probability against the share of right places, by class; None without a table of the filter.

    Of `railfix.evaluate.epochs.EPOCH_COLUMNS` of all runs. Calibrated probabilities have a `right_share` of at least
    `probability_mean`: a hypothesis rejected can be near.
    """
    filtered = epochs.select(*KEYS, *_USED).filter(OF_FILTER)
    if not len(filtered):
        return None
    judged = filtered.filter("in_reference", "reference_good", "positioned")
    names = [f"{low:g} to {high:g}" for low, high in pairwise(_EDGES)]
    rank = pl.sum_horizontal((pl.col("branch_probability") >= edge).cast(pl.Int64) for edge in _EDGES[1:-1])
    wrong = pl.col("distance_m") > WRONG_PLACE_M
    figures = [
        pl.len().cast(pl.Int64).alias("judged"),
        pl.col("branch_probability").mean().alias("probability_mean"),
        (1.0 - wrong.mean()).alias("right_share"),
        wrong.sum().cast(pl.Int64).alias("wrong_places"),
        pl.col("block").n_unique().cast(pl.Int64).alias("blocks"),
        pl.col("block").filter(wrong).n_unique().cast(pl.Int64).alias("wrong_blocks"),
    ]
    ranked = judged.with_columns(rank=rank)
    tables = [
        ranked.group_by([*KEYS, "rank"], maintain_order=True).agg(figures),
        ranked.with_columns(rank=pl.lit(len(names), pl.Int64))
        .group_by([*KEYS, "rank"], maintain_order=True)
        .agg(figures),
    ]
    table = pl.concat(tables).with_columns(probability=pl.col("rank").replace_strict(dict(enumerate([*names, ALL]))))
    return table.sort(*KEYS, "rank", maintain_order=True).select(*KEYS, *BRANCH_COLUMNS)
