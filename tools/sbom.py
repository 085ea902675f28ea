# SPDX-License-Identifier: Apache-2.0
"""Write sbom.json (CycloneDX): every pinned wheel with its hashes, its licence and its scope.

Required is what `pip install .` brings, optional what comes with ROS 2, excluded what builds and
tests. `make sbom` runs it in the environment of `make setup`.
"""

import json
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from importlib.metadata import metadata, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from selfcal_ros import __version__
from selfcal_ros.outputs import write_json

ROOT = Path(__file__).parents[1]
STATED = {
    "apsw": "Zlib",
    "empy": "LGPL-2.1-or-later",
    "docutils": "LicenseRef-Public-Domain AND BSD-2-Clause AND GPL-3.0-or-later",
    "ros-fastcdr": "Apache-2.0",
    "ros-fastrtps": "Apache-2.0",
    "setuptools": "MIT",
}
"""Licences that neither the metadata of a wheel nor its package.xml name; from their sources."""
SPDX = {
    "Apache Software License": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "BSD": "BSD-3-Clause",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "zlib License": "Zlib",
}
"""Names of licences in wheels and manifests -> their identifiers, https://spdx.org/licenses."""


def pins() -> dict[str, tuple[str, list[str]]]:
    """Return name -> version and SHA-256 of the wheels, for each Python version."""
    found = {}
    for line in (ROOT / "tools/requirements.txt").read_text().splitlines():
        if not line.startswith("#"):
            name, version, *_ = re.split("==| ", line)
            found[name] = version, re.findall(r"--hash=sha256:([0-9a-f]{64})", line)
    return found


def required() -> set[str]:
    """Return the names that `pip install .` brings, with what they need."""
    text = re.search(
        r"install_requires=(\[.*?\])", (ROOT / "setup.py").read_text(), re.S
    )
    assert text is not None
    found: set[str] = set()
    waiting = tomllib.loads(f"names = {text[1]}")["names"]
    while waiting:
        wanted = Requirement(waiting.pop())
        if wanted.marker is None or wanted.marker.evaluate({"extra": ""}):
            name = canonicalize_name(wanted.name)
            if name not in found:
                found.add(name)
                waiting += requires(name) or []
    return found


def licence(name: str) -> str:
    """Return what an installed wheel says of its licence, as an SPDX expression."""
    about = metadata(name)
    stated = STATED.get(name) or about.get("License-Expression")
    if stated:
        return stated
    classifiers = [
        line.split(" :: ")[-1]
        for line in about.get_all("Classifier") or ()
        if line.startswith("License ::")
    ]
    if classifiers:
        return " OR ".join(SPDX.get(name, name) for name in classifiers)
    package = re.sub("^ros-(jazzy-)?", "", name).replace("-", "_")
    manifest = ROOT / ".venv/share" / package / "package.xml"
    if manifest.is_file():
        found = ElementTree.parse(manifest).getroot().findall("license")
        names = [str(item.text).strip() for item in found]
        return " AND ".join(SPDX.get(name, name) for name in names)
    return SPDX.get(about["License"], about["License"])


def bill() -> dict:
    """Return the bill of materials."""
    own = required()
    components = []
    for name, (version, hashes) in sorted(pins().items()):
        scope = (
            "required"
            if canonicalize_name(name) in own
            else ("optional" if name.startswith("ros-") else "excluded")
        )
        components.append(
            {
                "type": "library",
                "name": name,
                "version": version,
                "scope": scope,
                "purl": f"pkg:pypi/{canonicalize_name(name)}@{version}",
                "hashes": [{"alg": "SHA-256", "content": digest} for digest in hashes],
                "licenses": [{"expression": licence(name)}],
            }
        )
    about = {
        "type": "application",
        "name": "selfcal_ros",
        "version": __version__,
        "licenses": [{"license": {"id": "Apache-2.0"}}],
    }
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": about},
        "components": components,
    }


if __name__ == "__main__":
    write_json(ROOT / "sbom.json", bill())
    print(
        json.dumps(
            {
                part["name"]: part["licenses"][0]["expression"]
                for part in bill()["components"]
                if part["scope"] == "required"
            },
            indent=1,
        )
    )
