"""The units that files hold properties in, where these are not SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

Plausibility = Literal["refuse", "warn", "off"]
"""What becomes of values that no material has, see `slatprep.readers.plausible`."""

LOG10 = "log10 "
"""What a unit begins with where a file holds the logarithm of the value."""

FACTORS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "kg/m^3": 1.0, "g/cm^3": 1e3}
"""What a value in a unit is multiplied by to be in SI units."""


@dataclass(frozen=True)
class Units:
    """Units of the values in the files of a source; empty where nobody stated them.

    Attributes
    ----------
    youngs_modulus, density : str
        Unit of each. What is stated is not asked about.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    youngs_modulus: Literal["", "Pa", "kPa", "MPa", "GPa", "log10 Pa"] = ""
    density: Literal["", "kg/m^3", "g/cm^3", "log10 kg/m^3"] = ""

    def of(self, name: str) -> str:
        """Return the stated unit of a property; empty where there is none."""
        return str(getattr(self, name, ""))
