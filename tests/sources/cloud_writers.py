"""Writers of small valid files of every kind, independent of the readers, and a slow twin of LZF."""

from __future__ import annotations

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np

POINTS = np.array([[0.0, 0.5, 1.0], [0.25, -0.5, 1.5], [1.0, 2.0, 0.125], [-1.0, 0.75, 1.75]], np.float32)
SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0.05, 0.2, 0]], np.float32)
IDENTITY = np.eye(4).tolist()


def ply(
    points=POINTS, encoding="binary_little_endian", faces=(), extra=True, face_key="vertex_indices", end="\n"
):
    """A PLY file; with extra its vertices have a list and numbers of odd sizes between x, y and z."""
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}[encoding]
    between = (
        ["property uchar red", "property list uchar short weights", "property int8 tag"] if extra else []
    )
    header = ["ply", f"format {encoding} 1.0", "comment made for a test", f"element vertex {len(points)}"]
    header += ["property float x", *between[:1], "property double y", *between[1:], "property float z"]
    if extra:
        header += ["property double quality"]
    if faces:
        header += [f"element face {len(faces)}", "property uchar flag", f"property list uchar int {face_key}"]
    body = b""
    text = []
    for i, (x, y, z) in enumerate(points):
        weights = [7, 8][: i % 3]
        if order:
            body += struct.pack(order + "f", x) + (b"\x09" if extra else b"") + struct.pack(order + "d", y)
            if extra:
                body += struct.pack(f"{order}B{len(weights)}hb", len(weights), *weights, -3)
            body += struct.pack(order + "f", z) + (struct.pack(order + "d", 0.5) if extra else b"")
        else:
            middle = [len(weights), *weights, -3] if extra else []
            row = [x, *([9] if extra else []), y, *middle, z, *([0.5] if extra else [])]
            text.append(
                " ".join(repr(float(v)) if isinstance(v, float | np.floating) else str(v) for v in row)
            )
    for face in faces:
        if order:
            body += struct.pack(f"{order}BB{len(face)}i", 1, len(face), *face)
        else:
            text.append(" ".join(map(str, [1, len(face), *face])))
    head = end.join([*header, "end_header", ""]).encode()
    return head + (body if order else (end.join(text) + end).encode())


def pcd(points=POINTS, encoding="binary", kinds="FFF", sizes=(4, 4, 4), viewpoint="0 0 0 1 0 0 0", size=None):
    """A PCD file with a colour before x, a pair between y and z, and a label at the end."""
    width, height = size or (len(points), 1)
    columns = {
        "rgb": np.arange(len(points), dtype="<u4"),
        **{
            axis: points[:, i].astype(f"<{kind.lower()}{n}")
            for i, (axis, kind, n) in enumerate(zip("xyz", kinds, sizes, strict=True))
        },
    }
    order = ["rgb", "x", "y", "pair", "z", "label"]
    columns["pair"] = np.full((len(points), 2), 0.5, "<f4")
    columns["label"] = np.full(len(points), 3, "<u1")
    numbers = [columns[key].reshape(len(points), -1) for key in order]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(order)}\n"
        f"SIZE {' '.join(str(n.dtype.itemsize) for n in numbers)}\n"
        f"TYPE {' '.join(n.dtype.kind.upper() for n in numbers)}\n"
        f"COUNT {' '.join(str(n.shape[1]) for n in numbers)}\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        rows = [" ".join(f"{v:.9g}" for n in numbers for v in n[i]) for i in range(len(points))]
        return header + "\n".join([*rows, ""]).encode()
    if encoding == "binary":
        return header + b"".join(n[i].tobytes() for i in range(len(points)) for n in numbers)
    plain = b"".join(n.tobytes() for n in numbers)
    packed = lzf_compress(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def lzf_compress(data: bytes) -> bytes:
    """Greedy and slow: the longest earlier match, which may overlap what it makes."""
    out, literal, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for i in range(0, len(literal), 32):
            part = literal[i : i + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literal.clear()

    while at < len(data):
        best, distance = 0, 0
        for start in range(max(0, at - 8192), at):
            n = 0
            while n < 264 and at + n < len(data) and data[start + n] == data[at + n]:
                n += 1
            if n > best:
                best, distance = n, at - start
        if best < 3:
            literal.append(data[at])
            at += 1
            continue
        flush()
        length, back = best - 2, distance - 1
        out.append((min(length, 7) << 5) | (back >> 8))
        if length >= 7:
            out.append(length - 7)
        out.append(back & 255)
        at += best
    flush()
    return bytes(out)


def npy(values=POINTS) -> bytes:
    file = io.BytesIO()
    np.save(file, values, allow_pickle=True)
    return file.getvalue()


def npz(compressed=False, **arrays) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def png(depth: np.ndarray, bits: int = 16, colour: int = 0) -> bytes:
    """A PNG made by hand from an image of unsigned integers, so that its header can say anything."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = depth.shape
    rows = b"".join(b"\0" + row.astype(">u2" if bits == 16 else "u1").tobytes() for row in depth)
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def depth_image(seed: int = 0, width: int = 8, height: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 5000, (height, width), dtype=np.uint16)


def camera(**changes):
    entry = {"width": 8, "height": 6, "fx": 7.0, "fy": 7.5, "cx": 3.5, "cy": 2.5, "depth_scale": 0.001}
    return {**entry, "T_world_camera": [list(row) for row in IDENTITY], **changes}


def recording(folder: Path, frames: int = 3, **changes) -> dict:
    """Write a recording of two cameras; the right one drops out of frame 1."""
    content = {
        "format": "headvox-recording",
        "version": 1,
        "cameras": {"left": camera(), "right": camera(fx=9.0)},
        "frames": [
            {
                "stamp_ns": i * 100_000_000,
                "depth": {
                    side: f"{side}/{i:06d}.png"
                    for side in ("left", "right")
                    if not (side == "right" and i == 1)
                },
            }
            for i in range(frames)
        ],
        **changes,
    }
    for i in range(frames):
        for n, side in enumerate(("left", "right")):
            (folder / side).mkdir(parents=True, exist_ok=True)
            (folder / side / f"{i:06d}.png").write_bytes(png(depth_image(10 * i + n)))
    write_json(folder, content)
    return content


def write_json(folder: Path, content: object) -> None:
    (folder / "recording.json").write_text(json.dumps(content))
