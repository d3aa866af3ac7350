"""A body and what it wears -> one mesh, skinned with the body, so that it follows every pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I32
from headvox.synth.bodies import RestBody, load_basis
from headvox.synth.clothes import clothe
from headvox.synth.headwear import (
    backpack_piece,
    glasses_pieces,
    hair_pieces,
    hat_pieces,
    headphone_pieces,
    mask_piece,
    scarf_piece,
)
from headvox.synth.pieces import HeadField, Piece
from headvox.synth.wear import Wear


@dataclass(frozen=True, slots=True)
class Outfit:
    """A dressed body at rest.

    ``vertices`` (V, 3), ``skin_joints`` and ``skin_weights`` (V, 4), ``faces`` (F, 3), ``materials`` (F,).
    """

    vertices: F64
    skin_joints: I32
    skin_weights: F64
    faces: I32
    materials: npt.NDArray[np.uint8]


def dress(body: RestBody, wear: Wear) -> Outfit:
    """Dress a rest body: clothes and beard move its skin outwards, the rest is added."""
    basis = load_basis()
    rng = np.random.default_rng(wear.seed)
    head = HeadField(body)
    vertices, materials = clothe(body, wear, rng)
    pieces: list[Piece] = []
    if wear.hair != "bald":
        pieces += hair_pieces(body, vertices, head, wear, rng)
    if wear.hat != "none":
        pieces += hat_pieces(body, vertices, head, wear)
    if wear.glasses != "none":
        pieces += glasses_pieces(body, wear.glasses == "dark")
    if wear.mask:
        pieces.append(mask_piece(head))
    if wear.headphones:
        pieces += headphone_pieces(body, head, wear)
    if wear.scarf_m > 0.0:
        pieces.append(scarf_piece(body, vertices, wear))
    if wear.backpack:
        pieces.append(backpack_piece(body, vertices, wear))
    return _assemble(vertices, materials, pieces, basis.joint("head"), basis.joint("spine01"))


def _assemble(
    vertices: F64, materials: npt.NDArray[np.uint8], pieces: list[Piece], head: int, chest: int
) -> Outfit:
    basis = load_basis()
    points, joints, weights = [vertices], [basis.skin_joints], [basis.skin_weights]
    faces, kinds = [basis.faces], [materials]
    start = len(vertices)
    for piece in pieces:
        n = len(piece.vertices)
        share = np.zeros(n) if piece.follows_chest is None else piece.follows_chest
        points.append(piece.vertices)
        joints.append(np.tile(np.array([head, chest, head, head], dtype=np.int32), (n, 1)))
        weights.append(np.column_stack([1.0 - share, share, np.zeros(n), np.zeros(n)]))
        faces.append((piece.faces + start).astype(np.int32))
        kinds.append(np.full(len(piece.faces), piece.material, dtype=np.uint8))
        start += n
    return Outfit(
        np.concatenate(points),
        np.concatenate(joints),
        np.concatenate(weights),
        np.concatenate(faces),
        np.concatenate(kinds),
    )
