"""A base station over NTRIP beside a receiver over TCP: the whole command against a run on the logs."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from base_cases import Case, cases
from railfix.cli import app
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import GPS_EPOCH, SECONDS_PER_WEEK
from railfix.gnss.observations import Observations
from railfix.io.rinex import write_observations

pyrtklib5 = pytest.importorskip("pyrtklib5")
pytestmark = pytest.mark.requirement("A12")
RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
EPOCHS, DATE = 40, "2024-06-24"


def encoded(observations: Observations, place_m: np.ndarray) -> list[bytes]:
    """RTCM 3 of each epoch by RTKLIB's encoder: 1006 with the station's place, 1077 of GPS."""
    rtcm = pyrtklib5.rtcm_t()
    pyrtklib5.init_rtcm(rtcm)
    rtcm.staid = 7
    for axis in range(3):
        rtcm.sta.pos[axis] = float(place_m[axis])
    messages = []
    for k in range(len(observations)):
        since = (observations.time[k] - GPS_EPOCH) / np.timedelta64(1, "s")
        rtcm.time = pyrtklib5.gpst2time(int(since // SECONDS_PER_WEEK), float(since % SECONDS_PER_WEEK))
        rtcm.obs.n = 0
        for channel, satellite in enumerate(observations.satellite.tolist()):
            usable = satellite[0] == "G" and observations.signal[channel] == "1C"
            if not usable or np.isnan(observations.code_m[k, channel]):
                continue
            row = rtcm.obs.data[rtcm.obs.n]
            row.time, row.sat = rtcm.time, pyrtklib5.satid2no(satellite)
            row.code[0] = pyrtklib5.obs2code("1C")
            row.P[0], row.L[0] = float(observations.code_m[k, channel]), float(observations.phase_cycles[k, channel])
            row.D[0] = float(observations.doppler_hz[k, channel])
            row.SNR[0] = float(observations.cn0_dbhz[k, channel])
            rtcm.obs.n += 1
        parts = b""
        for number in (1006, 1077):
            assert pyrtklib5.gen_rtcm3(rtcm, number, 0, 0) == 1
            parts += bytes(rtcm.buff[i] for i in range(rtcm.nbyte))
        messages.append(parts)
    return messages


class Served:
    """A caster for the base station and a port for the train's receiver; epochs go out in turn, the base's first."""

    def __init__(self, base: list[bytes], train: list[bytes]) -> None:
        self.epochs = list(zip(base, train, strict=True))
        self.requests: list[bytes] = []
        self.base: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()

    @contextlib.contextmanager
    def ports(self) -> Iterator[list[int]]:
        """Ports of the caster and of the receiver, served by a thread, as the command has signals."""
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_forever)
        thread.start()
        try:
            servers = [
                asyncio.run_coroutine_threadsafe(asyncio.start_server(handler, "127.0.0.1", 0), loop).result()
                for handler in (self.caster, self.receiver)
            ]
            yield [server.sockets[0].getsockname()[1] for server in servers]
            for server in servers:
                loop.call_soon_threadsafe(server.close)
        finally:
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
            loop.close()

    async def caster(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.requests.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\n\r\n")
        await self.base.put(writer)

    async def receiver(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        base = await self.base.get()
        with contextlib.suppress(OSError), contextlib.closing(writer), contextlib.closing(base):
            for of_base, of_train in self.epochs:
                for target, data in ((base, of_base), (writer, of_train)):
                    target.write(data)
                    await target.drain()
                    await asyncio.sleep(0.03)


def inputs(recordings: Path, tmp_path: Path, train: slice) -> tuple[Case, dict[str, Path], list[str], list[str]]:
    """Two antennas on a roof: the case, logs of train and base station, and words of commands."""
    case = next(case for case in cases(recordings) if case.name.startswith("roof"))
    latitude, longitude, height = geodetic_from_ecef(case.trajectory.ecef_m)
    track = tmp_path / "line.csv"
    table = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    pl.DataFrame(table).write_csv(track, float_precision=10)
    config = tmp_path / "config.toml"
    config.write_text('systems = ["G"]\nfilter = "off"\nprotection = "off"\n')
    navigation = next((recordings / "dual" / "mosaic_x2_99cm").glob("*.nav"))
    common = ["--track", str(track), "--nav", str(navigation), "--config", str(config), "--date", DATE]
    logs = {name: tmp_path / f"{name}.rnx" for name in ("train", "base")}
    for name, observations in (("train", case.train[train]), ("base", case.base[:EPOCHS])):
        write_observations(observations, logs[name])
    place = ",".join(f"{float(value):.9f}" for value in geodetic_from_ecef(case.base_ecef_m))
    return case, logs, common, ["--base", str(logs["base"]), "--base-place", place]


def test_files_of_train_and_base_station_may_begin_and_end_apart(recordings: Path, tmp_path: Path) -> None:
    """Replayed without pause, they give the positions of the run."""
    _, logs, common, beside = inputs(recordings, tmp_path, slice(8, 14))
    found = {}
    for command, *more in (["run"], ["live", "--send", f"json@{tmp_path / 'sent'}", "--live", "no_input=skip"]):
        words = [command, "--front", str(logs["train"]), *common, *beside, *more]
        done = RUNNER.invoke(app, [*words, "--out", str(tmp_path / command)])
        assert done.exit_code == 0, (done.output, done.exception)
        found[command] = pl.read_parquet(tmp_path / command / "positions.parquet")["chainage_m"].to_numpy()
    assert np.isfinite(found["run"]).all()
    assert np.array_equal(found["run"], found["live"])


@pytest.mark.slow
def test_the_command_with_a_base_station_over_ntrip(recordings: Path, tmp_path: Path) -> None:
    """Two antennas on a roof: positions are those of the logs with the base station, and not those without."""
    case, logs, common, beside = inputs(recordings, tmp_path, slice(EPOCHS))
    train, base = case.train[:EPOCHS], case.base[:EPOCHS]
    served = Served(encoded(base, case.base_ecef_m), encoded(train, case.reference[0]))
    with served.ports() as (caster, receiver):
        words = ["live", "--front", f"tcp://127.0.0.1:{receiver}", "--base", f"ntrip://u:p@127.0.0.1:{caster}/ROOF"]
        options = ["--live", "reconnect=off", "--live", "no_input=skip", "--send", f"json@{tmp_path / 'sent'}"]
        done = RUNNER.invoke(app, [*words, *common, *options, "--out", str(tmp_path / "live")])
    assert done.exit_code == 0, (done.output, done.exception)
    assert served.requests[0].startswith(b"GET /ROOF HTTP/1.1\r\n")
    found = {}
    for name, more in (("beside", beside), ("alone", [])):
        out = tmp_path / name
        done = RUNNER.invoke(app, ["run", "--front", str(logs["train"]), *common, *more, "--out", str(out)])
        assert done.exit_code == 0, done.output
        found[name] = pl.read_parquet(out / "positions.parquet")
    rows = pl.read_parquet(tmp_path / "live" / "positions.parquet")
    assert len(rows) > EPOCHS / 2  # a busy computer skips to the present
    away = {
        name: (rows.join(table, on="time_gpst")).select((pl.col("chainage_m") - pl.col("chainage_m_right")).abs())
        for name, table in found.items()
    }
    assert away["beside"].to_series().max() < 0.05
    assert away["alone"].to_series().median() > 0.2
