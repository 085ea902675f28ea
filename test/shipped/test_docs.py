# SPDX-License-Identifier: Apache-2.0
"""The tables of the documentation are complete, and its example runs."""

import json
import re
from importlib.metadata import requires
from math import radians
from pathlib import Path

import pytest

from selfcal_ros.bagio.messages.cdr import MAX_LENGTH
from selfcal_ros.blocks import BUILT_IN, block_of
from selfcal_ros.cli.main import VERBS, main
from selfcal_ros.collection.inputs import Reason
from selfcal_ros.compensation.plausible import PLAUSIBLE, PLAUSIBLE_M
from selfcal_ros.estimation.observability.plan_check import predict_plan
from selfcal_ros.files import MAX_JSON_VALUES, MAX_YAML_BYTES, MAX_YAML_NODES
from selfcal_ros.model.artifact import MAX_GRID_SIZE, Artifact, MapGrid
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.plan_form import MAX_VIEWS
from selfcal_ros.model.view import Plan, View
from selfcal_ros.nodes.sessions.compensating import LARGEST_FILE, LEAST_RADIUS_M
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.nodes import CompensatorSettings
from selfcal_ros.vision.exposures import SETTLED
from selfcal_ros.vision.images import EXPANSION, FORMATS, LARGEST
from test.support.lattice_plans import plan_of
from test.support.pages import PAGES

ROOT = Path(__file__).parents[2]
BAGS = (ROOT / "docs/reference/bags.md").read_text()


def test_every_reason_is_explained():
    for reason in Reason:
        assert f"| `{reason}` |" in BAGS


def test_the_simulation_of_the_documentation_runs(tmp_path, capsys):
    text = re.search(
        r"```yaml\n(.*?)```", (ROOT / "docs/guides/simulate.md").read_text(), re.S
    )[1]
    spec = tmp_path / "sim.yaml"
    spec.write_text(text.replace("../plans", str(ROOT / "config/plans")))
    assert main(["simulate", str(spec), "-o", str(tmp_path / "bag")]) == 0
    assert main(["solve", str(tmp_path / "bag")]) == 0
    printed = capsys.readouterr()
    assert (
        "Against the known truth" in printed.out
        and "solve with --robust" in printed.err
    )
    # a hundredth of its readings are outliers
    assert printed.err.splitlines()[-1].startswith(
        "selfcal: Good within an enlarged U: "
    )


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert f"usage: selfcal {verb}" in capsys.readouterr().out


BENT = re.compile(
    r"\| `(\w+)`[^|]*\| (\d) \| ([\d.]+) / ([\d.]+) µm \| ([\d.]+) µm \| ([\d.]+) / "
)


def test_bent_plates_do_to_the_shipped_plans_what_the_table_states(capsys):
    guide = (ROOT / "docs/guides/identifiability.md").read_text()
    rows = BENT.findall(guide)
    assert [row[0] for row in rows] == [
        "qiao",
        "hu_two_shifts",
        "six_views",
        "resistant",
    ]
    for plan, hidden, rms_um, largest_um, drift_um, gain in rows:
        path = str(ROOT / f"config/plans/{plan}.yaml")
        sizes = "plate_shape:30e-9,drift:10e-9"
        assert main(["plan", "check", path, "--against", sizes, "--json"]) == 0
        stated = json.loads(capsys.readouterr().out)
        terms = {term["name"]: term for term in stated["terms"]}
        bent = terms["plate_shape"]
        assert bent["unseen_modes"] == int(hidden)
        assert bent["effect_rms_m"] * 1e6 == pytest.approx(float(rms_um), abs=6e-4)
        assert bent["effect_max_m"] * 1e6 == pytest.approx(float(largest_um), abs=6e-4)
        effect_um = terms["drift"]["effect_rms_m"] * 1e6
        assert effect_um == pytest.approx(float(drift_um), abs=6e-5)
        assert stated["predicted"]["rms_gain_xy"] == pytest.approx(
            float(gain), abs=6e-3
        )


def test_plans_have_the_gains_that_the_table_states():
    stated = re.search(
        r"N = 11 the rms gain XY is \(N = 5: (\d+) to (\d+) % less, N = 21: (\d+) to (\d+) % more"
        r".*?\| plan \|(.*?)\|\n.*?\| gain \|(.*?)\|\n",
        (ROOT / "docs/guides/identifiability.md").read_text().replace("−", "-"),
        re.S,
    )
    assert stated
    plans, gains = (row.replace(" ", "").split("|") for row in stated.groups()[4:])
    less, more = [], []
    for plan, gain in zip(plans, gains, strict=True):
        first, _, other = plan.partition("or")
        for names in filter(None, (first, other and f"0,90,tx,{other}")):
            small, middle, large = (
                predict_plan(
                    plan_of(names, Artifact(side, 0.01, 0)), ThetaDatum.ZERO_MEAN
                ).rms_xy
                for side in (5, 11, 21)
            )
            assert middle == pytest.approx(float(gain), abs=1e-3)
            less.append(100 * (1 - small / middle))
            more.append(100 * (large / middle - 1))
    bounds = [round(f(values)) for values in (less, more) for f in (min, max)]
    assert bounds == list(map(int, stated.groups()[:4]))


