"""Components of an installed railfix (SBOM, CycloneDX 1.6 as JSON): ``sbom.py --extra maps --out railfix.json``.

It has railfix and what its metadata and those of its requirements ask for, as installed in the environment that runs
this. Libraries inside binary wheels (GDAL, PROJ, LLVM) are named by their wheels' own lists only: a component whose
wheel has one (PEP 770) has the property ``sbom``.
"""

from __future__ import annotations

import argparse
import json
import sys
import uuid
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import paths  # noqa: F401  puts the folders of the tests on the path
from railfix.core import file_sha256

_LICENSE: Final = "License :: "


def required(package: Distribution, extras: Sequence[str]) -> Iterator[Requirement]:
    """Yield the requirements of a distribution that hold here, with those of its extras."""
    for requirement in map(Requirement, package.requires or []):
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def installed(root: str, extras: Sequence[str]) -> tuple[dict[str, Distribution], dict[str, set[str]]]:
    """Find a distribution and all that it needs.

    Returns
    -------
    found : dict of str to Distribution
        By normalised name.
    needs : dict of str to set of str
        Names of what each needs itself.

    Raises
    ------
    PackageNotFoundError
        A requirement is not installed.
    """
    found: dict[str, Distribution] = {}
    needs: dict[str, set[str]] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(root, extra) for extra in ("", *extras)]
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        package = found.setdefault(name, distribution(name))
        for requirement in required(package, [extra]):
            other = canonicalize_name(requirement.name)
            if other != name:
                needs.setdefault(name, set()).add(other)
            waiting += [(other, more) for more in ("", *requirement.extras)]
    return found, needs


def component(package: Distribution) -> dict[str, Any]:
    """Return a distribution as a component of CycloneDX."""
    name = canonicalize_name(package.metadata["Name"])
    reference = f"pkg:pypi/{name}@{package.version}"
    found = {"type": "library", "bom-ref": reference, "name": name, "version": package.version, "purl": reference}
    lists = [str(path) for path in package.files or [] if "/sboms/" in str(path)]
    return {
        **found,
        **({"licenses": licenses} if (licenses := _licenses(package)) else {}),
        **({"properties": [{"name": "sbom", "value": path} for path in lists]} if lists else {}),
    }


def _licenses(package: Distribution) -> list[dict[str, Any]]:
    metadata = package.metadata
    if "License-Expression" in metadata:
        return [{"expression": metadata["License-Expression"]}]
    named = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if line.startswith(_LICENSE)]
    free = metadata.get("License", "")
    named = named or ([free] if free and "\n" not in free else [])
    return [{"license": {"name": name}} for name in named]


def bill_of_materials(extras: Sequence[str] = (), wheel: Path | None = None) -> dict[str, Any]:
    """Return the list of components of railfix as plain values, the same for the same environment.

    Parameters
    ----------
    extras : sequence of str
        Extras of railfix to include.
    wheel : Path, optional
        Archive whose SHA-256 is stated.
    """
    found, needs = installed("railfix", extras)
    components = {name: component(package) for name, package in sorted(found.items())}
    references = {name: entry["bom-ref"] for name, entry in components.items()}
    railfix = components.pop("railfix") | {"type": "application"}
    if wheel is not None:
        railfix["hashes"] = [{"alg": "SHA-256", "content": file_sha256(wheel)}]
    content = {
        "metadata": {"component": railfix},
        "components": list(components.values()),
        "dependencies": [
            {"ref": references[name], "dependsOn": sorted(references[other] for other in needs.get(name, ()))}
            for name in sorted(references)
        ],
    }
    serial = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(content))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{serial}",
        "version": 1,
    } | content


def main() -> int:
    """Write the list."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--extra", action="append", default=[])
    parser.add_argument("--wheel", type=Path, help="archive whose hash is stated")
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    listed = bill_of_materials(chosen.extra, chosen.wheel)
    chosen.out.write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(f"{chosen.out}: {len(listed['components'])} components\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
