"""Reader of IFC 4.3 alignments; plan, profile and cant become elements of `railfix.track.elements`."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, read_text
from railfix.track.crs import LARGEST_SCALE, choose_crs
from railfix.track.elements import (
    CantElement,
    Design,
    Plan,
    PlanElement,
    ProfileElement,
    plan_starts,
    segment_of_design,
)
from railfix.track.route import MapReading, Segment
from railfix.track.transitions import cubic_of_length

_LAWS: Final = {
    "LINE": "linear",
    "CIRCULARARC": "linear",
    "CLOTHOID": "linear",
    "BLOSSCURVE": "bloss",
    "COSINECURVE": "cosine",
    "SINECURVE": "sine",
    "HELMERTCURVE": "helmert",
    "VIENNESEBEND": "viennese",
    "CUBIC": "cubic",
    "CONSTANTCANT": "linear",
    "LINEARTRANSITION": "linear",
}
_ARCS: Final = {
    "CONSTANTGRADIENT": "parabola", "PARABOLICARC": "parabola", "CIRCULARARC": "circle", "CLOTHOID": "clothoid",
}  # fmt: skip
#: Another form of the cubic parabola is used if it reduces the gap to the next element by more than this value [m].
_SIMILAR_M: Final = 1e-3
_TOKEN: Final = re.compile(r"'(?:[^']|'')*'|#\d+|\.[A-Z0-9_]+\.|[A-Z][A-Z0-9_]*|[-+]?\d[\d.]*(?:E[-+]?\d+)?|[(),$*]")
_PREFIX: Final = {"None": 1.0, "MILLI": 1e-3, "CENTI": 1e-2, "DECI": 0.1, "DECA": 10.0, "HECTO": 100.0, "KILO": 1e3}


@dataclass(frozen=True)
class _Entity:
    kind: str
    values: list[Any]


@dataclass(frozen=True)
class _Placement:
    """Origin and direction of coordinate axes, in the coordinates of the project."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    turn_rad: float = 0.0

    def then(self, x: float, y: float, z: float, turn: float) -> _Placement:
        """Return the placement of axes whose position and direction are relative to this placement."""
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return _Placement(
            float(self.x_m + cosine * x - sine * y),
            float(self.y_m + sine * x + cosine * y),
            self.z_m + z,
            self.turn_rad + turn,
        )


class _Step:
    """Entities of a STEP physical file (ISO 10303-21), by number."""

    def __init__(self, path: FilePath) -> None:
        self.path = str(path)
        text = read_text(path)
        if "ISO-10303-21" not in text[:200] or "DATA;" not in text:
            raise InputFileError(path, "this is not an IFC file in STEP form (ISO 10303-21)")
        body = re.sub(r"/\*.*?\*/", "", text.split("DATA;", 1)[1], flags=re.S)
        pattern = re.compile(r"#(\d+)\s*=\s*([A-Z0-9_]+)\s*(\((?:[^';]|'(?:[^']|'')*')*\))\s*;")
        self.entities = {int(m[1]): _Entity(m[2], _values(m[3])) for m in pattern.finditer(body)}

    def of_kind(self, kind: str) -> list[tuple[int, _Entity]]:
        return [(number, entity) for number, entity in self.entities.items() if entity.kind == kind]

    def at(self, reference: Any, *, what: str) -> _Entity:
        if isinstance(reference, str) and reference.startswith("#") and int(reference[1:]) in self.entities:
            return self.entities[int(reference[1:])]
        raise InputFileError(self.path, f"{what} refers to {reference}, which is not in the file")


def _values(text: str) -> list[Any]:
    stack: list[list[Any]] = [[]]
    for token in _TOKEN.findall(text):
        if token == "(":
            stack.append([])
        elif token == ")":
            inner = stack.pop()
            stack[-1].append(inner)
        elif token in ("$", "*"):
            stack[-1].append(None)
        elif token[0] == "'":
            stack[-1].append(token[1:-1].replace("''", "'"))
        elif token[0] in "+-0123456789":
            stack[-1].append(float(token))
        elif token != ",":
            stack[-1].append(token)
    return list(stack[0][0])


