"""Encoded images opened: whole, cut short and damaged."""

import struct
import zlib

import numpy as np
import pytest
import simplejpeg

from scanmap.errors import CameraError
from scanmap.shot import decode_image, encode_png, is_grey


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("sampling", ["444", "422", "420"])
def test_of_a_cut_jpeg_no_row_is_believed_that_the_whole_one_does_not_have(sampling, grey):
    rng = np.random.default_rng(0)
    image = (0.2 * rng.integers(0, 255, (240, 320, 3)) + np.linspace(0, 200, 240)[:, None, None]).astype(np.uint8)
    data = simplejpeg.encode_jpeg(image, 90, "RGB", sampling)
    whole = decode_image(data, grey=grey)
    assert whole.rows_valid == 240
    believed = []
    for cut in range(900, len(data) - 2, 331):
        part = decode_image(data[:cut], grey=grey)
        assert part.image.shape == whole.image.shape
        np.testing.assert_array_equal(part.image[: part.rows_valid], whole.image[: part.rows_valid])
        same = (part.image == whole.image).reshape(240, -1).all(axis=1)
        believed.append((part.rows_valid, 240 if same.all() else int(same.argmin())))
    # Of what is right no more than two blocks are given up.
    assert all(right - rows <= 32 for rows, right in believed)
    assert max(rows for rows, _ in believed) > 180


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_a_mark_that_the_picture_stands_on_its_side_turns_no_pixel(kind):
    """A calibration is of the sensor's rows and columns, and OpenCV would turn a PNG and simplejpeg no JPEG."""
    image = np.repeat(np.arange(0, 240, 5, dtype=np.uint8), 64).reshape(48, 64)
    turned = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x112, 3, 1, 6, 0)
    if kind == "png":
        data, chunk = encode_png(image), b"eXIf" + turned
        marked = data[:33] + struct.pack(">I", len(turned)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    else:
        data, chunk = simplejpeg.encode_jpeg(image[:, :, None], 90, "GRAY"), b"Exif\0\0" + turned
        marked = data[:2] + b"\xff\xe1" + struct.pack(">H", len(chunk) + 2) + chunk + data[2:]
    assert marked != data
    np.testing.assert_array_equal(decode_image(marked).image, decode_image(data).image)


def test_files_of_one_plane_are_told_by_their_head():
    grey = np.full((16, 16), 90, np.uint8)
    colour = np.repeat(grey[..., None], 3, axis=2)
    jpegs = [simplejpeg.encode_jpeg(grey[..., None], 90, "GRAY"), simplejpeg.encode_jpeg(colour, 90, "BGR")]
    assert [is_grey(data) for data in (*jpegs, encode_png(grey), encode_png(colour))] == [True, False, True, False]
    assert not is_grey(b"") and not is_grey(jpegs[0][:8]) and not is_grey(encode_png(grey)[:20])


def test_what_is_no_picture_is_refused():
    png = encode_png(np.arange(12, dtype=np.uint8).reshape(3, 4))
    np.testing.assert_array_equal(decode_image(png, grey=True).image, np.arange(12).reshape(3, 4))
    for data in (b"", b"GIF89a", b"\xff\xd8\xff", png[:-4], png[:40] + bytes([png[40] ^ 1]) + png[41:]):
        with pytest.raises(CameraError, match=f"{len(data)} bytes"):
            decode_image(data)
