import numpy as np
import pytest

from headvox.machine.kernels import kernel
from headvox.slabs import ONE_SLAB, Slabs, cut, shares_of, slice_of


@kernel
def places(slices, seams, overlap, out):
    for k in range(slices.shape[0]):
        out[k] = slice_of(slices[k], seams, overlap)


def placed(slices, slabs):
    out = np.empty(len(slices), np.int64)
    places(np.asarray(slices, np.int32), slabs.seams, slabs.overlap, out)
    return out


@pytest.mark.parametrize("threads", [1, 2, 3, 50])
@pytest.mark.parametrize("slices", [1, 6, 13, 40])
def test_a_slab_holds_all_that_boxes_about_its_voxels_reach(threads, slices):
    slabs = cut(slices, -2, 4, threads)
    assert len(slabs.each) == max(1, min(threads, slices // 6))
    ends = [0, *(slab.end for slab in slabs.each)]
    assert [slab.first for slab in slabs.each] == ends[:-1]
    assert ends[-1] == slices
    stops = [slab.slices.stop for slab in slabs.each]
    assert stops == [*(slab.slices.start for slab in slabs.each[1:]), slabs.slices]
    for slab in slabs.each:
        # In slices of the volume, the first of which is the farthest that a box about the first voxel reaches.
        voxels = np.arange(slab.first, slab.end) + 2
        at = placed(voxels, slabs)
        np.testing.assert_array_equal(at - slab.slices.start, voxels - slab.shift[0])
        assert at[0] - 2 == slab.slices.start
        assert at[-1] + 4 < slab.slices.stop


def test_shares_are_nearly_equal_and_nobody_gets_none():
    assert shares_of(7, 3) == [(0, 0, 3), (1, 3, 5), (2, 5, 7)]
    assert shares_of(2, 3) == [(0, 0, 1), (1, 1, 2)]
    assert shares_of(0, 3) == []


def test_a_volume_that_is_not_cut_is_as_it_is():
    np.testing.assert_array_equal(placed([0, 3, 99], Slabs((), *ONE_SLAB)), [0, 3, 99])
