"""The slow, obvious twin of headvox.relief."""

import math

import numpy as np

FARTHEST_MM, LARGEST_MM, ON_HEAD_MM, NEAREST_M = 600, 32_000, 200, 0.1


def measured(image, place):
    """How many mm farther than ``place`` the surface is that its pixel sees; None if nobody knows."""
    x, y, z = (np.linalg.inv(image.T_world_camera) @ [*place, 1.0])[:3]
    if z <= NEAREST_M:
        return None
    lens = image.intrinsics
    column = math.floor(lens.fx * x / z + lens.cx + 0.5)
    row = math.floor(lens.fy * y / z + lens.cy + 0.5)
    if not (0 <= column < lens.width and 0 <= row < lens.height) or image.depth[row, column] == 0:
        return None
    beyond = math.floor(1000.0 * (image.depth[row, column] * lens.depth_scale - z) + 0.5)
    return max(-FARTHEST_MM, min(FARTHEST_MM, beyond))


def of_spot(image, centre, right, up, side, above):
    """The lower median of the nine places about a spot, 1 cm apart; None if nothing is known of any."""
    places = [
        centre + (side + 0.01 * i) * right + (above + 0.01 * j) * up for i in (-1, 0, 1) for j in (-1, 0, 1)
    ]
    known = sorted(value for value in (measured(image, place) for place in places) if value is not None)
    return known[(len(known) - 1) // 2] if known else None


def in_mm(metres):
    return max(-LARGEST_MM, min(LARGEST_MM, math.floor(1000.0 * metres + 0.5)))


def seen_by(image, centre, spots):
    """What one camera sees of the spots, nearer and farther side, and where it stands; how much of a head that is."""
    ray = centre - image.T_world_camera[:3, 3]
    away = np.linalg.norm(ray)
    if away < NEAREST_M:
        return None, 0.0
    right = np.array([ray[1], -ray[0], 0.0])
    level = np.linalg.norm(right)
    right = right / level if level > 1e-3 * away else np.array([1.0, 0.0, 0.0])
    up = np.cross(right, ray / away)
    relief, on = [], 0
    for side, above in spots:
        both = [of_spot(image, centre, right, up, sign * side, above) for sign in (1, -1)]
        known = [value for value in both if value is not None]
        on += sum(abs(value) <= ON_HEAD_MM for value in known)
        relief += [min(known), max(known)] if known else [0, 0]
    return [*relief, in_mm(away), in_mm(ray[2] / away)], on / away


def relief_about(images, centres, radii, spots):
    """The relief as the camera has it that sees most of a head; zeros where none sees anything of one; and sizes."""
    table = np.zeros((len(centres), 2 * len(spots) + 4), np.int16)
    for i, centre in enumerate(centres):
        best = 0.0
        for image in images:
            relief, on = seen_by(image, centre, spots)
            if on > best:
                table[i, :-2], best = relief, on
        table[i, -2:] = in_mm(centre[2]), in_mm(radii[i])
    return table


def gain(relief_mm, source, lacking):
    """What the trees of ``source`` (headvox.masks.cascade.Relief) say of one row, in steps of 1/1024.

    One that is ``lacking`` more than the reach after the first trees is given up.
    """
    names = [f"{spot.name}.{side}" for spot in source.spots for side in ("near", "far")]
    names += ["range", "rise", "height", "radius"]
    metres = {name: value / 1000.0 for name, value in zip(names, relief_mm.tolist(), strict=True)}

    def leaf(tree):
        while isinstance(tree, tuple):
            name, cut, at_most, above = tree
            tree = at_most if metres[name] <= cut else above
        return round(1024 * tree)

    most = math.floor(1024 * source.most)

    def limited(total):
        return max(-most, min(most, total))

    first = limited(sum(leaf(tree) for tree in source.trees[: source.first]))
    if first / 1024 + source.reach < lacking / 1024:
        return first
    return limited(sum(leaf(tree) for tree in source.trees))
