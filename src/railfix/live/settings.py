"""Settings and inputs of live operation."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.pipeline.config import Config
from railfix.run.inputs import BALISE_LIST, VIRTUAL_BALISES, LogReading, TrackReading, input_option
from railfix.run.output import Overwrite


class LiveSettings(Settings):
    """Settings of live operation."""

    period_s: float = Field(default=0.1, gt=0.0, le=60.0)  #: Interval between messages (P1 2.1: 0.1 s).
    #: Longest time for which an antenna's epoch waits for the other antenna's epoch of the same time.
    pair_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    #: Longest time for which an epoch waits for samples of the on-board sensors. After this time, the epoch is
    #: processed without the missing samples.
    sensor_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    no_input: Literal["send", "skip"] = "send"  #: Whether a message is sent in a period without input.
    #: A receiver counts as restarted after this number of consecutive epochs with tags older than its last tag.
    restart_epochs: int = Field(default=3, ge=1)
    #: Whether a broken connection is opened again. With "off", a source ends when the other end closes the connection;
    #: other breaks end the session with an error. The first connection must always succeed.
    reconnect: Literal["on", "off"] = "on"

    #: Wait before the first attempt to open a broken connection again; the wait doubles with every further attempt.
    reconnect_first_s: float = Field(default=1.0, gt=0.0, le=600.0)
    #: Longest wait between two attempts to open a broken connection again.
    reconnect_longest_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    #: A connection on which no byte arrives for this time is treated as broken.
    silence_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    #: Interval at which the train's position (GGA) is sent to the base station's caster, as a virtual reference station
    #: requires; 0 means that the position is not sent.
    gga_s: float = Field(default=0.0, ge=0.0, le=3600.0)
    #: File with certificates (PEM) that are trusted for connections to casters over TLS, in addition to the system's.
    ntrip_certificates: Path | None = None
    #: Number of messages that may wait for a slow target; while so many wait, new messages are dropped and counted.
    waiting: int = Field(default=100, ge=1, le=100_000)
    #: If the delay of epochs exceeds the shortest delay so far by more than this, epochs are skipped until the excess
    #: is a quarter of this. The skipping is logged. Recorded epochs are never skipped.
    behind_s: float = Field(default=5.0, ge=0.5, le=3600.0)
    state_every_s: float = Field(default=5.0, gt=0.0, le=3600.0)  #: Interval at which the state file is written.
    #: If the first new epoch is later than this after the last epoch of a state file, only the ephemerides, SBAS
    #: messages and sequence number of the file are used.
    state_age_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    log_bytes: int = Field(default=1_000_000, ge=1000)  #: Size at which a log file is rotated [bytes].
    log_files: int = Field(default=5, ge=1, le=1000)  #: Number of rotated log files that are kept.
    train: int = Field(default=0, ge=0)  #: Identity of the train in messages.
    line: int = Field(default=0, ge=0)  #: Identity of the line in messages.
    #: Direction of the train's leading end at the start: 1 toward rising chainage, -1 toward falling, 0 if unknown. The
    #: default is taken from the vehicle file. A train that has run 50 m in the other direction is assumed to have
    #: changed ends.
    facing: Literal[-1, 0, 1] | None = None
    #: Distance from the front antenna forward to the train's front end; by default computed from the vehicle file.
    front_offset_m: float | None = Field(default=None, ge=0.0)
    length_m: float | None = Field(default=None, gt=0.0)  #: Length of the train; by default from the vehicle file.
    #: Identity of the reference location of ETCS position reports (NID_LRBG).
    reference: int = Field(default=0, ge=0, lt=1 << 24)
    reference_m: float = 0.0  #: Chainage of the reference location of ETCS position reports.


#: On-board sensors.
Sensor = Literal["tachometer", "inertial", "radar", "ranging", "balises"]
SENSORS: tuple[Sensor, ...] = ("tachometer", "inertial", "radar", "ranging", "balises")


class LiveInputs(Settings):
    """Inputs of a live session, given by the options of ``railfix live``."""

    front: str = input_option(
        "Source of the front antenna's receiver data: a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, "
        "ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT (ntrips:// over TLS), or - (standard input).",
        metavar="SOURCE",
    )
    track: tuple[Path, ...] = input_option(
        "Track map; for a route of several maps, give the option once for each map.", metavar="TRACK"
    )
    rear: str | None = input_option(
        "Source of the rear antenna's receiver data, as for --front.", None, metavar="SOURCE"
    )
    vehicle: Path | None = input_option("Vehicle file with the positions of the antennas.", None, metavar="TOML")
    nav: tuple[Path, ...] = input_option("Navigation files that are read at the start.", (), metavar="FILE")
    base: str | None = input_option(
        "Source of a base station's data: RTCM 3 (MSM, and 1005 or 1006 with the position), or a format of --front.",
        None,
        metavar="SOURCE",
    )
    base_place: str | None = option(
        "Position of the base station; by default it is read from the stream or the file's header.",
        None,
        metavar="LAT,LON,HEIGHT",
    )
    tachometer: str | None = input_option(
        "Source of a tachometer's pulses, in a form of --front. The data are the tachometer table of `railfix run`, "
        "as lines of CSV, header first, or as a whole file. A row with only a time reports that there was no pulse.",
        None,
        metavar="SOURCE",
    )
    inertial: str | None = input_option(
        "Source of an inertial unit's samples, as for --tachometer.", None, metavar="SOURCE"
    )
    radar: str | None = input_option("Source of a Doppler radar's speeds, as for --tachometer.", None, metavar="SOURCE")
    ranging: str | None = input_option(
        "Source of two-way ranges to ground units, as for --tachometer.", None, metavar="SOURCE"
    )
    ranging_units: Path | None = input_option(
        "Table of surveyed ground units: unit, x_m, y_m, z_m (ECEF).", None, metavar="CSV"
    )
    balises: str | None = input_option("Source of balise readings, as for --tachometer.", None, metavar="SOURCE")
    balise_list: Path | None = input_option(BALISE_LIST, None, metavar="CSV")
    virtual_balises: Path | None = input_option(VIRTUAL_BALISES, None, metavar="CSV")
    send: tuple[str, ...] = option(
        "Form and target of messages. FORM is json, cbor, nmea, tpv, etcs, positions, train or passings; TARGET is - "
        "(standard output), a file, udp://HOST:PORT, tcp-server://HOST:PORT or "
        "mqtt://[USER:PASSWORD@]HOST:PORT/TOPIC. Default: json@-.",
        ("json@-",),
        metavar="FORM@TARGET",
    )
    speed: float | None = option(
        "Replay speed of recorded files relative to real time; by default as fast as possible.",
        None,
        metavar="TIMES",
        ge=0.01,
    )
    channels: Literal["1", "2"] = option(
        "Number of channels; with 2, a second process computes every message, too, and any difference ends the output.",
        "1",
    )
    metrics: str | None = option("Serve metrics as Prometheus text at /metrics.", None, metavar="HOST:PORT")
    state: Path | None = option(
        "State file: written regularly, and read at the start to continue an earlier session.", None, metavar="FILE"
    )
    log: Path | None = option("Also write the log to this file, which is rotated.", None, metavar="FILE")
    out: Path | None = option("Also write the result tables into this folder.", None, metavar="DIR")
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")
    config: Config = Field(default_factory=Config)
    live: LiveSettings = Field(default_factory=LiveSettings)
    reading: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)

    @property
    def antennas(self) -> tuple[Literal["front", "rear"], ...]:
        """Names of the antennas that have a stream."""
        return ("front",) if self.rear is None else ("front", "rear")

    @property
    def sources(self) -> dict[str, str]:
        """Sources of the antennas and of the base station, by name."""
        given = {"front": self.front, "rear": self.rear, "base": self.base}
        return {name: source for name, source in given.items() if source is not None}

    @property
    def sensors(self) -> dict[Sensor, str]:
        """Sources or tables of the given on-board sensors, by name."""
        return {name: source for name in SENSORS if (source := getattr(self, name)) is not None}

    @property
    def files(self) -> dict[str, Path]:
        """Files that affect the positions, by the role of the file."""
        named = {f"track {k}": path for k, path in enumerate(self.track)}
        given = {
            "vehicle": self.vehicle, "ranging units": self.ranging_units, "balise list": self.balise_list,
            "virtual balises": self.virtual_balises, "cn0 curve": self.config.cn0_curve,
            "error model": self.config.error_model, "integrity support": self.config.integrity_support,
        }  # fmt: skip
        return named | {name: path for name, path in given.items() if path is not None}
