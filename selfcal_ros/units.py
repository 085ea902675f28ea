# SPDX-License-Identifier: Apache-2.0
"""Factors between SI units and the units of texts and files, declared once.

``A_PER_B`` is how many A are one B: a length in m times `MM_PER_M` is in mm.
"""

import math

MM_PER_M, UM_PER_M, NM_PER_M = 1e3, 1e6, 1e9
M_PER_MM, M_PER_UM, M_PER_NM = 1e-3, 1e-6, 1e-9
M_PER_INCH = 0.0254
UM_PER_MM = 1e3
MRAD_PER_RAD, URAD_PER_RAD = 1e3, 1e6
RAD_PER_MRAD, RAD_PER_URAD = 1e-3, 1e-6
ARCSEC_PER_DEG = 3600.0
ARCSEC_PER_RAD = math.degrees(1) * ARCSEC_PER_DEG
RAD_PER_ARCSEC = math.radians(1 / 3600)
PPM_PER_ONE, ONE_PER_PPM = 1e6, 1e-6
NS_PER_S = 1_000_000_000
S_PER_NS, MS_PER_S, S_PER_H, S_PER_DAY = 1e-9, 1e3, 3600.0, 86400.0
BYTES_PER_MB = 1e6

RAD_PER = {
    "rad": 1.0,
    "mrad": RAD_PER_MRAD,
    "urad": RAD_PER_URAD,
    "deg": math.radians(1),
    "arcsec": RAD_PER_ARCSEC,
}
"""Angle of each unit by its name in options and files."""

M_PER = {"m": 1.0, "mm": M_PER_MM, "um": M_PER_UM, "nm": M_PER_NM}
"""Length of each unit by its name in options and files."""
