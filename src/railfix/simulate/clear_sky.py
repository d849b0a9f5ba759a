"""C/N0 of a clear signal at elevation el [dB-Hz]: a + b sin(el); the second signal of a satellite is weaker."""

from __future__ import annotations

from typing import Final

CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DB: Final = 16.0
CN0_SECOND_DB: Final = -3.0
