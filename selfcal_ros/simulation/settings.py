# SPDX-License-Identifier: Apache-2.0
"""How a simulated cell measures: who moves, in which order, and what its instruments do."""

from dataclasses import dataclass

from selfcal_ros.errors import InputError
from selfcal_ros.model.orders import parse_order
from selfcal_ros.model.readings import Sense
from selfcal_ros.units import NS_PER_S

DWELL = 0.6
"""Part of an exposure period in which the stage rests."""


@dataclass(frozen=True)
class CellSettings:
    """How the cell measures: SI units, rates in Hz, periods in s; all sizes standard deviations.

    Attributes
    ----------
    sense : Sense
        Who moves.
    sigma_xy_m, sigma_theta_rad : float
        White noise of one exposure.
    noise_ratio : float
        That of y over that of x, which is `sigma_xy_m`.
    encoder_rate_hz, exposure_period_s : float
        Encoder samples, and the time from one exposure to the next.
    with_ids, declare_sigma : bool
        Whether detections name their marks, and state their noise.
    servo_sigma_m, servo_sigma_rad : float
        How far the stage stands off where it stopped, exposure by exposure: motion, which the
        encoders tell.
    encoder_sigma_m, encoder_sigma_rad : float
        Noise of what the encoders tell, exposure by exposure: no motion.
    visit_order : str
        Order of the marks where a view does not ask for one (`selfcal_ros.model.orders`).
    consecutive : bool
        All repeats of a mark one after another, in one pass; otherwise one pass a repeat.
    stop_sigma_m, stop_sigma_rad : float
        How far from its target the stage stops, visit by visit.
    follow_mark : bool
        Whether the target is the mark as it is seen, not the nominal place of the view.
    visit_xy_m : float
        Noise that all exposures of a visit share.
    flicker_xy_m, flicker_theta_rad : float
        Noise with a spectrum of 1/f over the exposures of a view.
    resolution_xy_m, resolution_theta_rad : float
        Step of the offsets that the microscope tells; 0 = none.

    Raises
    ------
    InputError
        For a dwell too short for encoder samples on both sides of the exposure, or an order that
        is not known.
    """

    sense: Sense = Sense.MICROSCOPE_MOVES
    sigma_xy_m: float = 0.0
    sigma_theta_rad: float = 0.0
    noise_ratio: float = 1.0
    encoder_rate_hz: float = 500.0
    exposure_period_s: float = 0.01
    with_ids: bool = True
    declare_sigma: bool = False
    servo_sigma_m: float = 20e-9
    servo_sigma_rad: float = 1e-7
    encoder_sigma_m: float = 0.0
    encoder_sigma_rad: float = 0.0
    visit_order: str = ""
    consecutive: bool = False
    stop_sigma_m: float = 0.0
    stop_sigma_rad: float = 0.0
    follow_mark: bool = False
    visit_xy_m: float = 0.0
    flicker_xy_m: float = 0.0
    flicker_theta_rad: float = 0.0
    resolution_xy_m: float = 0.0
    resolution_theta_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what cannot be measured so."""
        if DWELL * self.exposure_period_s * self.encoder_rate_hz < 2.5:
            raise InputError("simulated cell", f"{self.encoder_rate_hz:g} Hz gives fewer than "
                             f"2.5 encoder samples in a dwell of "
                             f"{DWELL * self.exposure_period_s:g} s",
                             "raise encoder_rate or exposure_period")
        if self.visit_order:
            parse_order(self.visit_order, "simulated cell: visit_order")

    @property
    def period_ns(self) -> int:
        """Time from one exposure to the next, ns."""
        return round(self.exposure_period_s * NS_PER_S)

    @property
    def dwell_ns(self) -> int:
        """Time at rest in each period, ns; the exposure lies in its middle."""
        return round(DWELL * self.period_ns)

    @property
    def exposure_ns(self) -> int:
        """Time from the beginning of a period to its exposure, ns: between two samples."""
        return self.dwell_ns // 2 + 1