def read_ifc_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the alignments of an IFC file as segments.

    Heights refer to the middle between the rail tops (IfcSegmentedReferenceCurve). Raise InputFileError if there is no
    alignment with a horizontal layout, or an element is not valid or not supported.
    """
    step = _Step(path)
    nested = {entity.values[4]: entity.values[5] for _, entity in step.of_kind("IFCRELNESTS")}
    scale, angle = _units(step)
    segments: list[Segment] = []
    for number, alignment in step.of_kind("IFCALIGNMENT"):
        layouts = {step.at(r, what=f"#{number}").kind: r for r in nested.get(f"#{number}", [])}
        if "IFCALIGNMENTHORIZONTAL" not in layouts:
            continue
        elements: dict[str, list[_Entity]] = {}
        for kind, reference in layouts.items():
            parts = [step.at(r, what=kind) for r in nested.get(reference, [])]
            elements[kind] = [step.at(p.values[7] if len(p.values) > 7 else None, what=p.kind) for p in parts]
        name = alignment.values[2] or f"alignment {len(segments) + 1}"
        try:
            plan = [_plan(step, e, scale, angle) for e in elements["IFCALIGNMENTHORIZONTAL"]]
            heights = [e.values[7] for e in elements["IFCALIGNMENTHORIZONTAL"]]
            profile = _with_bends([_profile(step, e, scale) for e in elements.get("IFCALIGNMENTVERTICAL", [])])
            cant = [_cant(step, e, scale) for e in elements.get("IFCALIGNMENTCANT", [])]
            if cant:
                gauge = step.at(layouts["IFCALIGNMENTCANT"], what="IFCALIGNMENTCANT").values[-1] * scale
                plan = _leaning(plan, [(height or 0.0) * scale / gauge for height in heights], cant)
        except (TypeError, IndexError, ValueError):
            raise InputFileError(
                path, f"alignment {name!r}: a number that IFC 4.3 requires in a segment is missing or invalid"
            ) from None
        uneven = sum(_is_uneven(e) for e in elements.get("IFCALIGNMENTCANT", []))
        notes: tuple[str, ...] = ()
        if uneven:
            notes = (f"{uneven} segments of constant cant have two values and are read as linear transitions",)
        vertical = [entity.values for entity in elements.get("IFCALIGNMENTVERTICAL", [])]
        graded = sum(v[-1] == ".CONSTANTGRADIENT." and v[5] != v[6] for v in vertical)
        if graded:
            notes += (f"{graded} segments of constant gradient have two values, of which the first is used",)
        xy, system = _map_conversion(step, scale)
        placement = _place(step, alignment, step.at(layouts["IFCALIGNMENTHORIZONTAL"], what="a layout"), scale)
        moved, profile = _move(_with_cubics(plan, path=str(path), name=str(name)), profile, placement)
        segments.append(
            segment_of_design(
                path=str(path),
                name=str(name),
                design=Design(
                    plan=[p for p in moved if p.length_m > 0.0],
                    profile=[p for p in profile if p.length_m > 0.0],
                    cant=[c for c in cant if c.length_m > 0.0],
                ),
                reading=replace(reading, crs=choose_crs(path, reading.crs, system)),
                grid=xy,
                notes=notes,
            )
        )
    if not segments:
        raise InputFileError(path, "there is no IfcAlignment with a horizontal layout")
    return segments


def _units(step: _Step) -> tuple[float, float]:
    """Return the units of length [m] and of angle [rad] of the file."""
    length = angle = 1.0
    assigned = {r for _, e in step.of_kind("IFCUNITASSIGNMENT") for r in e.values[0]}
    for number, entity in step.entities.items():
        if f"#{number}" not in assigned:
            continue
        if entity.kind == "IFCSIUNIT" and entity.values[1] == ".LENGTHUNIT.":
            length = _PREFIX[str(entity.values[2]).strip(".")]
        elif entity.kind == "IFCCONVERSIONBASEDUNIT":
            factor = step.at(entity.values[3], what="a unit").values[0]
            value = next((v for v in (factor if isinstance(factor, list) else [factor]) if isinstance(v, float)), None)
            if value is None:
                flat = [v for v in step.at(entity.values[3], what="a unit").values if isinstance(v, list)]
                value = flat[0][0]
            if entity.values[1] == ".LENGTHUNIT.":
                length = value
            elif entity.values[1] == ".PLANEANGLEUNIT.":
                angle = value
    return length, angle


def _map_conversion(
    step: _Step, unit: float
) -> tuple[tuple[float, float, float, float, float, float] | None, str | None]:
    """Return easting, northing, height [m], cosine, sine and scale of the IfcMapConversion, and the name of its CRS.

    Without IfcMapConversion, numbers and name are None. Raise InputFileError if the scale does not match the units.
    """
    found = step.of_kind("IFCMAPCONVERSION")
    if not found:
        return None, None
    values = found[0][1].values
    system = step.at(values[1], what="IfcMapConversion").values[0]
    east, north, up = (float(v) for v in values[2:5])
    a, b = (1.0 if values[5] is None else values[5]), (0.0 if values[6] is None else values[6])
    scale = values[7] if len(values) > 7 and values[7] is not None else 1.0
    if abs(scale / unit - 1.0) < LARGEST_SCALE:
        scale /= unit
    elif not abs(scale - 1.0) < LARGEST_SCALE:
        raise InputFileError(
            step.path, f"the scale {scale:g} of IfcMapConversion does not match its units ({unit:g} m)"
        )
    norm = float(np.hypot(a, b))
    return (east, north, up, a / norm, b / norm, float(scale)), str(system)


def _place(step: _Step, alignment: _Entity, layout: _Entity, scale: float) -> _Placement:
    """Return the placement of an alignment, or of its horizontal layout if that is placed relative to the alignment."""
    own, relative = alignment.values[5], layout.values[5]
    if relative is not None and own is not None and own in _chain(step, relative):
        own = relative
    at = _Placement()
    for reference in reversed(_chain(step, own or relative)):
        axes = step.at(step.at(reference, what="ObjectPlacement").values[1], what="a placement")
        x, y, z = [*step.at(axes.values[0], what="a placement").values[0], 0.0][:3]
        directions = [None if r is None else step.at(r, what="a placement").values[0] for r in axes.values[1:3]]
        if axes.kind == "IFCAXIS2PLACEMENT2D":
            directions = [None, directions[0]]
        axis, towards = directions
        if axis is not None and not np.allclose(axis[:2], 0.0, atol=1e-9):
            raise InputFileError(
                step.path, "an alignment is placed on axes that are not vertical, which is not supported"
            )
        turn = 0.0 if towards is None else float(np.arctan2(towards[1], towards[0]))
        at = at.then(x * scale, y * scale, z * scale, turn)
    return at


def _chain(step: _Step, reference: Any) -> list[Any]:
    """Return the references of successive placements, from an object to the project.

    Raise InputFileError if a placement is not local.
    """
    found: list[Any] = []
    while reference is not None and reference not in found:
        entity = step.at(reference, what="ObjectPlacement")
        if entity.kind != "IFCLOCALPLACEMENT":
            raise InputFileError(
                step.path, f"an alignment is placed by {entity.kind}; only IfcLocalPlacement is supported"
            )
        found.append(reference)
        reference = entity.values[0]
    return found


def _with_cubics(plan: list[PlanElement], *, path: str, name: str) -> list[Plan]:
    """Return the elements, with cubic parabolas converted to offsets from the tangent.

    By default a parabola has the form of IFC 4.3 (``y = x^3 / (6 R L)``). The form with the length on the tangent, or
    the form with the Japanese correction, is used if the parabola then ends nearer to the start of the next element.
    """
    result: list[Plan] = []
    for element, after in zip(plan, [*plan[1:], None], strict=True):
        if element.law != "cubic" or element.length_m <= 0.0:
            result.append(element)
            continue
        if (element.first == 0.0) == (element.last == 0.0):
            raise InputFileError(path, f"alignment {name!r}: a cubic transition between two curves is not supported")
        own = {key: getattr(element, key) for key in ("x_m", "y_m", "direction_rad", "first", "last", "length_m")}
        forms = [cubic_of_length(**own, variant=variant) for variant in ("length", "tangent", "corrected")]
        gaps = [0.0] * len(forms)
        if after is not None:
            ends = [form.place_at(np.array([form.length_m]))[0] for form in forms]
            gaps = [float(np.hypot(*(end - (after.x_m, after.y_m)))) for end in ends]
        best = int(np.argmin(gaps))
        result.append(forms[best] if gaps[best] < gaps[0] - _SIMILAR_M else forms[0])
    return result


def _with_bends(profile: list[ProfileElement]) -> list[ProfileElement]:
    """Return the elements of a profile, with the start curvature of clothoids taken from the previous element's end."""
    result: list[ProfileElement] = []
    bend = 0.0
    for element in profile:
        turn = np.arctan(element.last) - np.arctan(element.first)
        if element.arc == "clothoid":
            result.append(replace(element, bend=bend))
            bend = 2.0 * turn / element.length_m - bend
        else:
            result.append(element)
            bend = turn / element.length_m if element.length_m > 0.0 else bend
    return result


