# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared once; unknown names, wrong types and values out of bounds are refused."""

import math
import re
from pathlib import Path

import pytest
import yaml

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import default_terms
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import (
    NODE_PARAMETERS,
    NODE_SETTINGS,
    CollectorSettings,
    PlayerSettings,
    RecorderSettings,
    SolverSettings,
    overrides_in,
)

EVERY = [(node, p) for node, table in NODE_PARAMETERS.items() for p in table]


def values_in(text, node="measurement_collector"):
    return NODE_SETTINGS[node].checked(
        overrides_in(yaml.safe_load(text), node, "p.yaml"), "p.yaml"
    )


@pytest.mark.parametrize(
    ("node", "parameter"), EVERY, ids=lambda v: getattr(v, "name", v)
)
def test_every_default_is_in_bounds_and_said_in_words(node, parameter):
    assert parameter.check(parameter.default, "here") == parameter.default
    assert parameter.description
    assert (
        getattr(NODE_SETTINGS[node].checked({}, "here"), parameter.name)
        == parameter.default
    )


@pytest.mark.parametrize(
    ("node", "parameter"),
    [item for item in EVERY if item[1].high is not None],
    ids=lambda v: getattr(v, "name", v),
)
def test_the_bounds_are_allowed_and_beyond_is_not(node, parameter):
    kind = type(parameter.default)
    for bound, away in ((parameter.low, -math.inf), (parameter.high, math.inf)):
        assert parameter.check(kind(bound), "here") == bound
        beyond = (
            math.nextafter(bound, away)
            if kind is float
            else int(bound + math.copysign(1, away))
        )
        with pytest.raises(
            InputError, match=f"^here: {parameter.name}: .* is outside "
        ):
            NODE_SETTINGS[node].checked({parameter.name: beyond}, "here")


@pytest.mark.parametrize("node", NODE_PARAMETERS)
def test_the_file_of_all_parameters_states_their_units_and_bounds(node):
    text = (Path(__file__).parents[2] / "config/params/all.yaml").read_text()
    section = re.split(r"^(\w+):$", text, flags=re.M)
    found = re.findall(
        r"((?:^    # .*\n)+)    (\w+): ", section[section.index(node) + 1], re.M
    )
    about = {name: " ".join(re.findall(r"# (.*)", words)) for words, name in found}
    for parameter in NODE_PARAMETERS[node]:
        assert parameter.name in about, "run `make reference`"
        facts = re.fullmatch(r".*? ?(?:\[([^\[]*)\])?", about[parameter.name])[1] or ""
        assert facts.startswith(parameter.unit)
        if parameter.low is not None:
            low, high = facts.rpartition("; ")[2].split(" to ")
            assert (float(low), float(high)) == pytest.approx(
                (parameter.low, parameter.high), rel=1e-5
            )


def test_names_are_unique_in_a_node():
    for table in NODE_PARAMETERS.values():
        assert len({p.name for p in table}) == len(table)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "max_sped",
            1.0,
            "measurement_collector has no such parameter; did you mean 'max_speed'?",
        ),
        (
            "max_speed",
            "fast",
            "'fast' is not of type float; give a number in SI units, without a "
            "unit and without quotes",
        ),
        ("max_speed", True, "True is not of type float; correct the value"),
        ("max_speed", math.nan, "nan is outside 0.0 to 1.0 m/s; correct the value"),
        ("max_speed", math.inf, "inf is outside 0.0 to 1.0 m/s; correct the value"),
        ("joint_x", 3, "3 is not of type str; put it in quotes"),
        ("joint_y", False, "False is not of type str; put it in quotes"),
        ("joint_x", True, "True is not of type str; put it in quotes"),
        (
            "measurement_sense",
            "plate",
            "'plate' is not known; choose one of microscope_moves, plate_",
        ),
    ],
)
def test_what_is_refused_and_how(name, value, message):
    with pytest.raises(InputError) as caught:
        CollectorSettings.checked({name: value}, "p.yaml")
    assert str(caught.value).startswith(f"p.yaml: {name}: {message}")


def test_whole_numbers_are_floats_where_floats_are_wanted_but_not_the_other_way():
    value = PlayerSettings.checked({"rate": 2}, "here").rate
    assert (value, type(value)) == (2.0, float)
    for value in (1.0, True):
        with pytest.raises(InputError, match="is not of type int"):
            PlayerSettings.checked({"seed": value}, "here")
    with pytest.raises(InputError, match="is not of type bool"):
        RecorderSettings.checked({"all_topics": 1}, "here")


