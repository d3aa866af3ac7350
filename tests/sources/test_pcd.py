import numpy as np
import pytest
from cloud_writers import POINTS, lzf_compress, pcd
from hypothesis import given
from hypothesis import strategies as st

from headvox.errors import HeadvoxError
from headvox.sources import lzf
from headvox.sources.pcd import read_pcd

ENCODINGS = ["ascii", "binary", "binary_compressed"]
MANY = np.tile(POINTS, (50, 1))


@pytest.mark.parametrize(("kinds", "sizes"), [("FFF", (4, 4, 4)), ("FFF", (8, 8, 8)), ("FIF", (8, 2, 4))])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_reads_points_among_other_fields(encoding, kinds, sizes):
    points = np.round(POINTS) if "I" in kinds else POINTS
    cloud = read_pcd(pcd(points, encoding, kinds, sizes), "a.pcd")
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.points.dtype == np.float32
    assert cloud.points.flags.c_contiguous
    assert cloud.T_world_sensor is None
    assert cloud.extra == ("rgb", "pair", "label")
    assert cloud.format == "pcd, " + encoding.replace("_", " ")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_organised_cloud_with_holes(encoding):
    points = MANY.copy()
    points[7] = np.nan
    cloud = read_pcd(pcd(points, encoding, size=(20, 10)), "a.pcd")
    np.testing.assert_array_equal(cloud.points, points)


def test_a_viewpoint_places_the_sensor():
    half = np.sqrt(0.5)
    cloud = read_pcd(pcd(viewpoint=f"1 2 3 {half} 0 0 {half}"), "a.pcd")  # a quarter turn about z
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(cloud.T_world_sensor, expected, atol=1e-9)


def test_padding_is_left_out_of_compressed_files():
    data = pcd(MANY, "binary_compressed")
    padded = data.replace(b"FIELDS rgb x y pair z label", b"FIELDS rgb x y pair z label _")
    padded = padded.replace(b"SIZE 4 4 4 4 4 1", b"SIZE 4 4 4 4 4 1 3")
    with pytest.raises(HeadvoxError, match="7 FIELDS, 7 SIZE, 6 TYPE"):
        read_pcd(padded, "a.pcd")
    padded = padded.replace(b"1 3\n", b"1 4\n").replace(b"TYPE U F F F F U", b"TYPE U F F F F U U")
    padded = padded.replace(b"COUNT 1 1 1 2 1 1", b"COUNT 1 1 1 2 1 1 5")
    np.testing.assert_array_equal(read_pcd(padded, "a.pcd").points, MANY)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_field_of_count_0_takes_no_room(encoding):
    data = pcd(MANY, encoding)
    with_empty = data.replace(b"FIELDS rgb x y pair z label", b"FIELDS rgb x y pair z label nothing")
    with_empty = with_empty.replace(b"SIZE 4 4 4 4 4 1", b"SIZE 4 4 4 4 4 1 4")
    with_empty = with_empty.replace(b"TYPE U F F F F U", b"TYPE U F F F F U F")
    with_empty = with_empty.replace(b"COUNT 1 1 1 2 1 1", b"COUNT 1 1 1 2 1 1 0")
    assert len(with_empty) > len(data)
    np.testing.assert_array_equal(read_pcd(with_empty, "a.pcd").points, read_pcd(data, "a.pcd").points)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"DATA binary", b"DATA zipped", "DATA 'zipped'"),
        (b"FIELDS rgb x y", b"FIELDS rgb x w", "expected one field 'y'"),
        (b"FIELDS rgb x y pair", b"FIELDS rgb x x pair", "expected one field 'x'"),
        (b"SIZE 4 4", b"SIZE 4", "6 FIELDS, 5 SIZE"),
        (b"SIZE 4 4", b"SIZE 4 3", "TYPE F and SIZE 3"),
        (b"SIZE 4 4", b"SIZE 4 four", "SIZE 'four', expected a whole number"),
        (b"COUNT 1 1 1 2", b"COUNT 1 1 1 999999999", "a point has more than 1048576 bytes"),
        (b"POINTS 4", b"POINTS 5", "expected WIDTH times HEIGHT to be POINTS"),
        (
            b"WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4",
            b"POINTS 1000000000000",
            "promises 1000000000000",
        ),
        (b"WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4", b"", "expected WIDTH times HEIGHT"),
        (b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 0 0 0 0 0 0 0", "VIEWPOINT has the norm 0"),
        (b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT nan 0 0 1 0 0 0", "NaN or infinite"),
        (b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 0 0 0 1", "expected seven numbers"),
    ],
)
def test_bad_headers_are_refused_in_one_line(old, new, message):
    data = pcd()
    assert old in data
    with pytest.raises(HeadvoxError, match=message) as error:
        read_pcd(data.replace(old, new), "a.pcd")
    assert str(error.value).startswith("a.pcd: ")
    assert "\n" not in str(error.value)
    assert error.value.do


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncated_bodies_are_refused(encoding):
    with pytest.raises(HeadvoxError, match=r"a\.pcd: "):
        read_pcd(pcd(MANY, encoding)[:-12], "a.pcd")


def test_a_column_that_the_header_does_not_name_is_refused():
    lines = pcd(MANY, "ascii").split(b"\n")
    body = lines.index(b"DATA ascii") + 1
    wider = b"\n".join([*lines[:body], *(line + b" 0.5" if line.strip() else line for line in lines[body:])])
    with pytest.raises(HeadvoxError, match="the header promises 1400 numbers, the body has 1600"):
        read_pcd(wider, "a.pcd")


def test_a_body_that_unpacks_to_gigabytes_is_refused():
    data = pcd(MANY, "binary_compressed").replace(b"WIDTH 200", b"WIDTH 100000000")
    data = data.replace(b"POINTS 200", b"POINTS 100000000")
    with pytest.raises(HeadvoxError, match=r"expected .* to unpack to 2500000000"):
        read_pcd(data, "a.pcd")
    with pytest.raises(ValueError, match="cannot hold"):
        lzf.decompress(bytes(100), 4_000_000_000)


@given(st.binary(max_size=300).map(lambda b: b * 3) | st.binary(max_size=60))
def test_lzf_gives_back_what_was_packed(data):
    assert lzf.decompress(lzf_compress(data), len(data)) == data


def test_lzf_reads_what_liblzf_wrote():
    assert lzf.decompress(LIBLZF, len(PLAIN)) == PLAIN


@pytest.mark.parametrize(
    ("packed", "size"),
    [
        (b"\x20\x00", 3),
        (b"\x00a\xe0", 20),
        (b"\x05ab", 6),
        (b"\x00a", 2),
        (b"\x01ab", 1),
        (b"\x00a\x20\x09", 4),
    ],
)
def test_lzf_refuses_what_is_damaged(packed, size):
    with pytest.raises(ValueError, match=r".+"):
        lzf.decompress(packed, size)


PLAIN = b"head" * 100 + bytes(range(40)) + b"headvox" * 3
LIBLZF = bytes.fromhex(
    "046865616468e0ff03e17a071f000102030405060708090a0b0c0d0e0f101112"
    "131415161718191a1b1c1d1e1f07202122232425262740ab02766f78e0030601"
    "6f78"
)
