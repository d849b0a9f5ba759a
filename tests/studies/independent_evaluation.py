"""Figures of merit worked out a second time, plainly: csv, loops and statistics, without railfix.

Run ``python tests/studies/independent_evaluation.py RUN TRUTH`` to print the figures of a run whose chainage is the
truth's.
"""

from __future__ import annotations

import csv
import gzip
import math
import statistics
import sys
from bisect import bisect_left
from itertools import pairwise
from pathlib import Path

import numpy as np

GAP_S, SIGMA_M, STANDING_MPS, SECTION_M = 2.5, 0.5, 0.3, 500.0
SPEEDS = (20.0, 60.0, 100.0)
SATELLITES = (4, 5, 6, 7, 8, 10, 12, 15, 20)
BLOCK_S, DRAWS, SEED, CONFIDENCE = 20.0, 20, 0, 0.95
NAN = math.nan
ALARM_LIMITS = (10.0, 20.0, 40.0)
BEYOND = ("misleading", "hazardously_misleading", "unavailable_misleading")
REGIONS = ("nominal", *BEYOND, "unavailable", "unjudged", "no_position")


def nanoseconds(text):
    return int(np.datetime64(text, "ns").astype(np.int64))


def number(text):
    return float(text) if text not in ("", None) else NAN


def rows_of(path):
    with gzip.open(path, "rt") if str(path).endswith(".gz") else Path(path).open() as file:
        return list(csv.DictReader(file))


