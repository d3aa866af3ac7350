import io
import zipfile

import numpy as np
import pytest
from cloud_writers import POINTS, npy, npz

from headvox.errors import HeadvoxError
from headvox.sources.arrays import read_npy, read_npz

RECORDS = np.zeros(4, dtype=[("t", "u8"), ("z", "f8"), ("y", "f4"), ("x", ">f4")])
for column, key in enumerate("xyz"):
    RECORDS[key] = POINTS[:, column]


@pytest.mark.parametrize(
    ("values", "extra"),
    [
        (POINTS, ()),
        (POINTS.astype(np.float64), ()),
        (POINTS.astype(">f8"), ()),
        (POINTS.astype(np.float16), ()),
        (np.asfortranarray(POINTS), ()),
        (np.hstack([POINTS, POINTS[:, :2]]), ("column 3", "column 4")),
        (POINTS.reshape(2, 2, 3), ()),
        (RECORDS, ("t",)),
        (RECORDS.reshape(2, 2), ("t",)),
    ],
)
def test_reads_every_layout(values, extra):
    for cloud in (read_npy(npy(values), "a.npy"), read_npz(npz(anything=values), "a.npz")):
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.points.dtype == np.float32
        assert cloud.points.flags.c_contiguous
        assert cloud.points.flags.writeable
        assert cloud.extra == extra


@pytest.mark.parametrize("compressed", [False, True])
def test_npz_takes_the_only_array_or_points(compressed):
    one = read_npz(npz(compressed, cloud=POINTS), "a.npz")
    named = read_npz(npz(compressed, colours=POINTS * 9, points=POINTS), "a.npz")
    np.testing.assert_array_equal(one.points, POINTS)
    np.testing.assert_array_equal(named.points, POINTS)
    with pytest.raises(HeadvoxError, match="'points', the arrays are: a, b"):
        read_npz(npz(compressed, a=POINTS, b=POINTS), "a.npz")


def test_numbers_beyond_float32_become_nan():
    values = np.array([[1e300, 0.0, 0.0], [1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(read_npy(npy(values), "a.npy").points, [[np.nan] * 3, [1, 2, 3]])


class Trap:
    """Would make itself known if it were ever unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("it was unpickled",))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.array([Trap(), 1], dtype=object), "holds Python objects"),
        (POINTS.astype(np.int32), "expected float32 or float64 points, got int32"),
        (POINTS.astype(complex), "got complex128"),
        (POINTS[:, :2], r"got \(4, 2\)"),
        (POINTS[0], r"got \(3,\)"),
        (np.zeros((480, 640), np.float32), r"got \(480, 640\)"),
        (np.zeros((3, 1000), np.float32), r"got \(3, 1000\)"),
        (np.zeros(3, [("x", "f4"), ("y", "f4")]), "expected the fields x, y, z, got x, y"),
        (np.zeros(3, [("x", "S4"), ("y", "f4"), ("z", "f4")]), "expected x, y, z as numbers"),
    ],
)
def test_other_arrays_are_refused_in_one_line(values, message):
    with pytest.raises(HeadvoxError, match=message) as error:
        read_npy(npy(values), "a.npy")
    assert str(error.value).startswith("a.npy: ")
    assert "\n" not in str(error.value)
    assert error.value.do


def header(shape, descr="'<f4'"):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            header((10**12, 3)) + bytes(2000),
            "promises .1000000000000, 3. of float32, the file has 2000 bytes",
        ),
        (header((-1, 3)) + bytes(12), "promises"),
        (header((10**12, 3), "'|V0'"), "promises"),
        (header((4, 3)) + bytes(47), "promises"),
        (header((4, 3), "(" * 500 + ")" * 500), "not a valid npy header"),
        (header((4, 3), "'" + "x" * 20000 + "'"), "not a valid npy header"),
        (npy()[:20], "not a valid npy header"),
        (b"\x93NUMPY\x09\x00", "not a valid npy header"),
    ],
)
def test_damaged_npy_is_refused(data, message):
    with pytest.raises(HeadvoxError, match=message) as error:
        read_npy(data, "a.npy")
    assert "\n" not in str(error.value)


def test_damaged_npz_is_refused():
    with pytest.raises(HeadvoxError, match="not a valid npz"):
        read_npz(npz(points=POINTS)[:-30], "a.npz")
    with pytest.raises(HeadvoxError, match="the arrays are: none"):
        read_npz(b"PK\x05\x06" + bytes(18), "a.npz")


def test_a_zip_bomb_is_refused_before_it_is_unpacked():
    file = io.BytesIO()
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("points.npy", "w") as member,
    ):
        member.write(header((10**8, 3)))
        for _ in range(40):
            member.write(bytes(1 << 20))
    data = file.getvalue()
    assert len(data) < 100_000
    with pytest.raises(HeadvoxError, match="hold an array of more than"):
        read_npz(data, "a.npz")