def _move(plan: list[Plan], profile: list[ProfileElement], at: _Placement) -> tuple[list[Plan], list[ProfileElement]]:
    """Transform elements from the alignment's placement to the coordinates of the project."""
    moved = []
    for element in plan:
        placed = at.then(element.x_m, element.y_m, 0.0, element.direction_rad)
        moved.append(replace(element, x_m=placed.x_m, y_m=placed.y_m, direction_rad=placed.turn_rad))
    return moved, [replace(element, height_m=element.height_m + at.z_m) for element in profile]


def _law(step: _Step, entity: _Entity, kinds: dict[str, str]) -> str:
    kind = str(entity.values[-1]).strip(".")
    if kind not in kinds:
        raise InputFileError(step.path, f"{entity.kind} of kind {kind} is not supported; expected {', '.join(kinds)}")
    return kinds[kind]


def _plan(step: _Step, entity: _Entity, scale: float, angle: float) -> PlanElement:
    point, direction, first, last, length = entity.values[2:7]
    x, y, *rest = step.at(point, what=entity.kind).values[0]
    if len(rest) > 1:
        raise InputFileError(step.path, f"point {point} has {2 + len(rest)} coordinates; check for commas in numbers")
    law = _law(step, entity, {k: v for k, v in _LAWS.items() if "CANT" not in k and k != "LINEARTRANSITION"})
    if entity.values[-1] == ".CIRCULARARC.":
        # some programs write 0 or the radius of the next element; in IFC 4.3.2, both radii of an arc are equal
        last = first
    return PlanElement(
        x_m=x * scale,
        y_m=y * scale,
        direction_rad=direction * angle,
        first=1.0 / (first * scale) if first else 0.0,
        last=1.0 / (last * scale) if last else 0.0,
        length_m=length * scale,
        law=law,
    )