def percentile(values, share):
    """Linear between the values."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = math.floor(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


def reference_at(truth, times, time):
    """Chainage, speed, sigma and environment at a time; None where the reference does not tell."""
    i = bisect_left(times, time)
    if i < len(times) and times[i] == time:
        return truth[i]
    if i in (0, len(times)) or (times[i] - times[i - 1]) / 1e9 > GAP_S:
        return None
    share = (time - times[i - 1]) / (times[i] - times[i - 1])
    a, b = truth[i - 1], truth[i]
    return (*(x + share * (y - x) for x, y in zip(a[:6], b[:6], strict=True)), a[6] if share <= 0.5 else b[6])


def epochs_of(positions, truth):
    """Every epoch of one antenna, those put in included, as dictionaries."""
    known = [
        (
            *(number(r.get(name)) for name in ("chainage_m", "speed_mps", "sigma_m", "x_m", "y_m", "z_m")),
            r.get("environment") or "unknown",
        )
        for r in truth
    ]
    clock = [nanoseconds(r["time_gpst"]) for r in truth]
    logged = {nanoseconds(r["time_gpst"]): r for r in positions}
    times = sorted(logged)
    step = statistics.median([b - a for a, b in pairwise(times)])
    whole = []
    for a, b in pairwise(times):
        whole.append(a)
        parts = round((b - a) / step) if b - a > 1.5 * step else 1
        whole += [a + int(k * (b - a) / parts) for k in range(1, parts)]
    whole.append(times[-1])
    found = []
    for time in whole:
        at, row = reference_at(known, clock, time), logged.get(time, {})
        one = {"time": time, "in": at is not None, "status": row.get("status", "not_logged")}
        one["observed"] = one["status"] not in ("not_logged", "no_observation")
        one["chainage"], one["speed"], one["sigma"], *place, one["environment"] = at or (*[NAN] * 6, "unknown")
        one["away"] = math.dist([number(row.get(name)) for name in ("x_m", "y_m", "z_m")], place)
        one["speed"] = abs(one["speed"])
        one["good"] = one["in"] and not one["sigma"] > SIGMA_M
        one["n"] = number(row.get("n_used"))
        one["along"] = number(row.get("along_sigma_m"))
        one["level"] = number(row.get("protection_level_m"))
        one["verdict"] = row.get("protection_status", "")
        answers = number(row.get("chainage_m")), number(row.get("conventional_chainage_m"))
        one["map"], one["3d"] = (answer - one["chainage"] for answer in answers)
        one["has map"], one["has 3d"] = (not math.isnan(answer) for answer in answers)
        one["block"] = math.floor((time - whole[0]) / 1e9 / BLOCK_S)
        found.append(one)
    return found


def put_distance(epochs):
    """Distance run, from the first epoch inside the reference to the last; over its gaps shared out by time."""
    total, before = 0.0, None
    for one in epochs:
        if not one["in"]:
            continue
        if before is not None:
            step = abs(one["chainage"] - before["chainage"])
            took = (one["time"] - before["time"]) / 1e9
            speed = (one["speed"] + before["speed"]) / 2
            if took > GAP_S or math.isnan(speed):
                speed = step / took
            if speed >= STANDING_MPS:
                total += step
            for between in epochs:
                if before["time"] < between["time"] < one["time"]:
                    share = (between["time"] - before["time"]) / (one["time"] - before["time"])
                    between["moved"] = before["moved"] + share * (total - before["moved"])
        one["moved"] = total
        before = one


def has(one, position, epochs_of_both):
    mapped, point = one["has map"], one["has 3d"]
    if epochs_of_both == "common" and not (mapped and point):
        return False
    if position == "conventional":
        return point
    return mapped and (position == "constrained" or one["status"] == "ok")


def limits(epochs, position):
    """Blocks drawn with replacement: limits of mean, rate, 95th percentile, and error over sigma."""
    names = sorted({one["block"] for one in epochs})
    if len(names) < 5:
        return len(names), [NAN] * 10
    errors = {name: [] for name in names}
    observed, positioned = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    for one in epochs:
        observed[one["block"]] += one["observed"]
        positioned[one["block"]] += has(one, position, "own")
        if has(one, position, "own") and one["good"]:
            error = one["3d" if position == "conventional" else "map"]
            errors[one["block"]].append((error, NAN if position == "conventional" else abs(error) / one["along"]))
    means, rates, tails, middle, wide = [], [], [], [], []
    for draw in np.random.default_rng(SEED).integers(0, len(names), (DRAWS, len(names))):
        drawn = [names[i] for i in draw]
        seen = sum(observed[name] for name in drawn)
        if seen:
            rates.append(sum(positioned[name] for name in drawn) / seen)
        values = [e for name in drawn for e, _ in errors[name]]
        ratios = sorted(r for name in drawn for _, r in errors[name] if not math.isnan(r))
        if ratios:
            middle.append(ratios[math.ceil(0.68 * len(ratios) - 1e-9) - 1])
            wide.append(ratios[math.ceil(0.95 * len(ratios) - 1e-9) - 1])
        if values:
            means.append(statistics.fmean(values))
            tails.append(sorted(abs(e) for e in values)[math.ceil(0.95 * len(values) - 1e-9) - 1])
    out = []
    for values in (means, rates, tails, middle, wide):
        for share in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2):
            out.append(percentile(values, share) if values else NAN)
    return len(names), out


def figures(epochs, position, both, *, with_limits):
    inside = [one for one in epochs if one["in"]]
    positions = [one for one in inside if has(one, position, both)]
    judged = [one for one in positions if one["good"]]
    column = "3d" if position == "conventional" else "map"
    errors = [one[column] for one in judged]
    size = [abs(e) for e in errors]
    observed = sum(one["observed"] for one in inside)
    out = {
        "epochs": len(inside),
        "observed": observed,
        "positions": len(positions),
        "left_out": len(positions) - len(judged),
        "errors": len(errors),
        "rate": len(positions) / observed if observed else NAN,
        "rate_of_run": len(positions) / len(inside),
        "wrong_places": sum(s > 50 for s in size),
    }
    if with_limits:
        blocks, told = limits(inside, position)
        out["blocks"] = blocks
        names = ["mean_low_m", "mean_high_m", "rate_low", "rate_high", "p95_low_m", "p95_high_m"]
        names += [f"normalised_p{q}_{end}" for q in (68, 95) for end in ("low", "high")]
        out |= dict(zip(names, told, strict=True))
    if not errors:
        return out
    out |= {
        "mean_m": statistics.fmean(errors),
        "std_m": statistics.pstdev(errors),
        "rms_m": math.sqrt(statistics.fmean([e * e for e in errors])),
        "max_m": max(size),
        "lowest_m": min(errors),
        "highest_m": max(errors),
    }
    out |= {f"p{q}_m": percentile(size, q / 100) for q in (50, 95, 99)}
    out |= {f"over_{limit}_m": sum(s > limit for s in size) / len(size) for limit in (5, 10, 20, 50)}
    worst = max(judged, key=lambda one: abs(one[column]))
    out |= {"max_at_time": worst["time"], "max_at_chainage_m": worst["chainage"]}
    stated = [one["sigma"] for one in judged if not math.isnan(one["sigma"])]
    out["reference_sigma_p50_m"] = statistics.median(stated) if stated else NAN
    if position != "conventional":
        ratio = [one["map"] / one["along"] for one in judged]
        out |= {
            "along_sigma_p50_m": statistics.median([one["along"] for one in judged]),
            "normalised_mean": statistics.fmean(ratio),
            "normalised_rms": math.sqrt(statistics.fmean([r * r for r in ratio])),
            "distance_max_m": max(one["away"] for one in judged),
        }
        out |= {f"normalised_p{q}": percentile([abs(r) for r in ratio], q / 100) for q in (68, 95)}
        out |= {f"distance_p{q}_m": percentile([one["away"] for one in judged], q / 100) for q in (50, 95)}
        out |= {f"over_{n}_sigma": sum(abs(r) > n for r in ratio) / len(ratio) for n in (1, 2, 3)}
    return out


def speed_class(speed):
    kmh = speed * 3.6
    if speed < STANDING_MPS:
        return "standing"
    if kmh < SPEEDS[0]:
        return f"under {SPEEDS[0]:g} km/h"
    for low, high in pairwise(SPEEDS):
        if low <= kmh < high:
            return f"{low:g} to {high:g} km/h"
    return f"over {SPEEDS[-1]:g} km/h"


def satellite_class(count):
    if math.isnan(count):
        return "unknown"
    if count < SATELLITES[0]:
        return f"under {SATELLITES[0]}"
    for low, high in pairwise(SATELLITES):
        if low <= count < high:
            return str(low) if high == low + 1 else f"{low} to {high - 1}"
    return f"{SATELLITES[-1]} and more"


def section(chainage):
    first = math.floor(chainage / SECTION_M) * SECTION_M
    return f"{first:.0f} to {first + SECTION_M:.0f} m"


GROUPINGS = {
    "all": lambda _: "all",
    "section": lambda one: section(one["chainage"]),
    "environment": lambda one: one["environment"],
    "speed": lambda one: speed_class(one["speed"]),
    "satellites": lambda one: satellite_class(one["n"]),
    "signals": lambda one: "with satellites" if one["observed"] and one["n"] > 0 else "without satellites",
    "status": lambda one: one["status"],
}
KINDS = (
    ("constrained", "own"),
    ("constrained_ok", "own"),
    ("conventional", "own"),
    ("constrained", "common"),
    ("conventional", "common"),
)


def all_figures(by_antenna):
    """(grouping, group, antenna, position, epochs) to figures."""
    found = {}
    pools = {**by_antenna, "all": [one for epochs in by_antenna.values() for one in epochs]}
    for antenna, epochs in pools.items():
        for grouping, group_of in GROUPINGS.items():
            groups = {}
            for one in epochs:
                if one["in"]:
                    groups.setdefault(group_of(one), []).append(one)
            for group, members in groups.items():
                for position, both in KINDS:
                    told = both == "own" and grouping not in ("satellites", "signals", "status")
                    found[grouping, group, antenna, position, both] = figures(members, position, both, with_limits=told)
    return found


def intervals(epochs, position):
    inside = [one for one in epochs if "moved" in one]
    fixes = [one for one in inside if has(one, position, "own")]
    pairs = list(pairwise(fixes))
    ran = [(b["moved"] - a["moved"], a) for a, b in pairs if b["moved"] - a["moved"] > 0]
    gaps = [((b["time"] - a["time"]) / 1e9, a) for a, b in pairs]
    metres = [m for m, _ in ran]
    widest = max(ran, key=lambda pair: pair[0])
    longest = max(gaps, key=lambda pair: pair[0])
    return {
        "intervals": len(ran),
        "standing": len(pairs) - len(ran),
        "interval_mean_m": statistics.fmean(metres),
        "interval_p50_m": percentile(metres, 0.5),
        "interval_p95_m": percentile(metres, 0.95),
        "interval_p99_m": percentile(metres, 0.99),
        "interval_max_m": widest[0],
        "interval_max_chainage_m": widest[1]["chainage"],
        "gap_p50_s": percentile([g for g, _ in gaps], 0.5),
        "gap_p95_s": percentile([g for g, _ in gaps], 0.95),
        "gap_max_s": longest[0],
        "gap_max_from": longest[1]["time"],
        "before_first_s": (fixes[0]["time"] - inside[0]["time"]) / 1e9,
        "after_last_s": (inside[-1]["time"] - fixes[-1]["time"]) / 1e9,
    }


def levels(epochs, position):
    inside = [one for one in epochs if one["in"]]
    fixes = [one for one in inside if has(one, position, "own")]
    finite = [one for one in fixes if math.isfinite(one["level"])]
    judged = [one for one in finite if one["good"]]
    over = sum(abs(one["map"]) > one["level"] for one in judged)
    observed = sum(one["observed"] for one in inside)
    return {
        "observed": observed,
        "positions": len(fixes),
        "infinite": sum(math.isinf(one["level"]) for one in fixes),
        "with_level": len(finite),
        "level_share": sum(one["observed"] for one in finite) / observed,
        "level_p50_m": statistics.median([one["level"] for one in finite]),
        "level_p95_m": percentile([one["level"] for one in finite], 0.95),
        "errors": len(judged),
        "over_level": over,
        "over_level_share": over / len(judged),
    }


def bound(one, levels_of):
    """What the error is held against; None without a position."""
    if not one["has map"]:
        return None
    if levels_of == "usable" and (one["status"] != "ok" or one["verdict"] == "alarm"):
        return math.inf
    return math.inf if math.isnan(one["level"]) else one["level"]


def region(one, levels_of, limit):
    level = bound(one, levels_of)
    if level is None:
        return "no_position"
    if not one["good"]:
        return "unjudged"
    error = abs(one["map"])
    if level > limit:
        return "unavailable_misleading" if error > level else "unavailable"
    if error <= level:
        return "nominal"
    return "misleading" if error <= limit else "hazardously_misleading"


def available(one, levels_of, limit):
    level = bound(one, levels_of)
    return level is not None and level <= limit


def windows(inside, fit, length_s):
    """Windows from each fit epoch that the run covers, and those that stay fit without a gap, one by one."""
    begun = kept = 0
    times = [one["time"] for one in inside]
    usual = statistics.median(b - a for a, b in pairwise(times))
    for i, start in enumerate(times):
        until = start + round(length_s * 1e9)
        if not fit[i] or until > times[-1]:
            continue
        begun += 1
        at, whole = i, True
        while whole and times[at] < until:
            whole = times[at + 1] - times[at] <= 1.5 * usual and (times[at + 1] > until or fit[at + 1])
            at += 1
        kept += whole
    return begun, kept


def stanford_counts(by_antenna):
    """(grouping, group, antenna, levels, limit) to counts of the Stanford diagram; "all" antennas are their sums."""
    found = {}
    for antenna, epochs in by_antenna.items():
        groups = {("all", "all"): [one for one in epochs if one["in"]]}
        for one in groups["all", "all"]:
            groups.setdefault(("environment", one["environment"]), []).append(one)
        for (grouping, group), inside in groups.items():
            for levels_of in ("usable", "all"):
                for limit in ALARM_LIMITS:
                    fit = [available(one, levels_of, limit) for one in inside]
                    where = [region(one, levels_of, limit) for one in inside]
                    over = [one for one, name in zip(inside, where, strict=True) if name in BEYOND]
                    out = {name: where.count(name) for name in REGIONS}
                    out |= {
                        "epochs": len(inside),
                        "observed": sum(one["observed"] for one in inside),
                        "judged": sum(one["has map"] and one["good"] for one in inside),
                        "available": sum(fit),
                        "available_observed": sum(f and one["observed"] for f, one in zip(fit, inside, strict=True)),
                        "beyond": len(over),
                        "beyond_blocks": len(
                            {(one["time"] - inside[0]["time"]) // round(BLOCK_S * 1e9) for one in over}
                        ),
                    }
                    if grouping == "all":
                        for length in (15, 60):
                            out[f"windows_{length}_s"], out[f"kept_{length}_s"] = windows(inside, fit, length)
                    found[grouping, group, antenna, levels_of, limit] = out
    for (grouping, group, _, levels_of, limit), counts in list(found.items()):
        both = found.setdefault((grouping, group, "all", levels_of, limit), {})
        for name, value in counts.items():
            both[name] = both.get(name, 0) + value
    for counts in found.values():
        shares = {
            "availability": ("available", "epochs"),
            "availability_of_observed": ("available_observed", "observed"),
            "beyond_share": ("beyond", "judged"),
            "continuity_15_s": ("kept_15_s", "windows_15_s"),
            "continuity_60_s": ("kept_60_s", "windows_60_s"),
        }
        for name, (above, below) in shares.items():
            counts[name] = counts[above] / counts[below] if counts.get(below) else NAN
        del counts["available_observed"]
    return found


def beyond(by_antenna):
    """(antenna, time) of the epochs whose error is over a finite level to error, level, and whether it was usable."""
    return {
        (antenna, one["time"]): (one["map"], one["level"], bound(one, "usable") < math.inf)
        for antenna, epochs in by_antenna.items()
        for one in epochs
        if one["in"] and one["has map"] and one["good"] and abs(one["map"]) > one["level"]
    }


def evaluated(run, truth):
    """Figures, intervals, levels, Stanford counts and epochs beyond of a run folder against a truth file."""
    positions, places = rows_of(Path(run) / "positions.csv"), rows_of(truth)
    by_antenna = {}
    for antenna in dict.fromkeys(row["antenna"] for row in positions):
        epochs = epochs_of(
            [row for row in positions if row["antenna"] == antenna],
            [row for row in places if row["antenna"] == antenna],
        )
        put_distance(epochs)
        by_antenna[antenna] = epochs
    kinds = ("constrained", "constrained_ok", "conventional")
    return (
        all_figures(by_antenna),
        {(a, p): intervals(epochs, p) for a, epochs in by_antenna.items() for p in kinds},
        {(a, p): levels(epochs, p) for a, epochs in by_antenna.items() for p in kinds[:2]},
        stanford_counts(by_antenna),
        beyond(by_antenna),
    )


if __name__ == "__main__":
    for part in evaluated(*sys.argv[1:]):
        for key, values in part.items():
            print(*key)
            print("   ", *(f"{name}={value}" for name, value in values.items()))
