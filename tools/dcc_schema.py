# SPDX-License-Identifier: Apache-2.0
"""Fetch the schema of digital calibration certificates that the tests validate against.

.venv/bin/python tools/dcc_schema.py FOLDER [URL of dcc.xsd]

The schemas are LGPL and not part of this repository. The PTB publishes them; those they import are
fetched as well and named FOLDER/dcc.xsd, FOLDER/1.xsd, … Exit code 1 and one line if one cannot be
had or is another than the pinned one.
"""

import hashlib
import re
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urljoin
from xml.etree import ElementTree

URL = "https://ptb.de/dcc/v3.3.0/dcc.xsd"
XS = "{http://www.w3.org/2001/XMLSchema}"
IMPORT = re.compile(r'(schemaLocation\s*=\s*)"([^"]+)"')
SIGNATURES = "http://www.w3.org/2000/09/xmldsig#"
PINNED = {
    "https://ptb.de/dcc": "ffadd8bac25f239090afb616f249fe22eb3ca1914ecbb54d3000cd6e74770890",
    "https://ptb.de/si": "e531807d94168477d8c199e9df266fa902decf73bd0b02729d26ff6be80c795c",
    "http://qudt.org/vocab/": "9c28b26f96fe9309677474ac08bafd236cbb0d5ff53535164389c9e7c528d501",
    SIGNATURES: "5e550a6a56bd3ce84c6631f8f5d9703ba056f6e06fcc178a9eddb8817b69da0a",
}
"""Digest of each namespace: DCC 3.3.0, D-SI 2.2.1 with its units, XML signatures."""


def digest(text: bytes) -> tuple[str, str]:
    """Return the namespace of a schema, and the SHA-256 of what it declares.

    Annotations, comments, spaces and the places of imports, in which copies differ, do not count.
    """
    root = ElementTree.fromstring(text)
    for parent in list(root.iter()):
        for note in parent.findall(f"{XS}annotation"):
            parent.remove(note)
        parent.attrib.pop("schemaLocation", None)
    declared = ElementTree.canonicalize(ElementTree.tostring(root), strip_text=True)
    return root.get("targetNamespace", ""), hashlib.sha256(
        declared.encode()
    ).hexdigest()


def fetch(url: str, folder: Path) -> None:
    """Write a schema and those it imports, each once, with the places of the copies.

    Raises
    ------
    ValueError
        If a schema is not the pinned one.
    OSError, xml.etree.ElementTree.ParseError
        If it cannot be had.
    """
    names, texts = {url: "dcc.xsd"}, {}
    while waiting := [one for one in names if one not in texts]:
        request = urllib.request.Request(
            waiting[0], headers={"User-Agent": "selfcal_ros"}
        )
        with urllib.request.urlopen(request, timeout=5) as answer:
            text = answer.read()
        namespace, found = digest(text)
        if PINNED.get(namespace) != found:
            raise ValueError(
                f"{waiting[0]}: not the pinned schema, but {namespace} {found}"
            )

        def local(match: re.Match[str], base: str = waiting[0]) -> str:
            place = urljoin(base, match[2])
            return f'{match[1]}"{names.setdefault(place, f"{len(names)}.xsd")}"'

        texts[waiting[0]] = IMPORT.sub(local, text.decode())
    folder.mkdir(parents=True, exist_ok=True)
    for place in reversed(names):  # dcc.xsd last: where it is, all are
        (folder / names[place]).write_text(texts[place])


def main() -> int:
    """Fetch them; one line if that fails."""
    try:
        fetch(*(sys.argv[2:] or [URL]), Path(sys.argv[1]))
    except (OSError, ValueError, ElementTree.ParseError) as error:
        print(f"test: the schema of certificates is left out: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
