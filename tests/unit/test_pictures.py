"""Pictures with 8 bits: rounding, contact sheets, and files."""

import io

import numpy as np
import pytest
from PIL import Image

from v3dg import pictures


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (np.zeros((3, 4)), ValueError, r"shape \(H, W, 3\) with at least one pixel, got \(3, 4\)"),
        (np.zeros((0, 4, 3)), ValueError, r"at least one pixel, got \(0, 4, 3\)"),
        (np.full((3, 4, 3), np.nan), ValueError, r"colours without NaN, got NaN"),
        (np.zeros((3, 4, 3), int), ValueError, r"uint8, or floats in \[0,1\], got int64"),
        ([[[0, 0, 0]]], TypeError, "a NumPy array or a torch tensor, got list"),
    ],
)
def test_what_is_no_picture_is_not_written(image, error, message, tmp_path):
    with pytest.raises(error, match=f"^image: expected .*{message}"):
        pictures.write_picture(tmp_path / "a.png", image)
    assert list(tmp_path.iterdir()) == []


def test_a_tensor_of_a_training_is_written(tmp_path):
    torch = pytest.importorskip("torch")
    for kind, value in ((torch.float32, 1.0), (torch.uint8, 255)):
        image = torch.full((2, 3, 3), value, dtype=kind, requires_grad=kind == torch.float32)
        pictures.write_picture(tmp_path / "a.png", image)
        np.testing.assert_array_equal(pictures.read_picture(tmp_path / "a.png"), 255)


def test_colours_are_rounded_and_clipped():
    image = np.array([[[-1, 0, 0.5 / 255], [1.49 / 255, 1.51 / 255, 254.5 / 255], [1, 2, np.inf]]])
    expected = np.array([[[0, 0, 1], [1, 2, 255], [255, 255, 255]]], np.uint8)
    np.testing.assert_array_equal(pictures.to_8bit(image.astype(np.float32)), expected)


def test_every_value_of_8_bits_comes_back():
    values = np.arange(256, dtype=np.uint8)[:, None, None].repeat(3, axis=2)
    np.testing.assert_array_equal(pictures.to_8bit(values / np.float32(255)), values)
    png = np.asarray(Image.open(io.BytesIO(pictures.encode_png(values / np.float32(255)))))
    np.testing.assert_array_equal(png, values)


@pytest.mark.parametrize("suffix", pictures.SUFFIXES)
def test_what_is_written_is_read_whatever_its_name(suffix, tmp_path):
    image = np.full((8, 16, 3), (200, 100, 50), np.uint8)
    pictures.write_picture(tmp_path / f"a{suffix}", image)
    (tmp_path / f"a{suffix}").rename(tmp_path / "a.dat")
    read = pictures.read_picture(tmp_path / "a.dat").astype(int)
    assert np.abs(read - image).max() <= (0 if suffix == ".png" else 4)


def test_a_contact_sheet_has_each_picture_below_its_text():
    red, blue = (np.full((h, 20, 3), c, np.uint8) for h, c in ((30, (255, 0, 0)), (9, (0, 0, 255))))
    sheet = pictures.contact_sheet([[("red", red), ("blue", blue)], [("again", blue)]])
    assert (sheet == (255, 0, 0)).all(axis=2).sum() == red[..., 0].size
    assert (sheet == (0, 0, 255)).all(axis=2).sum() == 2 * blue[..., 0].size
    rows = np.flatnonzero((sheet == (0, 0, 255)).all(axis=2).any(axis=1))
    # The second row begins below the highest picture of the first row.
    assert rows[9] - rows[0] > 30


def test_sizes_beyond_the_limits_are_refused():
    pictures.check_size("size", pictures.MOST_SIDE, 1)
    with pytest.raises(ValueError, match=r"size: expected a picture of at most 65,500 px a side"):
        pictures.check_size("size", pictures.MOST_SIDE + 1, 1)
    with pytest.raises(ValueError, match=r"at most .* px in total, got 1000 x 1001"):
        pictures.check_size("size", 1000, 1001, most_pixels=1_000_000)


def test_places_are_checked_before_long_work(tmp_path):
    assert pictures.check_picture_path(tmp_path / "a.PNG") == tmp_path / "a.PNG"
    with pytest.raises(ValueError, match=r"a\.gif: expected a file name ending in \.png, \.jpg"):
        pictures.check_picture_path(tmp_path / "a.gif")
    pictures.check_picture_path(tmp_path / "new" / "a.png")
    assert not (tmp_path / "new").exists()
