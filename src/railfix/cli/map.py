"""``railfix map``: check and make track maps, and work with networks of tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from railfix.cli.command import Command, command_group
from railfix.cli.console import MOST_FINDINGS, TableConsole, show_notes, show_table
from railfix.cli.map_network import RUN_ALONE, MapReading, match_command, network, route
from railfix.cli.map_runs import service, survey
from railfix.cli.options import OverwriteOption, Without, check_outputs, from_models
from railfix.core.errors import MapQualityError, OutputError, SettingsError
from railfix.core.notebook import plural
from railfix.core.tables import plain_table
from railfix.io.positions import read_positions
from railfix.run.inputs import ColumnNames, TrackReading
from railfix.track import (
    MapLimits,
    Thinned,
    Track,
    TrackQuality,
    check_track,
    from_position_log,
    read_track,
    write_track_csv,
)
from railfix.track.quality import error_note, needed_spacing_m

app = command_group(
    "map", help="Check track maps, make them from runs or from a network, and match positions to a network of tracks."
)

TracksArgument = Annotated[
    list[Path],
    typer.Argument(metavar="TRACK...", help="CSV or GeoJSON track maps, joined in this order into one route."),
]

#: Options for reading a map in commands that need neither the frame nor the accuracy of the map.
PointsReading = Annotated[
    TrackReading, Without(*RUN_ALONE, "map_epoch", "plate", "jgd_parameters", "height_sigma", "plan_sigma")
]


@app.command("check", cls=Command)
@from_models
def check(
    tracks: TracksArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the plot map_check.png; it is created if it does not exist."),
    ] = None,
    reading: MapReading,
    max_gap: Annotated[
        float, typer.Option(metavar="M", help="Gaps between the ends of two segments are bridged up to this length.")
    ] = 1.0,
    mid_chord: Annotated[
        float, typer.Option(metavar="M", help="A larger mid-chord deviation from the arc is a fault.")
    ] = 0.30,
    overwrite: OverwriteOption = False,
) -> None:
    """Check a track map and print its faults.

    The command checks the spacing of points, duplicate points, kinks, jumps and reversals of the kilometrage,
    gradients, height spikes and cant. The mid-chord deviation from the arc is computed with `radius_m` where it is
    given, otherwise with the circle through neighbouring points. Curve attributes are compared with the geometry.

    Example: `railfix map check line.csv --out report`

    Exit codes are listed in `railfix --help`; the code is 6 if the track map has errors.
    """
    if not mid_chord > 0.0 or not max_gap > 0.0:
        raise SettingsError("--mid-chord and --max-gap must be positive")
    picture = None if out is None else out / "map_check.png"
    if picture is not None and picture.parent.exists():
        check_outputs((picture, "any"), overwrite=overwrite, inputs=tracks)
    track = read_track(
        list(tracks),
        crs=reading.crs,
        height_datum=reading.height_datum,
        geoid=reading.geoid,
        sigma_plan_m=reading.plan_sigma,
        max_gap_m=max_gap,
        duplicates="keep",
    )
    quality = check_track(track, limits=MapLimits(mid_chord_m=mid_chord))
    if picture is not None:
        from railfix.report.plots.network import plot_track_quality

        try:
            picture.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{picture.parent}: the folder cannot be created ({error.strerror})") from None
        plot_track_quality(quality, picture)
    _print_quality(quality, picture)
    if quality.errors:
        raise MapQualityError(
            f"{track.name}: the track map has {plural(quality.errors, 'error')}; first: {quality.errors[0].sentence}"
        )


@app.command("features", cls=Command)
@from_models
def features(
    tracks: TracksArgument,
    *,
    run: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Folder that `railfix run` wrote with --tachometer and --inertial; the features that the train "
            "measured are listed next to the features of the map. May be repeated.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="CSV", help="File for the features; by default they are only printed.")
    ] = None,
    reading: PointsReading,
    overwrite: OverwriteOption = False,
) -> None:
    """List the features of a line, which are the positions at which the gradient or the curvature changes.

    A train can determine its position by measuring such a change (`railfix.motion.features`). Changes are computed over
    15 m, which is about the distance between two bogies. With `--run`, the features are the changes that several runs
    measured consistently. For each feature, the table then states the number of runs that measured it, the standard
    deviation of the measured positions (as in table 1 of paper P2), and the distance from the same feature in the map.

    Example:

        railfix map features line.csv --out features.csv

        railfix map features line.csv --run results-1 --run results-2

    Exit codes are listed in `railfix --help`; the code is also 3 if a run has no measurements.
    """
    import polars as pl

    from railfix.motion.features import line_series, map_features
    from railfix.run.locate import centre_features, find_features, read_measured
    from railfix.track.curves import curved_line

    tables = [folder / "train.parquet" for folder in run or ()]
    check_outputs((out, "csv"), overwrite=overwrite, inputs=[*tracks, *tables])
    track = read_track(list(tracks), crs=reading.crs, height_datum=reading.height_datum, geoid=reading.geoid)
    trajectory = curved_line(track)
    series = line_series(trajectory)
    found = map_features(series)
    if run:
        found = centre_features(found, series)
    at = trajectory.chainage_at(np.array([feature.arc_m for feature in found]))
    found = [replace(feature, arc_m=float(chainage)) for feature, chainage in zip(found, at, strict=True)]
    beside: dict[str, list[float]] = {}
    if run:
        measured = find_features([read_measured(folder) for folder in run], found)
        found = [each.feature for each in measured]
        beside = {
            "runs": [float(len(each.places_m)) for each in measured],
            "spread_m": [float(np.std(each.places_m)) if len(each.places_m) else np.nan for each in measured],
            "map_chainage_m": [each.map_m for each in measured],
        }
    rows = pl.DataFrame(
        {
            "chainage_m": np.array([feature.arc_m for feature in found]).round(2),
            "quantity": pl.Series([feature.quantity for feature in found], dtype=pl.String),
            "change": np.array([feature.change for feature in found], dtype=np.float64),
            **{name: np.round(np.array(values, dtype=np.float64), 2) for name, values in beside.items()},
        }
    ).with_columns(pl.col(pl.Float64).fill_nan(None))
    if out is not None:
        rows.write_csv(out)
    columns = ["chainage m", "quantity", "change", *(["runs", "spread m", "from the map m"] if run else [])]
    shown = []
    for chainage, quantity, change, *others in rows.iter_rows():
        unit = f"{1e3 * change:+.1f} permille" if quantity == "gradient" else f"{1e3 * change:+.2f} / km"
        if others:
            runs, spread, there = others
            gap = "not in the map" if there is None else f"{chainage - there:+.1f}"
            others = [f"{runs:.0f} of {len(run or ())}", "" if spread is None else f"{spread:.2f}", gap]
        shown.append([f"{chainage:.1f}", quantity, unit, *others])
    caption = f"{track.name}: {len(found)} features"
    show_table(TableConsole(), plain_table(columns, shown, caption, texts=len(columns), boxed=True), most=MOST_FINDINGS)


@app.command("from-positions", cls=Command)
@from_models
def from_positions_command(
    positions: Annotated[
        Path,
        typer.Argument(
            metavar="POSITIONS", help="RTKLIB `.pos`, NMEA, GPX, NovAtel ASCII (`.asc`), or CSV with named columns."
        ),
    ],
    *,
    out: Annotated[Path, typer.Option(metavar="TRACK.csv", help="Track map to write.")],
    spacing: Annotated[float, typer.Option(metavar="M", help="Distance between the points of the map.")] = 5.0,
    quality: Annotated[
        str | None,
        typer.Option(
            metavar="Q,Q...",
            help="Accepted quality numbers (RTKLIB: 1 fix, 2 float, 5 single); by default 1 (all if none is logged).",
        ),
    ] = None,
    max_sigma: Annotated[
        float | None, typer.Option(metavar="M", help="Positions with a larger sigma on any axis are omitted.")
    ] = None,
    columns: ColumnNames,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the track; by default the name of the file.")
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a track map from the positions of one run.

    Positions without an accepted quality number and positions at standstill are omitted. The other positions are
    thinned to the spacing; the chord between two points deviates by at most 0.30 m from the omitted positions. The map
    is the path of the antenna: use it without a vehicle file. A run over several laps yields a map with several laps.

    Example: `railfix map from-positions rtk.pos --out line.csv --quality 1`

    Exit codes are listed in `railfix --help`; the code is also 3 if the positions form no line.
    """
    if not spacing > 0.0 or (max_sigma is not None and not max_sigma > 0.0):
        raise SettingsError("--spacing and --max-sigma must be positive")
    check_outputs((out, "csv"), overwrite=overwrite, inputs=[positions])
    log = read_positions(positions, **columns.arguments)
    track, thinned = from_position_log(
        log, spacing_m=spacing, quality=_qualities(quality), max_sigma_m=max_sigma, name=name or positions.stem
    )
    write_track_csv(track, out)
    show_notes(TableConsole(), log.notes)
    _print_thinned(track, thinned, len(log), out)


