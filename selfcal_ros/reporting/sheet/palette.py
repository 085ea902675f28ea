# SPDX-License-Identifier: Apache-2.0
"""Colours by name, in light and in dark; told apart in grey and by the colour-blind."""

LEVELS = 10
"""Steps of a sequential scale, ``e0`` to ``e9`` (error) and ``v0`` to ``v9`` (uncertainty)."""

SIDES = 5
"""Steps of a diverging scale to either side of its middle: ``d0`` to ``d10``."""

SERIES = 6
"""Colours of series, ``c0`` to ``c5`` (Okabe and Ito); then they begin anew."""

_PLAIN = {
    "ink": ("#16202a", "#e7ecf1"), "soft": ("#55606a", "#a3afba"), "paper": ("#ffffff", "#14191e"),
    "line": ("#d5dbe1", "#36414b"), "card": ("#f5f7f9", "#1d242b"), "good": ("#00664b", "#4cc9a0"),
    "bad": ("#a83a00", "#ff9a5c"), "none": ("#e3e3e3", "#2b3137"), "band": ("#56b4e9", "#2f7fb0"),
    "truth": ("#d55e00", "#ff8f3f"),
    "c0": ("#0072b2", "#5ab4e8"), "c1": ("#d55e00", "#ff8f3f"), "c2": ("#008060", "#3fcf9f"),
    "c3": ("#a0509a", "#e39ad0"), "c4": ("#7a6a00", "#e0cc55"), "c5": ("#404a54", "#b9c3cc")}
_RAMPS = {
    "e": (("#ffffff", "#b5d3ea", "#4f93cc"), ("#171d23", "#22476a", "#2f74b0")),
    "v": (("#ffffff", "#c3b8de", "#7761ab"), ("#171d23", "#41346a", "#7058b0")),
    "d": (("#2b6cb0", "#ffffff", "#c8601a"), ("#3f86d0", "#171d23", "#d06a20"))}


def _mixed(stops: tuple[str, ...], part: float) -> str:
    """Return the colour at `part` (0 to 1) of a ramp of evenly spaced stops."""
    place = part * (len(stops) - 1)
    index = min(int(place), len(stops) - 2)
    low, high = (tuple(int(stops[i][at:at + 2], 16) for at in (1, 3, 5))
                 for i in (index, index + 1))
    return "#" + "".join(f"{round(a + (b - a) * (place - index)):02x}"
                         for a, b in zip(low, high, strict=True))


def _all_colours() -> dict[str, tuple[str, str]]:
    colours = dict(_PLAIN)
    for name, (light, dark) in _RAMPS.items():
        count = 2 * SIDES + 1 if name == "d" else LEVELS
        for i in range(count):
            part = i / (count - 1)
            colours[f"{name}{i}"] = (_mixed(light, part), _mixed(dark, part))
    return colours


COLOURS: dict[str, tuple[str, str]] = _all_colours()
"""Name -> colour on light and on dark paper."""


def _variables(column: int) -> str:
    return " ".join(f"--{name}: {pair[column]};" for name, pair in COLOURS.items())


def variables_css(root: str = ":root") -> str:
    """Return the rules that define all colours as CSS variables; on paper they are light."""
    return (f"{root} {{ color-scheme: light dark; {_variables(0)} }}\n"
            f"@media screen and (prefers-color-scheme: dark) {{ {root} {{ {_variables(1)} }} }}\n")


def classes_css() -> str:
    """Return the classes of figures: ``f-NAME`` fills, ``s-NAME`` strokes."""
    return "".join(f"svg.figure .f-{name}{{fill:var(--{name})}}"
                   f"svg.figure .s-{name}{{stroke:var(--{name})}}\n" for name in COLOURS)
