# SPDX-License-Identifier: Apache-2.0
"""Numbers in texts that people and programs write."""


def number_of(text: str) -> float:
    """Return the number that a text is.

    Raises
    ------
    ValueError
        If it is none, also for 1_000 and for digits of other scripts, which float() reads.
    """
    return float(_plain(text))


def whole_number_of(text: str) -> int:
    """Return the whole number that a text is; ValueError as of `number_of`."""
    return int(_plain(text))


def _plain(text: str) -> str:
    """Return `text`; ValueError if it has what stands in no plain number."""
    if not text.isascii() or "_" in text:
        raise ValueError(f"not a plain number: {text!r}")
    return text
