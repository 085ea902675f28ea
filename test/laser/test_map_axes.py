# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.laser.ibaraki import identify_ibaraki
from selfcal_ros.laser.map_axes import compare_axes
from selfcal_ros.laser.profiles import straightness
from selfcal_ros.laser.result_json import outcome
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.simulation.laser import Measurement, case_study_machine, simulate_step_diagonal

MACHINE = case_study_machine()


def laser_result():
    data = simulate_step_diagonal(MACHINE, Measurement(), np.random.default_rng(0))
    found = identify_ibaraki(data)
    return found, outcome(found, data)


def machine_map(size=7, pitch=0.01):
    """Return the map of the case-study machine: G = -(Px(x) + Px(y), Py(x) + Py(y))."""
    sums = np.concatenate([np.zeros((2, 1, 2)), np.cumsum(MACHINE.errors_m, axis=1)], axis=1)
    g = -(sums[0][:, None] + sums[1][None])
    artifact = Artifact(size, pitch)
    inner = slice((size - 7) // 2, (size + 7) // 2)
    maps = np.zeros((2, size, size))
    maps[:, inner, inner] = np.moveaxis(g, -1, 0)
    none = np.full(artifact.shape, np.nan)
    return ErrorMap(artifact, maps[0], maps[1], none, none)


@pytest.mark.parametrize(("size", "start"), [(7, None), (7, (-0.03, -0.03)), (9, None)])
def test_map_and_laser_of_one_machine_agree(size, start):
    found, result = laser_result()
    along_x, along_y = compare_axes(machine_map(size), result, "OUT.json", start_m=start)
    assert along_x.axis == "x" and along_y.axis == "y"
    for comparison, axis in ((along_x, 0), (along_y, 1)):
        assert comparison.rms_m < 1e-14
        expected = straightness(found, axis, 1 - axis).value
        assert comparison.straightness_map_m == pytest.approx(expected, rel=1e-6)
        assert comparison.straightness_laser_m == pytest.approx(expected, rel=1e-6)
        assert expected > 40e-9
    np.testing.assert_allclose(along_x.position_m, np.arange(-3, 4) * 0.01, atol=1e-15)


def test_a_map_of_the_other_sign_does_not_agree():
    _, result = laser_result()
    emap = machine_map()
    other = ErrorMap(emap.artifact, -emap.gx, -emap.gy, emap.u_gx, emap.u_gy)
    assert all(c.rms_m > 20e-9 for c in compare_axes(other, result, "OUT.json"))


@pytest.mark.parametrize(("emap", "result", "start", "message"), [
    (machine_map(), {}, None, "OUT.json: no profile py_x; give an OUT.json"),
    (machine_map(), {"profiles": {"py_x": {"position": "a", "error": []}}}, None, "no profile"),
    (machine_map(7, 0.009), None, None, "x axis: the laser's range of 60 mm reaches beyond"),
    (machine_map(), None, (0.0, 0.0), "say where the first block starts")])
def test_what_cannot_be_compared_is_named(emap, result, start, message):
    result = laser_result()[1] if result is None else result
    with pytest.raises(InputError, match=message):
        compare_axes(emap, result, "OUT.json", start_m=start)


def test_an_unknown_site_on_the_axis_is_named():
    emap = machine_map()
    emap.gy[2, 3] = np.nan
    with pytest.raises(InputError, match="x axis: sites on the middle line of the map are unknown"):
        compare_axes(emap, laser_result()[1], "OUT.json")
