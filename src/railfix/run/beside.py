"""Results on the route through a network, where the log may have run on another track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from railfix.core.reasons import Status
from railfix.pipeline.along_track import doubted
from railfix.pipeline.config import Config
from railfix.pipeline.level_stage import judged
from railfix.pipeline.results import Result
from railfix.run.route import RouteOfLog
from railfix.tracking.result import TrackStatus, is_bounded


def without_beside(result: Result, route: RouteOfLog, config: Config) -> Result:
    """Results whose statuses and levels know where another track is more probable than `Config.track_risk`."""
    antennas, fusion = dict(result.antennas), dict(result.fusion)
    for name, single in antennas.items():
        beside = route.is_uncertain(single.time, risk=config.track_risk)
        status = np.where(beside & (single.status == Status.OK), np.int8(Status.MAP_OFFSET), single.status)
        protection = single.protection
        if protection is not None:
            has = np.isfinite(single.chainage_m)
            level = replace(protection.level, level_m=np.where(beside & has, np.inf, protection.level.level_m))
            protection = judged(replace(protection, level=level), status, has, single.chainage_m, config)
        antennas[name] = replace(single, status=status, protection=protection)
    for name, filtered in fusion.items():
        tracked = filtered.tracked
        beside = route.is_uncertain(tracked.time, risk=config.track_risk) & is_bounded(tracked.status)
        fusion[name] = replace(filtered, tracked=doubted(tracked, beside, TrackStatus.MAP_OFFSET))
    return replace(result, antennas=antennas, fusion=fusion)
