"""What people wear: hair, beards, hats, glasses, masks, headphones and the volume of clothes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SKIN, HAIR, CLOTH, HAT, GLASSES = 0, 1, 2, 3, 4
HAIR_STYLES = ("bald", "short", "bulky", "long", "bun", "ponytail")
HATS = ("none", "beanie", "cap", "helmet", "hood")


@dataclass(frozen=True, slots=True)
class Wear:
    """What somebody wears; lengths in metres.

    ``hair`` is one of HAIR_STYLES with ``hair_m`` its thickness and ``hair_length_m`` how far it hangs;
    ``hair_albedo`` runs from 0 (black) to 1 (white); ``receding`` from 0 to 1 lifts the hairline of the
    forehead and ``fringe`` lowers it. ``beard_m`` and ``scarf_m`` are thicknesses, 0 is none. ``hat`` is one
    of HATS, ``hat_m`` its wall and ``hat_turn_rad`` where a visor points. ``cloth_m`` is how far clothes are
    off the skin; ``sleeves`` and ``trousers`` run from 0 (short) to 1 (long). ``seed`` draws every noise.
    """

    hair: str = "short"
    hair_m: float = 0.008
    hair_length_m: float = 0.0
    hair_albedo: float = 0.2
    receding: float = 0.0
    fringe: float = 0.0
    beard_m: float = 0.0
    hat: str = "none"
    hat_m: float = 0.008
    hat_turn_rad: float = 0.0
    glasses: str = "none"  # none, clear, dark
    mask: bool = False
    headphones: bool = False
    scarf_m: float = 0.0
    backpack: bool = False
    cloth_m: float = 0.01
    sleeves: float = 1.0
    trousers: float = 1.0
    seed: int = 0


NOTHING = Wear(hair="bald", cloth_m=0.0)


def sample_wear(rng: np.random.Generator, sex: float, age_years: float) -> Wear:
    """Draw what a person wears."""
    female = sex > 0.5
    style_shares = (0.02, 0.25, 0.18, 0.30, 0.11, 0.14) if female else (0.16, 0.54, 0.22, 0.04, 0.01, 0.03)
    hair = HAIR_STYLES[int(rng.choice(len(HAIR_STYLES), p=style_shares))]
    thickness = {"short": (0.004, 0.015), "bulky": (0.015, 0.055), "long": (0.008, 0.028)}.get(
        hair, (0.004, 0.014)
    )
    grey = np.clip((age_years - 45.0) / 40.0, 0.0, 1.0) * rng.random()
    adult_man = not female and age_years > 18.0
    beard = rng.random() < 0.45 and adult_man
    hat = HATS[int(rng.choice(len(HATS), p=(0.76, 0.08, 0.08, 0.03, 0.05)))]
    hat_wall = {"helmet": (0.018, 0.04), "hood": (0.012, 0.035)}.get(hat, (0.004, 0.014))
    return Wear(
        hair=hair,
        hair_m=float(rng.uniform(*thickness)),
        hair_length_m=float(rng.uniform(0.12, 0.38)),
        hair_albedo=float(np.clip((1.0 - grey) * rng.beta(1.2, 3.0) + grey * 0.8, 0.02, 0.95)),
        receding=float(rng.beta(0.6, 2.0)) if adult_man else float(0.15 * rng.random()),
        fringe=float(rng.beta(0.7, 2.2 if not female else 1.3)),
        beard_m=float(rng.choice((0.003, 0.008, 0.015, 0.03), p=(0.4, 0.3, 0.2, 0.1))) if beard else 0.0,
        hat=hat,
        hat_m=float(rng.uniform(*hat_wall)),
        hat_turn_rad=float(rng.choice((0.0, np.pi), p=(0.8, 0.2)) + rng.normal(0.0, 0.1)),
        glasses=("none", "clear", "dark")[int(rng.choice(3, p=(0.68, 0.26, 0.06)))],
        mask=bool(rng.random() < 0.06),
        headphones=bool(rng.random() < 0.06) and hat in ("none", "beanie"),
        scarf_m=float(rng.uniform(0.015, 0.04)) if rng.random() < 0.06 else 0.0,
        backpack=bool(rng.random() < 0.08),
        cloth_m=float(0.005 + 0.035 * rng.beta(1.1, 2.2)),
        sleeves=float(rng.choice((0.15, 0.3, 0.6, 1.0), p=(0.1, 0.3, 0.1, 0.5))),
        trousers=float(rng.choice((0.25, 0.5, 1.0), p=(0.1, 0.15, 0.75))),
        seed=int(rng.integers(2**31)),
    )
