"""Inputs of a live session: each an option of ``railfix live``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from railfix.core.settings import Settings, option
from railfix.live.settings import LiveSettings
from railfix.pipeline.config import Config
from railfix.run.inputs import balise_list_option, input_option, virtual_balises_option
from railfix.run.options import LogReading, TrackReading
from railfix.run.output import Overwrite

#: Sensors on board.
Sensor = Literal["tachometer", "inertial", "radar", "ranging", "balises"]
SENSORS: tuple[Sensor, ...] = ("tachometer", "inertial", "radar", "ranging", "balises")


class LiveInputs(Settings):
    """Inputs of a live session; see ``railfix live --help``."""

    front: str = input_option(
        "Stream of the front antenna's receiver: a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, "
        "ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT (ntrips:// over TLS), or - (standard input).",
        metavar="SOURCE",
    )
    track: tuple[Path, ...] = input_option("Track map; repeat it for a route.", metavar="TRACK")
    rear: str | None = input_option("The same of the rear antenna.", None, metavar="SOURCE")
    vehicle: Path | None = input_option("Vehicle of the antennas.", None, metavar="TOML")
    nav: tuple[Path, ...] = input_option("Navigation files known from the start.", (), metavar="FILE")
    base: str | None = input_option(
        "Stream of a base station: RTCM 3 (MSM, and 1005 or 1006 with its position) or as of --front.",
        None,
        metavar="SOURCE",
    )
    base_place: str | None = option(
        "Position of the base station; from its stream or header without it.", None, metavar="LAT,LON,HEIGHT"
    )
    tachometer: str | None = input_option(
        "Pulses of a tachometer: the rows of the table of `railfix run` as lines of CSV, header first, from a "
        "source as of --front; or the whole table, a file. A row with the time alone says that no pulse came.",
        None,
        metavar="SOURCE",
    )
    inertial: str | None = input_option("The same of an inertial unit.", None, metavar="SOURCE")
    radar: str | None = input_option("The same of the speeds of a Doppler radar.", None, metavar="SOURCE")
    ranging: str | None = input_option("The same of two-way ranges to ground units.", None, metavar="SOURCE")
    ranging_units: Path | None = input_option("Surveyed ground units: unit, x_m, y_m, z_m (ECEF).", None, metavar="CSV")
    balises: str | None = input_option("The same of balises that are read.", None, metavar="SOURCE")
    balise_list: Path | None = balise_list_option()
    virtual_balises: Path | None = virtual_balises_option()
    send: tuple[str, ...] = option(
        "Where messages go: json, cbor, nmea, tpv, etcs, positions, train or passings at -, a file, udp://HOST:PORT, "
        "tcp-server://HOST:PORT or mqtt://[USER:PASSWORD@]HOST:PORT/TOPIC. Default: json@-.",
        ("json@-",),
        metavar="FORM@TARGET",
    )
    speed: float | None = option(
        "Replay files this many times as fast as recorded; else without pause.", None, metavar="TIMES", ge=0.01
    )
    channels: Literal["1", "2"] = option("2: a second process checks every message; a difference ends the output.", "1")
    metrics: str | None = option("Serve Prometheus text at /metrics.", None, metavar="HOST:PORT")
    state: Path | None = option(
        "Write what a restarted session needs into this file now and then, and continue from it.", None, metavar="FILE"
    )
    log: Path | None = option("Also log into this file, which rotates.", None, metavar="FILE")
    out: Path | None = option("Also write the tables of results into this folder.", None, metavar="DIR")
    overwrite: Overwrite = option("Replace results that are already there.", "refuse", name="--overwrite")
    config: Config = Field(default_factory=Config)
    live: LiveSettings = Field(default_factory=LiveSettings)
    reading: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)

    @property
    def antennas(self) -> tuple[Literal["front", "rear"], ...]:
        """Antennas with a stream."""
        return ("front",) if self.rear is None else ("front", "rear")

    @property
    def sources(self) -> dict[str, str]:
        """Streams by antenna, and of the base station."""
        given = {"front": self.front, "rear": self.rear, "base": self.base}
        return {name: source for name, source in given.items() if source is not None}

    @property
    def sensors(self) -> dict[Sensor, str]:
        """Streams or tables of the sensors on board that are given."""
        return {name: source for name in SENSORS if (source := getattr(self, name)) is not None}

    @property
    def files(self) -> dict[str, Path]:
        """Files that the positions depend on, by their role."""
        named = {f"track {k}": path for k, path in enumerate(self.track)}
        given = {
            "vehicle": self.vehicle, "ranging units": self.ranging_units, "balise list": self.balise_list,
            "virtual balises": self.virtual_balises, "cn0 curve": self.config.cn0_curve,
            "error model": self.config.error_model, "integrity support": self.config.integrity_support,
        }  # fmt: skip
        return named | {name: path for name, path in given.items() if path is not None}
