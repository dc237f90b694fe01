"""Units of length that other programs know."""

ANGSTROMS = {
    "Å": 1.0,
    "angstrom": 1.0,
    "pm": 0.01,
    "nm": 10.0,
    "µm": 1e4,
    "um": 1e4,
    "mm": 1e7,
    "cm": 1e8,
    "m": 1e10,
}
"""Å in units of length; MRC and STAR files know no other."""
