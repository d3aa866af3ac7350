import numpy as np
import pytest
from cloud_writers import POINTS, SQUARE, ply

from headvox.errors import HeadvoxError
from headvox.sources.ply import read_ply

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
POLYGONS = [(0, 1, 2, 3), (3, 2, 4), (0, 1, 2, 4, 3)]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_reads_points_among_other_properties(encoding, extra, end):
    cloud = read_ply(ply(encoding=encoding, extra=extra, end=end), "a.ply")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.points.dtype == np.float32
    assert cloud.points.flags.c_contiguous
    assert cloud.T_world_sensor is None
    assert (cloud.vertices, cloud.faces) == (4, 0)
    assert cloud.extra == (("red", "weights", "tag", "quality") if extra else ())
    assert cloud.format == "ply, " + encoding.replace("_", " ")


def test_old_macs_ended_lines_with_a_carriage_return():
    np.testing.assert_array_equal(read_ply(ply(encoding="ascii", end="\r"), "a.ply").points, POINTS)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("face_key", ["vertex_indices", "vertex_index"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_faces_of_any_size_are_a_surface(encoding, face_key, extra):
    cloud = read_ply(ply(SQUARE, encoding, POLYGONS, extra, face_key), "a.ply")
    assert (cloud.vertices, cloud.faces) == (5, 3)
    np.testing.assert_array_equal(cloud.points[:5], SQUARE)
    samples = cloud.points[5:]
    assert len(samples) > 2 * 0.1 * 0.1 / 0.008**2  # two layers of the square
    assert np.ptp(samples, axis=0) == pytest.approx([0.1, 0.2, 0.0], abs=0.02)
    same = read_ply(ply(SQUARE, "ascii", POLYGONS), "b.ply").points
    np.testing.assert_array_equal(np.unique(cloud.points, axis=0), np.unique(same, axis=0))


def test_rows_alike_and_rows_of_different_length_read_the_same():
    triangles = [(0, 1, 2), (0, 2, 3)]
    alike = read_ply(ply(SQUARE, faces=triangles), "a.ply").points
    mixed = read_ply(ply(SQUARE, faces=[*triangles, (4,)]), "a.ply").points
    np.testing.assert_array_equal(alike, mixed)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_faces_without_corners_are_passed_over(encoding):
    plain = read_ply(ply(SQUARE, encoding, [(0, 1, 2)]), "a.ply")
    for faces in ([(0, 1, 2), ()], [(), (0, 1, 2)], [(0, 1, 2), (4,), ()]):
        cloud = read_ply(ply(SQUARE, encoding, faces), "a.ply")
        assert cloud.faces == len(faces)
        np.testing.assert_array_equal(cloud.points, plain.points)
    np.testing.assert_array_equal(read_ply(ply(SQUARE, encoding, [()]), "a.ply").points, SQUARE)


def test_elements_before_and_after_are_passed_over():
    before = b"ply\nformat ascii 1.0\nelement camera 2\nproperty list uchar float view\nelement vertex 1\n"
    before += (
        b"property float x\nproperty float y\nproperty float z\nelement edge 7\nproperty int a\nend_header\n"
    )
    cloud = read_ply(before + b"3 9 9 9\n0\n0.5 0.25 1\n", "a.ply")
    np.testing.assert_array_equal(cloud.points, [[0.5, 0.25, 1.0]])


def test_what_is_not_finite_becomes_nan_as_a_whole():
    points = np.array([[0, 0, 1], [np.nan, 1, 1], [1, np.inf, 1]])
    cloud = read_ply(ply(points, "ascii"), "a.ply")
    assert np.isnan(cloud.points).all(axis=1).tolist() == [False, True, True]


HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex %s\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"ply\nformat ascii 1.0\n", "no end_header"),
        (b"ply\nend_header\n", "format is 'missing'"),
        (b"ply\nformat binary 1.0\nend_header\n", "format is 'binary'"),
        (HEAD % b"-1" + XYZ + b"end_header\n", "header has the line 'element vertex -1'"),
        (HEAD % b"1" + b"property vec3 x\nend_header\n", "type 'vec3'"),
        (HEAD % b"1" + b"property list float int x\nend_header\n", "length of a list is a float"),
        (HEAD % b"1" + b"property float x\nend_header\n" + bytes(4), "no 'y'"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no element 'vertex'"),
        (HEAD % b"0" + XYZ + b"end_header\n", "empty"),
        (HEAD % b"2" + XYZ + b"end_header\n" + bytes(23), "promises 2 rows of 'vertex', the file has less"),
        (HEAD % b"999999999999" + XYZ + b"end_header\n" + bytes(2000), "promises 999999999999 rows"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n" + XYZ + b"end_header\n1 2 three\n", "not a number"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\n" + XYZ + b"end_header\n1 2 3 .5\n4 5 6 .5\n",
            "promises 6 numb",
        ),
        (ply(SQUARE, faces=[(0, 1, 9)]), "names vertex 9, expected 0 to 4"),
        (ply(SQUARE, faces=[(0, 1, -2)]), "names vertex -2, expected 0 to 4"),
        (ply(SQUARE, "ascii", faces=POLYGONS)[:-6], "promises 3 rows of 'face'"),
        (ply(SQUARE, faces=POLYGONS)[:-1], "promises 3 rows of 'face'"),
        (ply(POINTS * np.nan), "all 4 points are NaN"),
        (ply(POINTS * 1000), "millimetres"),
    ],
)
def test_bad_files_are_refused_in_one_line(data, message):
    with pytest.raises(HeadvoxError, match=message) as error:
        read_ply(data, "a.ply")
    assert str(error.value).startswith("a.ply: ")
    assert "\n" not in str(error.value)
    assert error.value.do


def test_a_list_that_claims_more_than_the_file_is_refused():
    data = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + XYZ
    data += b"element face 2\nproperty list int int vertex_indices\nend_header\n" + bytes(12)
    with pytest.raises(HeadvoxError, match="promises 2 rows of 'face'"):
        read_ply(data + b"\xff\xff\xff\x7f" * 2, "a.ply")
    with pytest.raises(HeadvoxError, match="promises 2 rows of 'face'"):
        read_ply(data + b"\xff\xff\xff\xff" * 2, "a.ply")
