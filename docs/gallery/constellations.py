"""
Fewer constellations
====================

A position along the line has two unknowns fewer than a 3-D position, and therefore requires fewer satellites. This
example computes positions of the demonstration with four choices of constellations. It compares the rates, errors and
protection levels of single epochs and of the filter.
"""

import polars as pl

import railfix
from railfix.report import plots

files = railfix.demo_files()
track, vehicle = railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"])
trajectory = {"front": railfix.antenna_trajectory(track, vehicle, "front")}
navigation = railfix.read_navigation(files["nav"])
log = {"front": railfix.read_observations(files["front"])}
truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
truth = truth.select("time_gpst", "antenna", true_m="chainage_m")


def errors_with(systems):
    """Return the tables of single epochs and of the filter with their errors along the line."""
    processor = railfix.EpochProcessor(railfix.Config(systems=systems), trajectory, navigation=navigation)
    result, _ = processor.process(log)
    tables = {"single epochs": railfix.positions_table(result), "filter": railfix.train_table(result)}
    return {
        name: table.join(truth, on=["time_gpst", "antenna"], maintain_order="left").with_columns(
            error_m=pl.col("chainage_m") - pl.col("true_m")
        )
        for name, table in tables.items()
    }


choices = {"G": ("G",), "E": ("E",), "G, J": ("G", "J"), "G, J, E": ("G", "J", "E")}
errors = {name: errors_with(systems) for name, systems in choices.items()}

# %%
# The choices are GPS alone (G), Galileo alone (E), GPS with QZSS (J), and all three. The filter also has a position in
# the tunnel, and where single epochs have too few satellites.

pl.concat(
    table.select(
        systems=pl.lit(systems),
        position=pl.lit(position),
        rate=pl.col("chainage_m").is_not_null().mean(),
        median_m=pl.col("error_m").abs().median(),
        p95_m=pl.col("error_m").abs().quantile(0.95),
        largest_m=pl.col("error_m").abs().max(),
        level_m=pl.col("protection_level_m").median(),
    )
    for systems, tables in errors.items()
    for position, table in tables.items()
)

# %%
# Satellites used and rejected with GPS alone.

plots.plot_satellites_over_time(errors["G"]["single epochs"])
