# SPDX-License-Identifier: Apache-2.0
"""Every shipped file loads: plans, simulations, parameters, launch files, package manifests."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros import __version__
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json, read_yaml
from selfcal_ros.model.plan_form import plan_from_dict
from selfcal_ros.model.verdict import Grade
from selfcal_ros.settings.nodes import NODE_PARAMETERS, NODE_SETTINGS, overrides_in
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.spec import read_simulation
from test.support.truth import Spread, random_truth, simulate_measurements

ROOT = Path(__file__).parents[2]


def shipped(folder, pattern="*.yaml"):
    return pytest.mark.parametrize(
        "path", sorted((ROOT / folder).glob(pattern)), ids=lambda path: path.name
    )


FULL_PLANS = [
    path
    for path in sorted((ROOT / "config/plans").glob("*.yaml"))
    if path.stem != "recheck" and not path.stem.startswith("deficient")
]
"""Those that need nothing else to identify the stage."""


@shipped("config/plans")
def test_plans_load(path):
    plan = plan_from_dict(read_yaml(path), str(path))
    assert plan.plan_id and plan.views


@pytest.mark.parametrize("path", FULL_PLANS, ids=lambda path: path.name)
def test_a_smooth_stage_measured_by_a_plan_is_calibrated(path):
    plan = plan_from_dict(read_yaml(path), str(path))
    rng = np.random.default_rng(1)
    spread = Spread(phi_rad=3e-4, correlation_pitches=3.0)
    truth = random_truth(plan.artifact, len(plan.views), rng, spread)
    settings = CellSettings(sigma_xy_m=20e-9, sigma_theta_rad=2e-5)
    readings = simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    assert calibrate(readings).verdict.grade is Grade.GOOD


@shipped("config/simulations")
def test_simulations_load(path):
    assert read_simulation(path).plan.views


@shipped("config/params")
def test_parameter_files_name_only_what_exists(path):
    data = read_yaml(path)
    for node in NODE_PARAMETERS:
        NODE_SETTINGS[node].checked(overrides_in(data, node, str(path)), str(path))


def test_cell_parameters_are_the_defaults_they_say_they_are():
    data = read_yaml(ROOT / "config/params/cell.yaml")
    for node, table in NODE_PARAMETERS.items():
        defaults = {parameter.name: parameter.default for parameter in table}
        for name, value in overrides_in(data, node, "cell.yaml").items():
            assert value == defaults[name], f"{node}: {name}"


@shipped("launch", "*.launch.py")
def test_launch_files_compile_and_start_only_our_nodes(path):
    text = path.read_text()
    compile(text, str(path), "exec")
    for name in re.findall(r'executable="(\w+)"', text):
        assert name in NODE_PARAMETERS


def test_versions_agree():
    """The messages have a version of their own, see test_type_hashes."""
    found = {ElementTree.parse(ROOT / "package.xml").findtext("version")}
    found |= set(
        re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.M)
    )
    found.add(read_json(ROOT / "sbom.json")["metadata"]["component"]["version"])
    assert found == {__version__}


def test_the_index_and_the_site_name_every_page_of_the_documentation():
    index = (ROOT / "docs/index.md").read_text()
    docs = ROOT / "docs"
    pages = {str(page.relative_to(docs)) for page in docs.rglob("*.md")}
    assert set(re.findall(r"\]\(([\w./]+\.md)\)", index)) == pages - {"index.md"}
    assert set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text())) == pages


def test_the_links_of_the_readme_lead_somewhere():
    for link in re.findall(r"\]\(([\w./]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / link).is_file(), link


@pytest.mark.parametrize("prefix", ["", "cell1/", "hall/cell1/"])
def test_every_node_belongs_to_one_group_of_the_aggregator(prefix):
    data = read_yaml(ROOT / "config/diagnostics/analyzers.yaml")
    groups = data["analyzers"]["ros__parameters"]["calibration"]["analyzers"]
    for node in NODE_PARAMETERS:
        hits = [
            name
            for name, group in groups.items()
            if any(re.search(pattern, prefix + node) for pattern in group["regex"])
        ]
        assert len(hits) == 1, node
    assert not [
        name
        for name, group in groups.items()
        if any(re.search(pattern, "my_solver_2") for pattern in group["regex"])
    ]
