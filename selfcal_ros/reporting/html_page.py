# SPDX-License-Identifier: Apache-2.0
"""The frame of a page that needs nothing else: style inside, nothing fetched."""

from selfcal_ros.reporting.html_style import CSS

POLICY = "default-src 'none'; style-src 'unsafe-inline'"
"""Content security policy: a browser will not fetch anything, whatever a name contains."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def page(title: str, body: str, *, style: str = "") -> str:
    """Return a whole page of escaped text and HTML; `style` comes after the common sheet."""
    return _PAGE.format(policy=POLICY, title=title, css=CSS + style, body=body)
