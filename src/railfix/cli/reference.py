"""``railfix reference``: where the antennas really were."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from railfix.cli.options import (
    CHOICES,
    INPUTS,
    CrsOption,
    DatumOption,
    GeoidOption,
    LenientOption,
    OutOption,
    OverwriteOption,
    RearOption,
    TrackOption,
    VehicleOption,
)

if TYPE_CHECKING:
    from railfix.reference import ReferenceSummary

_LIMITS = "Limits"


def _positions(option: str, whose: str) -> Any:
    return typer.Option(
        option,
        metavar="FILE",
        rich_help_panel=INPUTS,
        help=f"Positions of the {whose} antenna: RTKLIB .pos, NMEA (.nmea) or CSV with named columns.",
    )


def _table(option: str, text: str) -> Any:
    return typer.Option(option, metavar="CSV", rich_help_panel=INPUTS, help=text)


def _limit(option: str, text: str) -> Any:
    return typer.Option(option, rich_help_panel=_LIMITS, help=text)


def reference(
    *,
    track: TrackOption,
    out: OutOption,
    rtk: Annotated[Path | None, _positions("--rtk", "front (or only)")] = None,
    rtk_rear: Annotated[Path | None, _positions("--rtk-rear", "rear")] = None,
    vehicle: VehicleOption = None,
    front: Annotated[
        list[Path] | None,
        typer.Option(
            "--front",
            metavar="OBS",
            rich_help_panel=INPUTS,
            help="RINEX observation file of the front antenna, for Doppler speeds; repeat it for several.",
        ),
    ] = None,
    rear: RearOption = None,
    nav: Annotated[
        list[Path] | None,
        typer.Option("--nav", metavar="FILE", rich_help_panel=INPUTS, help="RINEX navigation file, for the same."),
    ] = None,
    pulses: Annotated[
        Path | None,
        _table(
            "--pulses", "Tachometer: time_gpst and count, or distance_m, or one row a pulse; direction where known."
        ),
    ] = None,
    acceleration: Annotated[
        Path | None,
        _table(
            "--acceleration", "time_gpst and specific_force_mps2 (as an accelerometer measures) or acceleration_mps2."
        ),
    ] = None,
    wheel_circumference: Annotated[
        float | None,
        _limit("--wheel-circumference", "Of the wheel with the tachometer [m]; from the fixes without it."),
    ] = None,
    pulses_per_turn: Annotated[float, _limit("--pulses-per-turn", "Pulses a turn of that wheel.")] = 1.0,
    ratio: Annotated[float, _limit("--ratio", "Least ratio of the ambiguities' test, where the log tells it.")] = 3.0,
    spacing: Annotated[float, _limit("--spacing", "Distance of the two antennas against the body's [m].")] = 0.05,
    lateral: Annotated[float, _limit("--lateral", "Distance beside the antenna's path [m].")] = 1.0,
    height: Annotated[float, _limit("--height", "Distance above or below it [m].")] = 2.0,
    max_gap: Annotated[float, _limit("--max-gap", "Longest gap between good fixes that is bridged [s].")] = 60.0,
    max_sigma: Annotated[
        float, _limit("--max-sigma", "Largest standard deviation of a bridged instant that is kept [m].")
    ] = 1.0,
    date: Annotated[
        datetime | None,
        typer.Option(
            metavar="DATE", formats=["%Y-%m-%d"], rich_help_panel=CHOICES, help="UTC date of an NMEA log without RMC."
        ),
    ] = None,
    crs: CrsOption = None,
    height_datum: DatumOption = None,
    geoid: GeoidOption = None,
    lenient: LenientOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    r"""Where the antennas really were: fixed positions on the track, the gaps between them bridged.

    Positions are refused that are no fix, have a low ratio, whose two antennas are not as far apart as on the
    vehicle, that lie off the antenna's path, or that disagree with the way travelled. The others are put on the
    path. Between them Doppler speeds, pulses and acceleration, whichever are given, are weighed by their
    variances, and the closing error of each gap is shared back over it. Written into DIR:

    - `reference.csv`: one row an instant and antenna; place, speed, standard deviation, source `rtk` or `bridged`
    - `fixes.csv`: every position with its verdict and what was measured
    - `reference.json`: versions, hashes of the inputs, settings asked for and used, counts by reason, gaps

    Gaps that are too long and instants that are too uncertain are left out, counted and named. All times are
    GPS time.

    Example:

        railfix reference --rtk rtk.pos --track line.csv --vehicle car.toml \
            --front front.obs --nav brdc.nav --pulses tacho.csv --out reference

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not belong together; 7 fewer than two good fixes; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    import numpy as np

    from railfix.core.errors import SettingsError
    from railfix.reference import ReferenceInputs, ReferenceOptions, ReferenceSettings, reference_files
    from railfix.run import TrackReading

    if not pulses_per_turn > 0.0:
        raise SettingsError(f"--pulses-per-turn is {pulses_per_turn:g}; a positive number was expected")
    limits = {
        "pulse_m": None if wheel_circumference is None else wheel_circumference / pulses_per_turn,
        "ratio": ratio,
        "spacing_m": spacing,
        "lateral_m": lateral,
        "height_m": height,
        "max_gap_s": max_gap,
        "max_sigma_m": max_sigma,
    }
    usual = ReferenceSettings()
    asked = {name: value for name, value in limits.items() if value != getattr(usual, name)}
    summary = reference_files(
        ReferenceInputs(
            rtk=rtk,
            rtk_rear=rtk_rear,
            track=tuple(track),
            vehicle=vehicle,
            front=tuple(front or ()),
            rear=tuple(rear or ()),
            nav=tuple(nav or ()),
            pulses=pulses,
            acceleration=acceleration,
        ),
        ReferenceSettings(**asked),  # type: ignore[arg-type]
        out=out,
        options=ReferenceOptions(
            broken_lines="count" if lenient else "stop",
            overwrite="replace" if overwrite else "refuse",
            track=TrackReading(crs=crs, height_datum=height_datum, geoid=geoid),
            date=None if date is None else np.datetime64(date, "D"),
        ),
        asked=asked,
    )
    show_reference(summary)


def show_reference(summary: ReferenceSummary) -> None:
    """Counts by antenna, the notes, and where the results are."""
    for name, part in summary.built.items():
        source = part.reference.source
        counts = part.fixes.counts()
        good = counts.pop("good")
        refused = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count) or "none"
        typer.echo(f"{name}: {len(part.fixes):,} positions, {good:,} good fixes; refused: {refused}")
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
