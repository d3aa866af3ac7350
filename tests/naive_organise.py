"""The slow, obvious twin of the loop in headvox.organise."""

import numpy as np

F = np.float32


def pixel(place):
    """The whole pixel at a place, which is counted from -8192, and whether it is in its middle; None if nowhere."""
    if not 0.0 < place < 2 * 8192:
        return None
    whole = int(F(place + F(0.5)))
    return whole - 8192, abs(F(place - F(whole))) < F(0.25)


def put_into_pixels(points, P, height, width):
    """The image in millimetres, and how many points are in a pixel, between two or behind, and out of the image."""
    image, counts = np.zeros((height, width), np.uint16), [0, 0, 0]
    with np.errstate(all="ignore"):
        for x, y, z in points:
            ahead, right, down = (P[k, 3] + ((P[k, 0] * x + P[k, 1] * y) + P[k, 2] * z) for k in (2, 0, 1))
            millimetres = F(ahead * F(1000.0))
            counts[1] += bool(ahead < 0.0)
            if not 0.5 < millimetres < 1e9:
                continue
            column, row = pixel(F(right / ahead)), pixel(F(down / ahead))
            inside = column and row and 0 <= column[0] < width and 0 <= row[0] < height
            if inside and column[1] and row[1]:
                image[row[0], column[0]] = 65535 if millimetres > 65535 else int(F(millimetres + F(0.5)))
                counts[0] += 1
            elif (column and not column[1]) or (row and not row[1]):
                counts[1] += 1
            else:
                counts[2] += 1
    return image, counts
