# SPDX-License-Identifier: Apache-2.0
"""From the bytes of a calibration file to lines without comments."""

import codecs
import re

from selfcal_ros.aerotech.model import Finding, Severity

MAX_FINDINGS = 100
_MARKS = re.compile("[;'\"]")


class TooManyFindings(Exception):
    """Raised to stop reading a file that is not worth reading on."""


class Findings:
    """Collect findings: each kind of tolerance once with its count, the others up to a limit."""

    def __init__(self) -> None:
        self._listed: list[Finding] = []
        self._tolerated: dict[tuple[str, str], list[int]] = {}

    def error(self, line: int, what: str, remedy: str) -> None:
        """Note that the file must not be loaded."""
        self._add(Finding(line, Severity.ERROR, what, remedy))

    def warning(self, line: int, what: str, remedy: str) -> None:
        """Note something legal that was probably not meant."""
        self._add(Finding(line, Severity.WARNING, what, remedy))

    def tolerated(self, line: int, what: str, remedy: str) -> None:
        """Note a departure from the strict form whose meaning is plain."""
        self._tolerated.setdefault((what, remedy), []).append(line)

    def stop(self, line: int, what: str, remedy: str) -> None:
        """Note an error after which reading on makes no sense."""
        self._listed.append(Finding(line, Severity.ERROR, what, remedy))
        raise TooManyFindings

    def sorted(self) -> tuple[Finding, ...]:
        """Return all findings by line."""
        out = list(self._listed)
        for (what, remedy), lines in self._tolerated.items():
            more = f" (and in {len(lines) - 1} more lines)" if len(lines) > 1 else ""
            out.append(Finding(lines[0], Severity.TOLERATED, what + more, remedy))
        return tuple(sorted(out, key=lambda finding: finding.line))

    def _add(self, finding: Finding) -> None:
        self._listed.append(finding)
        if len(self._listed) >= MAX_FINDINGS:
            self.stop(finding.line, f"reading stopped after {MAX_FINDINGS} findings",
                      "correct the first ones")


def decode(data: bytes, findings: Findings) -> tuple[list[str], set[int]]:
    """Return the lines of a file without line ends, and the numbers of those not in UTF-8.

    A byte order mark and CRLF are tolerated, UTF-16 is an error. Lines that are not UTF-8 are
    read as Windows-1252; whether that is tolerable depends on what they say.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        findings.error(1, "the file is UTF-16", "save it as UTF-8")
        return _split(data.decode("utf-16", errors="replace"), findings), set()
    if data.startswith(codecs.BOM_UTF8):
        findings.tolerated(1, "a byte order mark before the first line", "save as plain UTF-8")
        data = data[len(codecs.BOM_UTF8):]
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        findings.stop(line, "a zero byte: this is no text file", "give a text file in UTF-8")
    try:
        return _split(data.decode(), findings), set()
    except UnicodeDecodeError:
        lines = _split(data.decode("latin-1"), findings)
    odd = set()
    for index, text in enumerate(lines):
        if not text.isascii():
            raw = text.encode("latin-1")
            try:
                lines[index] = raw.decode()
            except UnicodeDecodeError:
                lines[index] = raw.decode("cp1252", errors="replace")
                odd.add(index + 1)
    return lines, odd


def _split(text: str, findings: Findings) -> list[str]:
    if "\r" in text:
        line = text.count("\n", 0, text.index("\r")) + 1
        findings.tolerated(line, "lines end with CR or CRLF", "the strict form ends lines with LF")
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    if lines[-1]:
        findings.tolerated(len(lines), "the last line has no end", "end it with a newline")
    else:
        lines.pop()
    return lines


def strip_comment(line: str) -> tuple[str, str, str]:
    """Return the line before its comment, the comment's mark (or "") and the comment.

    A semicolon starts a comment, and so does an apostrophe (older controllers), unless it
    stands inside a quoted string.
    """
    quoted = False
    for match in _MARKS.finditer(line):
        at = match.start()
        if match.group() == '"':
            # A quote that is never closed does not hide the rest of the line.
            quoted = not quoted and line.find('"', at + 1) >= 0
        elif not quoted:
            return line[:at], line[at], line[at + 1:]
    return line, "", ""
