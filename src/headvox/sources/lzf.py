"""LZF, the compression inside binary_compressed PCD files."""

from __future__ import annotations

MOST_EXPANSION = 88  # the longest copy, 264 bytes, takes 3 bytes


def decompress(data: bytes, size: int) -> bytes:
    """Return exactly ``size`` bytes.

    A byte below 32 is followed by that many bytes and one more, as they are. Any other begins a copy of what
    lies some way back in the output: three bits of length (7: another byte follows), then 13 bits of
    distance.

    Raises:
        ValueError: the data do not decompress to ``size`` bytes.
    """
    if size > MOST_EXPANSION * len(data):
        raise ValueError(f"{len(data)} bytes cannot hold {size}")
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            distance = ((control & 31) << 8 | data[at]) + 1
            at += 1
            start = len(out) - distance
            if start < 0:
                raise ValueError("a copy from before the beginning")
            if distance >= length:
                out += out[start : start + length]
            else:  # it copies its own output
                out += (bytes(out[start:]) * (length // distance + 1))[:length]
    except IndexError:
        raise ValueError("the data end within a copy") from None
    if at > end or len(out) != size:
        raise ValueError(f"expected {size} bytes, got {len(out)}")
    return bytes(out)
