"""Units of mass properties, as CAD software writes them."""

from __future__ import annotations

import re

from asbuilt.errors import DescriptionError

MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237, "lbm": 0.45359237}
LENGTH = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "in": 0.0254,
    "inch": 0.0254,
    "ft": 0.3048,
}

_FACTOR = re.compile(r"([a-zA-Zµ]+)(?:\^?(-?\d+)|([²³]))?")
_SUPERSCRIPT = {"²": 2, "³": 3}


def unit_factor(text: str, *, mass: int, length: int) -> float:
    """Return the SI value of a unit such as `"g mm^2"`, `"kg*m²"` or `"lb in2"`.

    It must be mass^mass length^length.

    Raises `DescriptionError` where a symbol is unknown or the dimension is another one.

    >>> unit_factor("g mm^2", mass=1, length=2)
    1e-09
    """
    value, found_mass, found_length = 1.0, 0, 0
    rest = _FACTOR.sub("", text)
    if rest.strip(" *·.()") or not text.strip():
        raise DescriptionError(f"the unit {text!r} is not understood; write it like 'g mm^2'")
    for symbol, power, superscript in _FACTOR.findall(text):
        exponent = _SUPERSCRIPT.get(superscript) or int(power or 1)
        if symbol in MASS:
            found_mass += exponent
            value *= MASS[symbol] ** exponent
        elif symbol in LENGTH:
            found_length += exponent
            value *= LENGTH[symbol] ** exponent
        else:
            raise DescriptionError(
                f"the unit {text!r} holds {symbol!r}, which is unknown; known are"
                f" {', '.join([*MASS, *LENGTH])}"
            )
    if (found_mass, found_length) != (mass, length):
        raise DescriptionError(
            f"the unit {text!r} is mass^{found_mass} length^{found_length}; expected mass^{mass}"
            f" length^{length}"
        )
    return value