def _leaning(plan: list[PlanElement], leans: list[float], cant: list[CantElement]) -> list[PlanElement]:
    """Compute `lean_m` of each Viennese bend from the change of cant over the bend, and return the elements in plan.

    `leans` are the heights of the centre of gravity divided by the gauge, for each element.
    """
    result = []
    for element, lean, start in zip(plan, leans, plan_starts(plan), strict=True):
        if element.law == "viennese":
            same = cant[int(np.argmin([abs(ramp.start_m - start) for ramp in cant]))]
            rise = np.diff(same.right_m) - np.diff(same.left_m) if abs(same.start_m - start) < 0.1 else np.zeros(1)
            element = replace(element, lean_m=float(lean * rise[0]))
        result.append(element)
    return result


def _profile(step: _Step, entity: _Entity, scale: float) -> ProfileElement:
    start, length, height, first, last = entity.values[2:7]
    arc = _law(step, entity, _ARCS)
    if entity.values[-1] == ".CONSTANTGRADIENT.":
        last = first
    return ProfileElement(
        start_m=start * scale, length_m=length * scale, height_m=height * scale, first=first, last=last, arc=arc
    )


def _cant(step: _Step, entity: _Entity, scale: float) -> CantElement:
    start, length, left, left_end, right, right_end = entity.values[2:8]
    law = _law(step, entity, {k: v for k, v in _LAWS.items() if k not in ("LINE", "CIRCULARARC", "CLOTHOID")})
    return CantElement(
        start_m=start * scale,
        length_m=length * scale,
        left_m=(left * scale, (left if left_end is None else left_end) * scale),
        right_m=(right * scale, (right if right_end is None else right_end) * scale),
        law=law,
    )


def _is_uneven(entity: _Entity) -> bool:
    left, left_end, right, right_end = entity.values[4:8]
    uneven = (left_end is not None and left_end != left) or (right_end is not None and right_end != right)
    return entity.values[-1] == ".CONSTANTCANT." and uneven
