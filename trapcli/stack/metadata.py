"""Units and calibration as ImageJ and OME write them."""

from __future__ import annotations

OME_LENGTH_UNITS = (
    *(
        "Ym",
        "Zm",
        "Em",
        "Pm",
        "Tm",
        "Gm",
        "Mm",
        "km",
        "hm",
        "dam",
        "m",
        "dm",
        "cm",
        "mm",
        "µm",
        "nm",
        "pm",
        "fm",
    ),
    *("am", "zm", "ym", "Å", "thou", "li", "in", "ft", "yd", "mi", "ua", "ly", "pc", "pt", "pixel"),
)
"""Length units of the OME schema, but for ``reference frame``, which stands for an unknown one."""


def escape_ascii(text: str) -> str:
    r"""Write characters beyond ASCII as ``\uXXXX``, as ImageJ does."""
    return "".join(c if c.isascii() else f"\\u{ord(c):04X}" for c in text)
