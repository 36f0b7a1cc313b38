"""What a fabric laboratory measures, in SI, KES and FAST units, and some published fabrics.

                      SI                 KES-F                               FAST
    areal density     kg/m^2             W  mg/cm^2                          W   g/m^2
    stretch C         N/m                EMT %  at 500 gf/cm                 E100 %  at 100 gf/cm
    shear C33         N/m per radian     G  gf/(cm degree)                   EB5 %  on the bias at 5 gf/cm, G = 123 / EB5
    bending B         N m                B  gf cm^2/cm                       c  bending length in mm, B = 9.81e-12 W c^3

with 1 gf = 9.80665e-3 N. A stretch stiffness of KES or FAST is the chord's, load over extension. In KES and FAST an array of two is (warp,
weft).

Source: Kawabata (1980), The Standardization and Analysis of Hand Evaluation, for KES; CSIRO's FAST manual for FAST and its constants 123
and 9.81; Wang, O'Brien and Ramamoorthi (2011), "Data-driven elastic models for cloth: modeling and measurement", for the fabrics, with
the numbers of ARCSim's files of materials.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, positive

GRAM_FORCE = 9.80665e-3  # [N]
PER_CM = GRAM_FORCE / 1e-2  # gf/cm in N/m
KES_LOAD, FAST_LOAD = 500 * PER_CM, 100 * PER_CM  # [N/m] at which extension is read
KES_BENDING = GRAM_FORCE * 1e-4 / 1e-2  # gf cm^2/cm in N m
KES_SHEAR = PER_CM * 180 / np.pi  # gf/(cm degree) in N/m per radian
FAST_SHEAR = 123.0  # G EB5, in N/m and percent
FAST_BENDING = 9.81e-12  # B / (W c^3), in N m, g/m^2 and mm


class Material(Protocol):
    """What can say of which fabric it is: `Fabric`, `KES`, `FAST`, `INTERLOCK`."""

    def fabric(self) -> Fabric:
        """In SI units."""
        ...


class Fabric(eqx.Module):
    """A fabric in SI units. Warp runs along x, weft along y.

    Attributes:
        density: [kg/m^2].
        stretch: (2,) C11 and C22 of warp and weft [N/m]: load over extension, the other direction held.
        shear: C33 [N/m]: load over the angle of shear.
        bending: (2,) B of warp and weft [N m]: moment per width over curvature, bent along warp and along weft.
        coupling: C12 [N/m], or None where it was not measured. Springs cannot be given one.

    Raises:
        ValueError: what is not above zero, or has another shape; a coupling that lets the fabric stretch by itself.

    >>> cotton = Fabric(density=0.15, stretch=(900.0, 500.0), shear=40.0, bending=3e-5)
    >>> print(cotton.bending)
    [3.e-05 3.e-05]
    """

    density: Array
    stretch: Array
    shear: Array
    bending: Array
    coupling: Array | None

    def __init__(self, density: Numbers, stretch: Numbers, shear: Numbers, bending: Numbers, coupling: Numbers | None = None):
        """Check what is given.

        Args:
            density: [kg/m^2].
            stretch: [N/m], one number or (warp, weft).
            shear: [N/m] per radian.
            bending: [N m], one number or (warp, weft).
            coupling: C12 [N/m]; None: not known.
        """
        given = _one("density", density), _two("stretch", stretch), _one("shear", shear), _two("bending", bending)
        self.density, self.stretch, self.shear, self.bending = _of_one_type(*given)
        self.coupling = None if coupling is None else as_inexact("coupling", coupling, self.stretch.dtype)
        if self.coupling is not None:
            has_shape("coupling", self.coupling, {"one number": ()})
            finite("coupling", self.coupling)
            spare = self.stretch[0] * self.stretch[1] - self.coupling * self.coupling
            positive("C11 C22 - coupling^2", spare, "Some stretch would set energy free.")

    def fabric(self) -> Fabric:
        """The fabric itself."""
        return self


class KES(eqx.Module):
    """A fabric as the Kawabata system reports it.

    Attributes:
        weight: W [mg/cm^2].
        extension: (2,) EMT [%] at 500 gf/cm, warp and weft.
        shear: G [gf/(cm degree)].
        bending: (2,) B [gf cm^2/cm].

    >>> wool = KES(weight=18.0, extension=(4.0, 6.0), shear=0.6, bending=(0.1, 0.08))
    >>> [f"{1e6 * b:.2f} uN m" for b in wool.fabric().bending], KES.of(wool.fabric()).extension.round(4).tolist()
    (['9.81 uN m', '7.85 uN m'], [4.0, 6.0])
    """

    weight: Array
    extension: Array
    shear: Array
    bending: Array

    def __init__(self, weight: Numbers, extension: Numbers, shear: Numbers, bending: Numbers):
        given = _one("weight", weight), _two("extension", extension), _one("shear", shear), _two("bending", bending)
        self.weight, self.extension, self.shear, self.bending = _of_one_type(*given)

    def fabric(self) -> Fabric:
        """In SI units."""
        return Fabric(self.weight * 1e-2, KES_LOAD / (self.extension * 1e-2), self.shear * KES_SHEAR, self.bending * KES_BENDING)

    @classmethod
    def of(cls, material: Material) -> Self:
        """Any fabric in these units, as if its stretch were linear."""
        f = material.fabric()
        return cls(f.density * 1e2, KES_LOAD / f.stretch * 1e2, f.shear / KES_SHEAR, f.bending / KES_BENDING)


class FAST(eqx.Module):
    """A fabric as FAST (fabric assurance by simple testing) reports it.

    Attributes:
        weight: W [g/m^2].
        extension: (2,) E100 [%] at 100 gf/cm, warp and weft.
        bias: EB5 [%], extension on the bias at 5 gf/cm.
        bending_length: (2,) c [mm].

    >>> shirt = FAST(weight=120.0, extension=(1.5, 3.0), bias=2.4, bending_length=(18.0, 16.0))
    >>> [f"{1e6 * b:.2f} uN m" for b in shirt.fabric().bending]
    ['6.87 uN m', '4.82 uN m']
    """

    weight: Array
    extension: Array
    bias: Array
    bending_length: Array

    def __init__(self, weight: Numbers, extension: Numbers, bias: Numbers, bending_length: Numbers):
        given = _one("weight", weight), _two("extension", extension), _one("bias", bias), _two("bending_length", bending_length)
        self.weight, self.extension, self.bias, self.bending_length = _of_one_type(*given)

    def fabric(self) -> Fabric:
        """In SI units."""
        bending = FAST_BENDING * self.weight * self.bending_length**3
        return Fabric(self.weight * 1e-3, FAST_LOAD / (self.extension * 1e-2), FAST_SHEAR / self.bias, bending)

    @classmethod
    def of(cls, material: Material) -> Self:
        """Any fabric in these units, as if its stretch were linear."""
        f = material.fabric()
        weight = f.density * 1e3
        return cls(weight, FAST_LOAD / f.stretch * 1e2, FAST_SHEAR / f.shear, jnp.cbrt(f.bending / (FAST_BENDING * weight)))


@dataclass(frozen=True)
class Published:
    """A fabric that was measured and published, as plain numbers.

    The source has C33 as the shear stress over the tensor's shear strain, half the angle; a `Fabric` has it over the angle: half of `c33`.

    Attributes:
        name: as the source has it.
        density: [kg/m^2].
        c11: of the first direction, taken as warp [N/m], at small strain.
        c12: between both [N/m].
        c22: of the second one, taken as weft [N/m].
        c33: of shear, over half the angle [N/m].
        bending: [N m] at small curvature, on the bias by 0, 22.5, 45, 67.5 and 90 degrees.
    """

    name: str
    density: float
    c11: float
    c12: float
    c22: float
    c33: float
    bending: tuple[float, float, float, float, float]

    def fabric(self) -> Fabric:
        """In SI units, with the bending of 0 and of 90 degrees."""
        return Fabric(self.density, (self.c11, self.c22), 0.5 * self.c33, (self.bending[0], self.bending[-1]), self.c12)


INTERLOCK = Published(
    "gray interlock (60 % cotton, 40 % polyester; a T-shirt)",
    *(0.187, 16.593832, -14.69599, 34.477123, 36.860302),
    (23.191698e-6, 32.932217e-6, 34.406498e-6, 39.01442e-6, 23.382786e-6),
)
DENIM = Published(
    "11 oz black denim (jeans)",
    *(0.324, 205.352005, 10.234077, 1013.88629, 53.387184),
    (64.196457e-6, 60.286175e-6, 60.943428e-6, 62.433697e-6, 19.824701e-6),
)
SWIM_KNIT = Published(
    "white swim solid (a knit for swimsuits)",
    *(0.204, 47.971176, 6.834521, 104.615456, 60.773663),
    (60.237942e-6, 56.357208e-6, 69.698593e-6, 55.305969e-6, 34.705532e-6),
)


def _one(name: str, value: Numbers) -> Array:
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": ()})
    positive(name, value, "Every fabric has some.")
    return value


def _two(name: str, value: Numbers) -> Array:
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": (), "(warp, weft)": (2,)})
    positive(name, value, "Every fabric has some.")
    return jnp.broadcast_to(value, (2,))


def _of_one_type(*arrays: Array) -> tuple[Array, ...]:
    """In the widest of their types."""
    dtype = np.result_type(*(a.dtype for a in arrays))
    return tuple(a.astype(dtype) for a in arrays)


__all__ = ["DENIM", "FAST", "INTERLOCK", "KES", "SWIM_KNIT", "Fabric", "Material", "Published"]
