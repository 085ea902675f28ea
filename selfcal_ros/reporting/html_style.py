# SPDX-License-Identifier: Apache-2.0
"""The style sheet of a report: light, dark and paper."""

CSS = """
:root { color-scheme: light dark; --ink: #16202a; --soft: #55606a; --paper: #ffffff;
  --line: #d5dbe1; --card: #f5f7f9; --good: #00664b; --bad: #a83a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7ecf1; --soft: #a3afba;
  --paper: #14191e; --line: #36414b; --card: #1d242b; --good: #4cc9a0; --bad: #ff9a5c; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 72rem; background: var(--paper);
  color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 1.8rem 0 .5rem; border-bottom: 1px solid var(--line); }
.verdict { border-left: .35rem solid var(--good); background: var(--card); padding: .7rem 1rem;
  margin: .8rem 0; font-size: 1.05rem; overflow-wrap: anywhere; }
.verdict.bad { border-color: var(--bad); }
.attention li { color: var(--bad); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .8rem .2rem 0; text-align: right; vertical-align: top; }
thead th { border-bottom: 1px solid var(--line); color: var(--soft); font-weight: 600; }
table:not(.facts) tbody tr + tr td { border-top: 1px solid var(--line); }
th:first-child, td:first-child, .facts td { text-align: left; }
.facts th { color: var(--soft); font-weight: 400; text-align: left; white-space: nowrap; }
.facts td { overflow-wrap: anywhere; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; flex: 1 1 26rem; min-width: 0; }
img { width: 100%; height: auto; background: #ffffff; border: 1px solid var(--line); }
figcaption { color: var(--soft); font-size: .9rem; }
@media print { :root { color-scheme: light; --ink: #000000; --soft: #444444; --paper: #ffffff;
  --line: #bbbbbb; --card: #ffffff; --good: #00664b; --bad: #a83a00; }
  body { max-width: none; padding: 0; font-size: 10pt; }
  figure, tr, section:not(.maps) { break-inside: avoid; } h2 { break-after: avoid; }
  h2 { margin: 1rem 0 .3rem; } td, th { padding-bottom: .1rem; padding-top: .1rem; }
  .figures { display: block; } figure { display: inline-block; width: 48%; margin-right: 1%; }
  @page { margin: 15mm; } }
"""
