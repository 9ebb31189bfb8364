"""Compute the extinction of a laser beam in the air from the visibility that a weather report states."""

from __future__ import annotations

_CONTRAST = 3.912
"""-ln 0.02: visibility is the distance at which the air leaves 2 % of the contrast at 550 nm (Koschmieder 1924)."""
_REFERENCE_NM = 550.0


def extinction_per_m(visibility_m: float, wavelength_nm: float) -> float:
    """Compute the extinction coefficient of haze and fog, 1/m: sigma = 3.912 / V (wavelength / 550 nm)^-q (Kim et al. 2001).

    It tells how haze and fog weaken a scanner's echoes. `visibility_m` is the visibility V in m, `wavelength_nm` that of the
    laser in nm. The exponent q is smaller at shorter visibility, as droplets become larger than the wavelength: with V in km,
    it is 1.6 above 50 km, 1.3 above 6 km, 0.16 V + 0.34 above 1 km, V - 0.5 above 0.5 km, 0 in fog. The published jumps of q at
    6 and 50 km are kept. The model does not hold for rain and snow (see the effect `precipitation`), nor where gases absorb,
    which the bands of laser scanners avoid.

    Kim, McArthur, Korevaar (2001): Comparison of laser beam propagation at 785 nm and 1550 nm in fog and haze, Proc. SPIE 4214.
    """
    return _CONTRAST / visibility_m * (wavelength_nm / _REFERENCE_NM) ** -_size_exponent(visibility_m / 1000)


def _size_exponent(visibility_km: float) -> float:
    """Return the exponent q of the wavelength."""
    if visibility_km > 50:
        return 1.6
    if visibility_km > 6:
        return 1.3
    if visibility_km > 1:
        return 0.16 * visibility_km + 0.34
    return max(visibility_km - 0.5, 0.0)
