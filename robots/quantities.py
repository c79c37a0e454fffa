"""Physical quantities in configuration: a value is written with its unit ("3ms", "45deg") and read as SI.

A bare number is refused where a unit exists, so that no file can be off by a factor of a thousand unnoticed.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")

_PREFIXED = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "Hz": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "bit/s": {"bit/s": 1.0, "kbit/s": 1e3, "Mbit/s": 1e6},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    "kg": {"kg": 1.0, "g": 1e-3},
    "kg m²": {"kg m²": 1.0, "kgm²": 1.0, "kg m2": 1.0, "kgm2": 1.0},
    "N": {"N": 1.0, "kN": 1e3},
    "N m": {"N m": 1.0, "Nm": 1.0},
    "A": {"A": 1.0, "mA": 1e-3},
    "K": {"K": 1.0},
    "V": {"V": 1.0},
    "N m/rad": {"N m/rad": 1.0, "Nm/rad": 1.0},
    "N m s/rad": {"N m s/rad": 1.0, "Nm s/rad": 1.0, "Nms/rad": 1.0},
    "N m/s": {"N m/s": 1.0, "Nm/s": 1.0},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2},
    "ppm": {"ppm": 1.0},
}


def parse_quantity(text: Any, unit: str) -> float:
    """Read ``text`` ("3ms") as a number in the SI unit ``unit`` ("s"). Zero needs no unit.

    Raises ValueError with one sentence that names the accepted units.
    """
    scales = _PREFIXED[unit]
    accepted = ", ".join(scales)
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise ValueError(f"expected a quantity with a unit ({accepted}), got {text!r}")
    if not isinstance(text, str):
        if text == 0:
            return 0.0
        if isinstance(text, float) and not math.isfinite(text):
            raise ValueError(f"{text!r} is not a finite number with a unit ({accepted})")
        raise ValueError(f"{text!r} has no unit: write one of {accepted}, for example \"{text}{next(iter(scales))}\"")
    match = _NUMBER.match(text)
    if match is None:
        raise ValueError(f"{text!r} is not a number with a unit ({accepted})")
    value, suffix = float(match.group(1)), match.group(2).replace("\u03bc", "\u00b5")  # Greek mu: micro
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is too large")
    if not suffix:
        if value == 0:
            return 0.0
        raise ValueError(f"{text!r} has no unit: write one of {accepted}")
    if suffix not in scales:
        raise ValueError(f"unit {suffix!r} in {text!r} does not fit: use one of {accepted}")
    return value * scales[suffix]


def _quantity(unit: str, **bounds: float) -> Any:
    def read(value: Any) -> float:
        return parse_quantity(value, unit)

    extra: Any = {"unit": unit}
    return Annotated[float, BeforeValidator(read), Field(json_schema_extra=extra, **bounds)]  # type: ignore[call-overload]


Seconds = _quantity("s", ge=0, le=1e6)  # far within what fits into 64 bits of nanoseconds
Hertz = _quantity("Hz", gt=0)
BitRate = _quantity("bit/s", gt=0)
Metres = _quantity("m")
Radians = _quantity("rad")
Kilograms = _quantity("kg", ge=0)
KilogramSquareMetres = _quantity("kg m²", gt=0)
Newtons = _quantity("N")
NewtonMetres = _quantity("N m", ge=0)
Amperes = _quantity("A", ge=0)
Kelvins = _quantity("K")
SignedAmperes = _quantity("A")
SignedNewtonMetres = _quantity("N m")
Volts = _quantity("V", ge=0)
TorquePerRadian = _quantity("N m/rad", ge=0)
TorquePerRate = _quantity("N m s/rad", ge=0)
TorqueRate = _quantity("N m/s", gt=0)
RadiansPerSecond = _quantity("rad/s")
MetresPerSecond = _quantity("m/s")
FrameRate = _quantity("Hz", ge=0, le=1e5)  # 0: none
PartsPerMillion = _quantity("ppm", ge=-1e5, le=1e5)

Probability = Annotated[float, Field(ge=0, le=1)]
Gain = Annotated[float, Field(ge=0)]


class Config(BaseModel):
    """Base of every configuration object: immutable, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
