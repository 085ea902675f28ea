# SPDX-License-Identifier: Apache-2.0
"""A certified length at another temperature: sign, uncertainty, refusals."""

import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import SolverSettings


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("artifact", 1e-6 + 3 * 8e-6),
        ("stage_x", 1e-6 - 3 * 8e-6),
        ("stage_y", 1e-6 - 3 * 8e-6),
    ],
)
def test_a_warm_plate_is_longer_and_a_warm_scale_indicates_less(kind, expected):
    """8 ppm/K and 3 K: on a glass scale that grew by 24 ppm a true metre is 24 µm fewer."""
    found = ReferenceLength(kind, 1e-6, 3e-7, "PTB 1").at_temperature(
        "23:0.1:8e-6:1e-7"
    )
    assert found.relative_error == pytest.approx(expected)
    assert found.u_relative == pytest.approx(
        (3e-7**2 + (8e-6 * 0.1) ** 2 + (3 * 1e-7) ** 2) ** 0.5
    )
    assert found.certificate == "PTB 1"
    assert vars(found.certified) == {
        "relative_error": 1e-6,
        "u_relative": 3e-7,
        "temperature_c": 23.0,
        "u_temperature_k": 0.1,
        "expansion_per_k": 8e-6,
        "u_expansion_per_k": 1e-7,
        "certified_at_c": 20.0,
    }


def test_a_certificate_of_another_temperature():
    found = ReferenceLength("artifact", 0.0).at_temperature("20:0:1e-5:0:22")
    assert found.relative_error == pytest.approx(-2e-5) and found.u_relative == 0.0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "20",
        "20:0:1e-6",
        "20:0:1e-6:0:20:1",
        "20:-1:1e-6:0",
        "20:0:1e-6:-1",
        "x:0:1e-6:0",
        "nan:0:1e-6:0",
        "2_0:0:1e-6:0",
        "٢٠:0:1e-6:0",
    ],
)
def test_what_is_no_set_of_temperatures_is_refused(text):
    with pytest.raises(InputError, match="is not T:U_T:ALPHA"):
        ReferenceLength("artifact", 0.0).at_temperature(text)


@pytest.mark.parametrize("per_k", ["8", "0.5", "-8e-6"])
def test_what_no_solid_expands_by_is_refused(per_k):
    with pytest.raises(InputError, match=f":{per_k}:0' is not a coefficient of exp"):
        ReferenceLength("artifact", 0.0).at_temperature(f"20:0:{per_k}:0")


@pytest.mark.parametrize("per_k", ["-0.1e-6", "-1e-6", "2.4e-5"])
def test_glass_ceramics_and_carbon_fibre_may_shrink(per_k):
    found = ReferenceLength("artifact", 0.0).at_temperature(f"21:0:{per_k}:0")
    assert found.relative_error == pytest.approx(float(per_k))


@pytest.mark.parametrize(
    "text", ["296:0.02:8e-6:0", "20:0.02:8e-6:0:293.15", "-51:0:0:0"]
)
def test_a_temperature_in_kelvin_is_refused(text):
    with pytest.raises(InputError, match=r"-50 to 100 degC: is it in K\?"):
        ReferenceLength("artifact", 0.0).at_temperature(text)


def test_the_solver_moves_its_reference():
    settings = SolverSettings(
        reference_kind="artifact",
        reference_error=1e-6,
        reference_u=1e-7,
        reference_at="21:0.05:5e-7:0",
    )
    assert solver_options(settings).reference.relative_error == pytest.approx(1.5e-6)
