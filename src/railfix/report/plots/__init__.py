"""Charts of tables and arrays, drawn with matplotlib or shown in the HTML pages of `railfix.report`.

There are two functions for each chart. For example, `error_over_time` returns a `Chart`. `plot_error_over_time` draws
this chart with matplotlib into the axes `ax`, or into a new figure, and returns the axes.

matplotlib is imported when a chart is drawn, not when this package is imported.
"""

from typing import Final

from railfix.report.plots.campaign import processing_time
from railfix.report.plots.chart import Chart, SkyEpochs
from railfix.report.plots.draw import draw_chart, draw_figure, draw_sky, plotter
from railfix.report.plots.errors import (
    error_over_chainage,
    error_over_time,
    error_ranges,
    errors_of_runs,
    levels_over_chainage,
    levels_over_time,
    stanford,
)
from railfix.report.plots.line import interval_distribution, interval_over_chainage, plan, satellites_over_time
from railfix.report.plots.screens import (
    draw_cn0_curve,
    draw_run_screens,
    draw_screen,
    list_screens,
    screen_over_chainage,
    screen_over_time,
)
from railfix.report.plots.signals import cn0_over_elevation, sky_epochs

plot_plan: Final = plotter(plan)
plot_error_over_time: Final = plotter(error_over_time)
plot_error_over_chainage: Final = plotter(error_over_chainage)
plot_error_ranges: Final = plotter(error_ranges)
plot_errors_of_runs: Final = plotter(errors_of_runs)
plot_stanford: Final = plotter(stanford)
plot_levels_over_time: Final = plotter(levels_over_time)
plot_levels_over_chainage: Final = plotter(levels_over_chainage)
plot_interval_over_chainage: Final = plotter(interval_over_chainage)
plot_interval_distribution: Final = plotter(interval_distribution)
plot_satellites_over_time: Final = plotter(satellites_over_time)
plot_processing_time: Final = plotter(processing_time)
plot_screen_over_time: Final = plotter(screen_over_time)
plot_screen_over_chainage: Final = plotter(screen_over_chainage)

__all__ = [
    "Chart",
    "SkyEpochs",
    "cn0_over_elevation",
    "draw_chart",
    "draw_cn0_curve",
    "draw_figure",
    "draw_run_screens",
    "draw_screen",
    "draw_sky",
    "error_over_chainage",
    "error_over_time",
    "error_ranges",
    "errors_of_runs",
    "interval_distribution",
    "interval_over_chainage",
    "levels_over_chainage",
    "levels_over_time",
    "list_screens",
    "plan",
    "plot_error_over_chainage",
    "plot_error_over_time",
    "plot_error_ranges",
    "plot_errors_of_runs",
    "plot_interval_distribution",
    "plot_interval_over_chainage",
    "plot_levels_over_chainage",
    "plot_levels_over_time",
    "plot_plan",
    "plot_processing_time",
    "plot_satellites_over_time",
    "plot_screen_over_chainage",
    "plot_screen_over_time",
    "plot_stanford",
    "processing_time",
    "satellites_over_time",
    "screen_over_chainage",
    "screen_over_time",
    "sky_epochs",
    "stanford",
]  # fmt: skip
