"""RTKLIB's single point (`rnx2rtkp`, Debian package rtklib) on the observations of a simulated run.

With the mask and the floor of the conventional positions beside it, broadcast models, and RTKLIB's own checks of each
position: chi-square test of the residuals, dilution of precision. One of P1's authors wrote RTKLIB; that
P1's conventional positions are RTKLIB's is an inference.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.evaluate.benchmark import rows_at_epochs
from railfix.gnss.observations import Observations
from railfix.io.positions import read_positions
from railfix.io.rinex import write_navigation, write_observations
from railfix.simulate import Simulation

#: Path of the program; None where it is not installed.
PROGRAM: Final = shutil.which("rnx2rtkp")
ABSENT: Final = "RTKLIB: no row, as rnx2rtkp (Debian package rtklib) is not installed"
#: RTKLIB's bits of the constellations.
_SYSTEMS: Final = {"G": 1, "E": 8, "J": 16, "C": 32}
_MODELS: Final = {False: ("brdc", "saas", "brdc"), True: ("sbas", "sbas", "brdc+sbas")}


def single_points(
    simulation: Simulation,
    parts: Sequence[Observations],
    systems: str,
    messages: Path | None,
    *,
    mask_deg: float = 20.0,
    floor_dbhz: float = 30.0,
) -> Floats:
    """Return the positions of one antenna at its epochs, NaN where there is none, shape (T, 3) [m].

    Parameters
    ----------
    simulation : Simulation
    parts : sequence of Observations
        Of the antenna, one after the other.
    systems : str
        Letters of the constellations.
    messages : path or None
        SBAS messages that correct the ranges.
    mask_deg, floor_dbhz : float [deg], [dB-Hz]
        Least elevation and C/N0.
    """
    assert PROGRAM is not None, ABSENT
    time = np.concatenate([part.time for part in parts])
    ionosphere, troposphere, ephemeris = _MODELS[messages is not None]
    floors = ",".join([f"{floor_dbhz:g}"] * 9)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_observations(parts, folder / "run.obs")
        write_navigation(simulation.navigation, folder / "run.nav")
        (folder / "run.conf").write_text(
            f"pos1-posmode=single\npos1-frequency=l1\npos1-elmask={mask_deg:g}\npos1-snrmask_r=on\n"
            f"pos1-snrmask_L1={floors}\npos1-ionoopt={ionosphere}\npos1-tropopt={troposphere}\n"
            f"pos1-sateph={ephemeris}\npos1-navsys={sum(_SYSTEMS[s] for s in systems)}\n"
            "out-solformat=xyz\nout-timesys=gpst\nout-timeform=hms\nout-timendec=6\n"
        )
        out = folder / "run.pos"
        files = [folder / "run.obs", folder / "run.nav", *([messages] if messages else [])]
        command = [PROGRAM, "-k", folder / "run.conf", "-o", out, *files]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        theirs = read_positions(out)
    row = rows_at_epochs(time, theirs.time)
    return np.where((row >= 0)[:, None], theirs.ecef_m[row], np.nan)
