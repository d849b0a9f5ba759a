"""``railfix reference``: reference trajectory of the antennas."""

from __future__ import annotations

from typing import Annotated

import typer

from railfix.cli.options import OutOption, Without, from_models
from railfix.reference import (
    ReferenceInputs,
    ReferenceOptions,
    ReferenceSettings,
    ReferenceSummary,
    reference_files,
)


@from_models
def reference(
    inputs: ReferenceInputs,
    settings: ReferenceSettings,
    options: Annotated[ReferenceOptions, Without("reference")],
    *,
    out: OutOption,
) -> None:
    r"""Build the reference trajectory of the antennas: fixed positions on the track, gaps between them bridged.

    Positions are rejected that are not fixed, have a low ratio, whose two antennas are not as far apart as on the
    vehicle, that lie off the antenna's trajectory, or that disagree with the distance travelled. The others are
    matched to the trajectory. Between them Doppler speeds, pulses and acceleration, whichever are given, are
    weighted by their variances, and the closing error of each gap is distributed over it. Written into DIR:

    - `reference.csv`: one row per instant and antenna; position, speed, standard deviation, source `rtk` or `bridged`
    - `fixes.csv`: every position with its verdict and measurements
    - `reference.json`: versions, hashes of the inputs, settings given and used, counts by reason, gaps

    Gaps that are too long and instants of too large a standard deviation are left out, counted and named. All times are
    GPS time.

    Example:

        railfix reference --rtk rtk.pos --track line.csv --vehicle car.toml \
            --front front.obs --nav brdc.nav --pulses tacho.csv --out reference

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not match each other; 7 fewer than two good fixes; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    asked = settings.model_dump(mode="json", exclude_unset=True)
    show_reference(reference_files(inputs, settings, out=out, options=options, asked=asked))


def show_reference(summary: ReferenceSummary) -> None:
    """Counts by antenna, the notes, and where the results are."""
    for name, part in summary.built.items():
        source = part.reference.source
        counts = part.fixes.counts()
        good = counts.pop("good")
        rejected = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count) or "none"
        typer.echo(f"{name}: {len(part.fixes):,} positions, {good:,} good fixes; rejected: {rejected}")
        by = ", ".join(f"{count:,} by {what}" for what, count in part.bridged_by.items()) or "none"
        bridged = source == "bridged"
        typer.echo(
            f"{name}: {int((source == 'rtk').sum()):,} instants from fixes, {int(bridged.sum()):,} bridged ({by})"
        )
        left = ", ".join(f"{count:,} {what.replace('_', ' ')}" for what, count in part.left_out.items() if count)
        typer.echo(f"{name}: left out: {left or 'none'}")
    for note in summary.notes:
        typer.echo(f"note: {note}")
    for path in summary.files.values():
        typer.echo(f"wrote {path}")
