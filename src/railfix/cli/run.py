"""``railfix run``: logs, navigation and a track map in, a folder of positions out."""

from __future__ import annotations

from typing import Annotated

from railfix.cli.console import prepare_kernels, progress_bar, show_summary
from railfix.cli.options import Choices, OutOption, Without, from_models, settings_of
from railfix.run import RunInputs, RunOptions, run_files


@from_models
def run(
    inputs: Annotated[RunInputs, Without("truth")], choices: Choices, options: RunOptions, *, out: OutOption
) -> None:
    r"""Positions along the line from receiver logs, navigation files and a track map.

    Reads RINEX 2, 3 and 4 (plain, .gz, .Z, Hatanaka), reads the log in pieces, and writes into DIR:

    - `positions.csv` and `positions.parquet`: one row per epoch and antenna, also without a
      position: chainage, its standard deviation, coordinates, and the conventional position for
      comparison
    - `train.csv` and `train.parquet`: positions of the filter along the track over all epochs so far,
      with speed, direction and the probability of the branch (not with `--filter off`); with `--smooth` also by
      what was measured later
    - `tracks.csv` and `tracks.parquet` (TRACK a network of tracks in one file): every track near each position with
      its probability; the route is found from the log, and alternatives are named
    - `track.csv`: the track as it was used, where it is not that of its file (route of a network, other heights or
      frame)
    - `observations.parquet` (with `--observations`): one row per epoch, satellite and signal
    - `run.json`: versions, hashes of the inputs, settings given and used, counts by status and
      reason, positioning rate

    Times are GPS time, as the receiver tagged them. The results appear in DIR when the run is complete; an
    error leaves nothing there.

    Example:

        railfix run --front front.obs --rear rear.obs --nav brdc.nav \
            --track line.csv --vehicle car.toml --out results

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not match each other; 7 not one position; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    settings, asked = settings_of(choices)
    inputs = inputs.replaced(config=choices.config)
    prepare_kernels()
    with progress_bar() as progress:
        summary = run_files(inputs, settings, out=out, options=options, asked=asked, progress=progress)
    show_summary(summary)
