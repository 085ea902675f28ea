# SPDX-License-Identifier: Apache-2.0
"""Numbers in texts that people and programs write."""


def number_of(text: str) -> float:
    """Return the number that a text is.

    Raises
    ------
    ValueError
        If it is none, also for 1_000 and for digits of other scripts, which float() reads.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"not a plain number: {text!r}")
    return float(text)