app.command("survey", cls=Command)(survey)
app.command("service", cls=Command)(service)
app.command("network", cls=Command)(network)
app.command("route", cls=Command)(route)
app.command("match", cls=Command)(match_command)


def _qualities(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise SettingsError(
            f"--quality {text!r}: expected whole numbers separated by commas, for example 1,2"
        ) from None


def _print_quality(quality: TrackQuality, picture: Path | None) -> None:
    console, track, geometry = TableConsole(), quality.track, quality.geometry
    spacing = geometry.spacing_m
    console.print(
        f"{track.name}: {len(track)} points, {track.chainage_m[-1]:,.1f} m, {plural(track.sections, 'section')}; "
        f"heights {track.provenance.height_datum_used}"
        + (f" + geoid {track.provenance.geoid}" if track.provenance.geoid else "")
    )
    deviation = np.abs(geometry.mid_chord_m[np.isfinite(geometry.mid_chord_m)])
    console.print(
        f"spacing {spacing.min():.2f} / {np.median(spacing):.2f} / {spacing.max():.2f} m (least, median, largest); "
        + (f"mid-chord deviation up to {deviation.max():.3f} m" if len(deviation) else "no mid-chord deviation")
    )
    needed = needed_spacing_m(quality)
    if needed < spacing.max():
        console.print(
            f"with points every {needed:.1f} m, the chords of the sharpest curve would be within 1 cm of the arc; the "
            "points are less dense, but railfix follows the arc between them"
        )
    show_notes(console, track.provenance.notes)
    rows = []
    for finding in quality.findings:
        marking = "" if finding.kilometrage_m != finding.kilometrage_m else f"{finding.kilometrage_m:.0f}"
        points = f"{finding.first}-{finding.last}" if finding.last > finding.first else f"{finding.first}"
        rows.append([finding.severity, finding.kind, points, marking, finding.sentence])
    head = ["severity", "kind", "points", "kilometrage", "finding"]
    show_table(console, plain_table(head, rows, texts=5), most=MOST_FINDINGS)
    console.print(f"{plural(quality.errors, 'error')}, {plural(quality.warnings, 'warning')}")
    if picture is not None:
        console.print(f"picture: {picture}")


def _print_thinned(track: Track, thinned: Thinned, rows: int, out: Path) -> None:
    console = TableConsole()
    console.print(f"{rows} positions, {len(track)} points kept, {track.chainage_m[-1]:,.1f} m")
    show_notes(console, track.provenance.notes)
    quality = check_track(track)
    if quality.errors:
        show_notes(console, error_note(quality))
        console.print(
            "a larger --spacing smooths noisy positions; on a road, curves may be sharper than the checks allow"
        )
    else:
        console.print(f"map check: 0 errors, {plural(quality.warnings, 'warning')}")
    if dropped := ", ".join(f"{count} {reason}" for reason, count in thinned.dropped.items() if count):
        console.print(f"dropped: {dropped}")
    for point, distance in zip(thinned.jumps[:MOST_FINDINGS], thinned.jump_m[:MOST_FINDINGS], strict=True):
        console.print(
            f"gap of {distance:.1f} m at chainage {track.chainage_m[point]:.1f} m, bridged by a straight line"
        )
    for point in thinned.turns[:MOST_FINDINGS]:
        console.print(f"the path turns back at chainage {track.chainage_m[point]:.1f} m")
    console.print(f"track map: {out}")
