# SPDX-License-Identifier: Apache-2.0
"""What is written as code in README and docs."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]


def code_lines(text: str) -> list[str]:
    """Return the lines of shell in a page: fences of sh or without a name, and indented ones."""
    lines, kind = [], None  # the kind of the fence that we are in
    for line in text.splitlines():
        if line.startswith("```"):
            kind = line[3:] if kind is None else None
        elif kind in ("", "sh") or (kind is None and line.startswith("    ")):
            lines.append(line)
    return lines


def lines_of(tool: str) -> list[str]:
    """Return the command lines of a tool in all pages, as code and within the text."""
    found: list[str] = []
    for page in PAGES:
        text = page.read_text()
        joined = "\n".join(code_lines(text)).replace("\\\n", " ")
        found += re.findall(rf"^ *({tool} [a-z][^\n#]*)", joined, re.M)
        found += re.findall(rf"`({tool} [a-z][^`\n]*)`", text)
    return [" ".join(line.split()) for line in found]