@pytest.mark.parametrize("node", ["measurement_collector", "compensator"])
def test_a_bare_y_that_ros_has_read_as_true_is_the_joint_y(node):
    assert NODE_SETTINGS[node].checked({"joint_y": True}, "here").joint_y == "y"


def test_parameters_that_ros_adds_itself_are_let_pass():
    overrides = {
        "use_sim_time": True,
        "start_type_description_service": False,
        "qos_overrides./tf.publisher.depth": 5,
    }
    assert SolverSettings.checked(overrides, "here") == SolverSettings.checked(
        {}, "here"
    )


@pytest.mark.parametrize(
    "section",
    [
        "measurement_collector",
        "/measurement_collector",
        "/cell/measurement_collector",
        "/**",
        "**",
        "/**/measurement_collector",
        "/cell/**",
        "/*",
    ],
)
def test_sections_that_mean_a_node(section):
    text = f"'{section}':\n  ros__parameters:\n    max_speed: 0.25\n"
    assert values_in(text).max_speed == 0.25


def test_nested_namespaces_and_nested_names():
    text = "cell:\n  left:\n    measurement_collector:\n      ros__parameters: {max_speed: 0.5}\n"
    assert values_in(text).max_speed == 0.5
    dotted = {"solver": {"ros__parameters": {"a": {"b": {"c": 1}}, "d": 2}}}
    assert overrides_in(dotted, "solver", "f") == {"a.b.c": 1, "d": 2}


def test_cells_that_differ_are_refused():
    text = "/left/measurement_collector: {ros__parameters: {max_speed: 0.5}}\n/right: "
    right = "{measurement_collector: {ros__parameters: {max_speed: %s}}}\n"
    assert values_in(text + right % 0.5).max_speed == 0.5
    message = (
        r"^p\.yaml: max_speed: differs between /left/measurement_collector and "
        r"/right/measurement_collector; give a file of one cell$"
    )
    with pytest.raises(InputError, match=message):
        values_in(text + right % 0.25)


def test_sections_of_other_nodes_do_not_reach():
    text = "solver: {ros__parameters: {method: law}}\nbag_player: {ros__parameters: {rate: 0.0}}"
    assert values_in(text) == CollectorSettings.checked({}, "f")
    assert values_in(text, "solver").method == "law"


def test_a_wild_card_section_holds_parameters_of_many_nodes_but_no_unknown_ones():
    text = "/**: {ros__parameters: {method: law, max_speed: 0.1, frame_id: base}}"
    assert values_in(text).frame_id == "base"
    assert values_in(text, "solver").method == "law"
    with pytest.raises(
        InputError, match=r"p.yaml: methd: solver has no such parameter"
    ):
        values_in("/**: {ros__parameters: {methd: law}}", "solver")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "colector: {ros__parameters: {}}",
            "p.yaml: /colector: no node of this package; known are ",
        ),
        (
            "[1, 2]",
            "p.yaml: not a ROS parameter file; write 'NODE: ros__parameters: ...'",
        ),
        (
            "solver: 5",
            "p.yaml: not a ROS parameter file; write 'NODE: ros__parameters: ...'",
        ),
        (
            "solver: {ros__parameters: [1]}",
            "p.yaml: /solver: ros__parameters is not a mapping; write",
        ),
    ],
)
def test_files_that_are_refused(text, message):
    with pytest.raises(InputError) as caught:
        values_in(text)
    assert str(caught.value).startswith(message)


def test_an_empty_section_sets_nothing():
    assert values_in("solver: {ros__parameters: }", "solver").method == "joint"


def test_the_estimator_gets_what_the_solver_was_given():
    settings = SolverSettings.checked(
        {"theta_datum": "xy_axes", "misalignment_model": "linear"}, "here"
    )
    options = solver_options(settings)
    assert (options.datum_theta, options.misalignment_model) == (
        ThetaDatum.XY_AXES,
        "linear",
    )
    assert options.uncertainty is None


def test_without_being_told_plates_turn_and_the_encoder_owes_nothing_to_the_axes():
    options = solver_options(SolverSettings.checked({}, "here"))
    assert options == Options()
    assert (options.datum_theta, options.misalignment_model) == (
        ThetaDatum.ZERO_MEAN,
        "rigid",
    )


