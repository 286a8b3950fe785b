"""What two processes hand each other through shared memory."""

from __future__ import annotations

import io
import os
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.pipeline import handover
from scanmap.pipeline.handover import Shared, shared_file


def mapped(slots: int) -> Shared:
    file = shared_file(slots)
    if file is None:
        pytest.skip("this system has no files in memory")
    shared = Shared(file)
    os.close(file)  # what is mapped stays
    return shared


@pytest.fixture(params=["memory", "pipe"])
def shared(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Shared:
    monkeypatch.setattr(handover, "SLOT_BYTES", 1 << 16)
    return mapped(2) if request.param == "memory" else Shared(None)


@settings(max_examples=40)
@given(
    sizes=st.lists(st.integers(0, 30_000), max_size=6),
    images=st.lists(st.binary(max_size=300).map(lambda data: data * 150), max_size=4),
)
def test_values_come_back_as_they_were_whether_they_fit_or_not(sizes: list[int], images: list[bytes]) -> None:
    rng = np.random.default_rng(len(sizes))
    arrays = [rng.integers(0, 255, (size, 2)).astype(np.uint8)[:, k % 2 :] for k, size in enumerate(sizes)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(handover, "SLOT_BYTES", 1 << 16)
        for shared in (mapped(2), Shared(None)):
            pipe = io.BytesIO()
            shared.dump((arrays, [pickle.PickleBuffer(data) for data in images], None, 1.5), pipe, 1)
            pipe.seek(0)
            got, pictures, nothing, number = shared.load(pipe)
            assert (nothing, number, pictures) == (None, 1.5, images)
            assert all(type(data) is bytes for data in pictures)
            assert len(got) == len(arrays)
            for own, other in zip(got, arrays, strict=True):
                np.testing.assert_array_equal(own, other)
                assert own.dtype == np.uint8


def test_two_values_on_their_way_do_not_meet_and_what_was_read_stays(shared: Shared) -> None:
    pipe, values = io.BytesIO(), [np.full(8000, k, np.int32) for k in range(4)]
    shared.dump(values[0], pipe, 0)
    shared.dump(values[1], pipe, 1)
    pipe.seek(0)
    first = shared.load(pipe)
    at = pipe.tell()
    pipe.seek(0, io.SEEK_END)
    shared.dump(values[2], pipe, 0)
    pipe.seek(at)
    second, third = shared.load(pipe), shared.load(pipe)
    assert [int(one[0]) for one in (first, second, third)] == [0, 1, 2]
    assert all((one == one[0]).all() for one in (first, second, third))
    first[0] = 7  # of one's own
    with pytest.raises(EOFError):
        shared.load(pipe)


def test_large_parts_do_not_go_over_the_pipe() -> None:
    pipe = io.BytesIO()
    mapped(1).dump([np.zeros(100_000), pickle.PickleBuffer(bytes(300_000))], pipe, 0)
    assert len(pipe.getvalue()) < 1000
