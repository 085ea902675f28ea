# SPDX-License-Identifier: Apache-2.0
"""The style sheet of a report: light, dark and paper, from a telephone to a wide screen."""

from selfcal_ros.reporting.sheet.svg import css as figures_css

CSS = figures_css() + """
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 72rem; background: var(--paper);
  color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
a { color: var(--c0); }
nav { color: var(--soft); } nav a { margin-right: .9rem; display: inline-block; }
.verdict { border-left: .35rem solid var(--good); background: var(--card); padding: .7rem 1rem;
  margin: .8rem 0; font-size: 1.05rem; overflow-wrap: anywhere; }
.verdict.bad { border-color: var(--bad); }
.attention li { color: var(--bad); }
.scroll { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .9rem .2rem 0; text-align: right; vertical-align: top; }
thead th { border-bottom: 1px solid var(--line); color: var(--soft); font-weight: 600; }
table:not(.facts) tbody tr + tr td { border-top: 1px solid var(--line); }
th:first-child, td:first-child, .facts td, .s, .w, .t { text-align: left; }
.n { text-align: right; white-space: nowrap; }
.s { white-space: nowrap; } .w { min-width: 16rem; }
.facts th { color: var(--soft); font-weight: 400; width: 11rem; }
.facts td { overflow-wrap: anywhere; }
.figures { display: grid; gap: 1.4rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); align-items: start;
  margin-bottom: 1rem; }
figure { margin: 0; min-width: 0; max-width: 35rem; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3rem; }
@media (max-width: 30rem) { body { padding: .7rem; font-size: 14px; }
  .facts th { width: 6.5rem; } th, td { padding-right: .6rem; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; } nav { display: none; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; }
  h2 { margin: 1rem 0 .3rem; } td, th { padding-bottom: .1rem; padding-top: .1rem; }
  .figures { display: block; } .scroll { overflow: visible; }
  figure { display: inline-block; width: 48%; margin: 0 1% .6rem 0; vertical-align: top; }
  @page { margin: 15mm; } }
"""
