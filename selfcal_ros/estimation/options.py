# SPDX-License-Identifier: Apache-2.0
"""How to calibrate: datum, reference length, model of the misalignments."""

from dataclasses import dataclass, field

from selfcal_ros.errors import InputError, known_are
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import DRIFT_DEGREE, ModelTerm, default_terms

MISALIGNMENT_MODELS = ("linear", "rigid")
OWED = 0.1
"""Share of u^2 from which an assumption, or what removes it, is named."""


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    Attributes
    ----------
    datum_theta : ThetaDatum
        Condition that fixes the constant of the angular map.
    reference : ReferenceLength, optional
        Sets the scale; without it the map has none (Hu eq. 5).
    misalignment_model : str
        ``rigid``: finite rotations of the plate, or ``linear``, as published.
    uncertainty : bool, optional
        Whether to compute the uncertainty map; None decides by the size of the field.
    terms : tuple of ModelTerm
        Terms of the model estimated with the map.
    drift_degree : int
        Degree of the polynomial of the drift of a view, if drift is a term.
    causes : bool, optional
        Whether to search for unmodelled terms in the readings; None searches
        in fields of up to 41 x 41 sites, and if a test fails.
    terms_from : str
        Origin of the terms, for the provenance: ``options``, ``plan`` or empty.
    assumed : tuple of ModelTerm
        Terms with sizes that apply unless `terms` names them: lines of type B of the budget
        (GUM 4.3). Empty: all of them are known to be zero. Linear models assume none: strain would
        absorb the finite rotations that they omit.
    at_places : bool
        Whether readings have the stage error of the place where the stage stood, or that of the
        site of their mark.
    magnification_limit : float
        Difference of the scales of plate and encoders, m/m, beyond which there is a warning.
    robust : bool
        Whether to leave out readings that contradict the others, and to name bad views.
    plate : CalibrationResult, optional
        Calibration that made the plate known: its map is given, and the stage's is rechecked.
    plate_from : str
        Its file, for messages.
    plate_at : str
        Temperature of the known plate, as for `ReferenceLength.at_temperature`; empty = not known.

    Raises
    ------
    InputError
        For an unknown model or datum, or if robust does not fit the others.
    """

    datum_theta: ThetaDatum = ThetaDatum.ZERO_MEAN
    reference: ReferenceLength | None = None
    misalignment_model: str = "rigid"
    uncertainty: bool | None = None
    terms: tuple[ModelTerm, ...] = ()
    drift_degree: int = DRIFT_DEGREE
    causes: bool | None = None
    terms_from: str = ""
    assumed: tuple[ModelTerm, ...] = field(default_factory=default_terms)
    at_places: bool = True
    magnification_limit: float = 1e-4
    robust: bool = False
    plate: CalibrationResult | None = None
    plate_from: str = ""
    plate_at: str = ""

    def __post_init__(self) -> None:
        """Refuse unknown names."""
        if self.misalignment_model not in MISALIGNMENT_MODELS:
            raise InputError(
                "misalignment_model",
                f"'{self.misalignment_model}' is unknown",
                known_are(self.misalignment_model, MISALIGNMENT_MODELS),
            )
        try:
            object.__setattr__(self, "datum_theta", ThetaDatum(self.datum_theta))
        except ValueError as error:
            raise InputError(
                "datum_theta",
                f"'{self.datum_theta}' is unknown",
                known_are(str(self.datum_theta), ThetaDatum),
            ) from error
        if self.robust and self.plate is not None:
            raise InputError(
                "robust",
                f"the plate is known from {self.plate_from}, and one view has nothing "
                "to check its readings against",
                "omit it",
            )

    @property
    def finite_rotations(self) -> bool:
        """Whether the plate turns by finite angles in the model."""
        return self.misalignment_model == "rigid"

    def model_terms(
        self, *, visits: bool, assumed: bool = True
    ) -> tuple[ModelTerm, ...]:
        """Return all terms of the model, requested terms before assumed ones.

        Parameters
        ----------
        visits : bool
            Whether the visits of every view are known, as a microscope term requires.
        assumed : bool
            Whether to include assumed terms.
        """
        named = {term.name for term in self.terms}
        more = [
            term
            for term in self.assumed
            if assumed
            and term.name not in named
            and (visits or not term.block.needs_visits)
        ]
        return tuple(term for term in (*self.terms, *more) if term.size > 0)