def test_the_law_cannot_use_a_known_plate():
    with pytest.raises(
        InputError,
        match=r"method law: the plate is known from r.json, and .*leave "
        "the method out",
    ):
        solver_options(
            SolverSettings.checked({"method": "law"}, "here"), plate_from="r.json"
        )


def asked(*terms: str) -> Measurements:
    return Measurements("p", Artifact(3, 0.01), (), model_terms=terms)


@pytest.mark.parametrize(
    ("given", "planned", "terms", "origin"),
    [
        ([""], (), [], ""),
        ([""], ("drift:1e-08",), ["drift:1e-08"], "plan"),
        (
            ["approach,microscope"],
            ("drift:1e-08", "microscope:0.05:0.01:0.002"),
            ["microscope", "drift:1e-08", "approach"],
            "options",
        ),
        (["drift"], ("drift:1e-08",), ["drift"], "options"),
        (["drift:0"], ("drift", "approach"), ["drift:0", "approach"], "options"),
        (["none"], ("drift:1e-08",), [], ""),
        ([" none "], (), [], ""),
        (["none,"], ("drift:1e-08",), [], ""),
        ([" , "], ("drift:1e-08",), ["drift:1e-08"], "plan"),
        (["drift"], (), ["drift"], "options"),
    ],
)
def test_given_terms_win_over_the_same_of_the_plan_which_keeps_its_others(
    given, planned, terms, origin
):
    settings = SolverSettings.checked({"model_terms": given}, "here")
    options = solver_options(settings, asked(*planned))
    assert ([str(term) for term in options.terms], options.terms_from) == (
        terms,
        origin,
    )


@pytest.mark.parametrize(
    ("given", "planned", "message"),
    [
        (
            [""],
            ("creep",),
            "plan 'p': model_terms: the term 'creep' is unknown; known are ",
        ),
        (["creep"], (), "model_terms: the term 'creep' is unknown; known are "),
        (
            ["none,drift"],
            (),
            "model_terms: 'none' and other terms exclude each other; leave out ",
        ),
        (
            ["drift", "none"],
            (),
            "model_terms: 'none' and other terms exclude each other; leave out ",
        ),
        (
            [""],
            ("drift:x",),
            "plan 'p': model_terms: drift: the size 'x' is not a positive number; ",
        ),
    ],
)
def test_terms_that_cannot_be(given, planned, message):
    settings = SolverSettings.checked({"model_terms": given}, "here")
    with pytest.raises(InputError) as caught:
        solver_options(settings, asked(*planned))
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("word", "wanted"), [("auto", None), ("always", True), ("never", False)]
)
def test_the_uncertainty_map_is_wanted_in_words(word, wanted):
    settings = SolverSettings.checked({"uncertainty": word}, "here")
    assert solver_options(settings).uncertainty is wanted


def model_of(planned=(), **given):
    """Return the model of a solver with a plan's terms, as they are written in an option."""
    readings = Measurements("p", Artifact(5, 0.01), (), model_terms=planned)
    options = solver_options(SolverSettings.checked(given, "here"), readings)
    return [str(term) for term in options.model_terms(visits=True)]


ASSUMED = [str(term) for term in default_terms()]


def test_what_is_known_of_the_microscope_is_assumed_unless_somebody_says_otherwise():
    assert ASSUMED[0] == "microscope:0.01:0.01:0.002"
    assert model_of() == ASSUMED
    assert model_of(scale_u=0.1, rotation_u=0.02, shear_u=0.003) == [
        "microscope:0.1:0.02:0.003",
        *ASSUMED[1:],
    ]
    assert model_of(model_terms=["microscope"], scale_u=0.1) == [
        "microscope",
        *ASSUMED[1:],
    ]
    assert model_of(scale_u=0.0, rotation_u=0.0, shear_u=0.0) == ASSUMED[1:]


def test_what_a_plan_declares_outlives_options_for_other_terms():
    planned = ("microscope:0.05:0.01:0.002", "plate_shape:3e-08", "approach")
    others = [text for text in ASSUMED[1:] if not text.startswith("plate_shape")]
    assert model_of(planned) == [*planned, *others]
    assert model_of(planned, model_terms=["drift"], scale_u=0.1) == [
        planned[0],
        "drift",
        *planned[1:],
        *others,
    ]
    # as --microscope does: it declares an instrument, and chooses no model
    assert model_of(planned, model_terms=["microscope:0"]) == [*planned[1:], *others]
    assert model_of(planned, model_terms=["none"]) == []