def test_plans_are_judged_against_the_sizes_that_the_page_states():
    stated = re.search(
        r"TERM:SIZE`; default (\S+) µm, (\S+) µm for `drift`, (\S+) for `microscope`, (\S+) for ",
        (ROOT / "docs/guides/identifiability.md").read_text(),
    )
    bending_um, drift_um, microscope, strain = map(float, stated.groups())
    sizes = {
        "plate_shape": bending_um / 1e6,
        "approach": bending_um / 1e6,
        "drift": drift_um / 1e6,
        "microscope": microscope,
        "plate_scale": strain,
        "plate_strain": strain,
    }
    assert {name: block_of(name).nominal for name in sizes} == pytest.approx(sizes)
    others = set(BUILT_IN) - set(sizes)
    assert not any(block_of(name).nominal for name in others)


METHOD = (ROOT / "docs/theory/method.md").read_text()
ANGULAR = re.compile(
    r"K = (24): (\S+) σ \(`xy_axes`\), (\S+) σ \(`zero_mean`\); K =\s(72): (\S+) σ, (\S+) σ"
)
SERIES = re.compile(
    r"101°\} has (\S+) σ for K = (\d+), H = (\d+), (\S+) for K = (\d+), H = (\d+), "
    r"(\S+) for K = (\d+), H = (\d+)"
)


def test_angular_maps_have_the_gains_that_the_method_states():
    lines = ANGULAR.search(METHOD).groups()
    for count, *stated in (lines[:3], lines[3:]):
        plan = plan_of("0,90,tx", Artifact(11, 0.01, int(count)), lines=1)
        for datum, gain in zip(("xy_axes", "zero_mean"), stated, strict=True):
            predicted = predict_plan(plan, ThetaDatum(datum))
            assert predicted.rms_theta == pytest.approx(float(gain), abs=6e-4)
    series = SERIES.search(METHOD).groups()
    for gain, count, harmonics in (series[:3], series[3:6], series[6:]):
        nodes = MapGrid(4, 0.04 / 3)
        plate = Artifact(5, 0.01, int(count), map_grid=nodes, harmonics=int(harmonics))
        turned = [View(f"{turn}", radians(turn)) for turn in (0, 37, 101)]
        shifted = View("shifted", translation_m=(0.01, 0.0), angular=False)
        plan = Plan("series", plate, (*turned, shifted))
        predicted = predict_plan(plan, ThetaDatum.ZERO_MEAN)
        assert predicted.rms_theta == pytest.approx(float(gain), abs=6e-3)


CITED = re.compile(r"method eqs?\. (\d+\.\d+)(?:(-|, )(\d+\.\d+))?")


def test_every_equation_that_the_code_cites_exists():
    """A citation leads to a formula with that number, and numbers are given once."""
    numbers = re.findall(r" {2,}\((\d+\.\d+)\)$", METHOD, re.M)
    assert len(set(numbers)) == len(numbers) > 50
    cited = 0
    for path in sorted((ROOT / "selfcal_ros").rglob("*.py")):
        for first, _, last in CITED.findall(path.read_text()):
            cited += 1
            for number in filter(None, (first, last)):
                assert number in numbers, f"{path.name}: method eq. {number}"
    assert cited > 20


def test_every_page_is_in_the_menu_of_the_site():
    menu = re.findall(r"^ +- (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    pages = {
        str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")
    }
    assert set(menu) == pages, "list it in mkdocs.yml"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_the_site_reads_a_page_as_github_does(page):
    """Python-Markdown shows a fence of two words, or a list right below a line, as it stands."""
    within_fence, above = False, ""
    for line in page.read_text().splitlines():
        if line.lstrip().startswith("```"):
            assert within_fence or re.fullmatch(
                r' *```(\w+( title="[\w.]+")?)?', line
            ), line
            within_fence = not within_fence
        begins_list = re.match(r"(-|\d\.) ", line) and not within_fence
        assert not begins_list or re.match(r"$|(-|\d\.) | +", above), (
            f"no line above {line}"
        )
        above = line


def test_the_declaration_of_quality_names_every_dependency():
    stated = (ROOT / "QUALITY_DECLARATION.md").read_text().lower()
    named = re.findall(r"[\w-]+", re.search(r"\| 5 dependencies \|(.*?):", stated)[1])
    needed = [line for line in requires("selfcal_ros") if "extra ==" not in line]
    assert needed and {re.match(r"[\w-]+", line)[0].lower() for line in needed} < {
        *named
    }


def test_the_security_page_states_the_bounds_of_the_code():
    detector, compensator = DetectorSettings(), CompensatorSettings()
    stated = " ".join((ROOT / "SECURITY.md").read_text().split())
    for bound in (
        f"YAML to {MAX_YAML_BYTES >> 20} MB and {MAX_YAML_NODES:,} values",
        f"plans to {MAX_VIEWS:,} views and plates to {MAX_GRID_SIZE} marks per side",
        f"inputs longer than {MAX_LENGTH >> 10} kB",
        f"as {', '.join(FORMATS[:-1])} or {FORMATS[-1]} only",
        f"up to {LARGEST // 10**6} million pixels and {EXPANSION:,} pixels per byte",
        f"`max_marks` ({detector.max_marks:,})",
        f"results up to {LARGEST_FILE >> 20} MB and a million values",
        f"`max_correction` ({compensator.max_correction * 1e3:g} mm ",
        f"{LEAST_RADIUS_M * 1e3:g} mm from the axis",
        f"steeper than {100 * PLAUSIBLE:g} % of the pitch or {PLAUSIBLE_M * 1e6:g} µm",
    ):
        assert bound in stated
    assert MAX_JSON_VALUES == 10**6 and SETTLED == 3 and "Once three images" in stated
