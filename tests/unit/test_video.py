import sys

import numpy as np
import pytest

from v3dg.video import write_video


@pytest.fixture
def av():
    return pytest.importorskip("av")


def stripes(place):
    picture = np.zeros((32, 48, 3), np.float32)
    picture[:, 8 * place : 8 * place + 8] = [1.0, 0.5, 0.0]
    return picture


def test_pictures_come_back_in_order(av, tmp_path):
    path = tmp_path / "film.mp4"
    assert write_video(path, (stripes(i) for i in range(6)), fps=24) == 6
    with av.open(str(path)) as film:
        assert film.streams.video[0].average_rate == 24
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == 6
    for i, picture in enumerate(pictures):
        assert abs(picture[16, 8 * i + 4].astype(int) - [255, 128, 0]).max() < 25
    assert list(tmp_path.iterdir()) == [path]


def test_tensors_make_a_film_too(av, tmp_path):
    torch = pytest.importorskip("torch")
    assert write_video(tmp_path / "film.mp4", [torch.zeros(16, 16, 3)]) == 1


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ([], "pictures: expected at least one picture, got none"),
        (
            [np.zeros((15, 16, 3))],
            r"pictures: expected an even height and width, got \(15, 16, 3\)",
        ),
        (
            [np.zeros((16, 16, 3)), np.zeros((16, 18, 3))],
            r"pictures: expected the shape \(16, 16, 3\) of the first picture, got \(16, 18, 3\)",
        ),
    ],
)
def test_wrong_pictures_are_refused_and_leave_no_file(av, tmp_path, pictures, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "film.mp4", pictures)
    assert not list(tmp_path.iterdir())


def test_another_suffix_is_refused(av, tmp_path):
    with pytest.raises(ValueError, match=r"film.gif: expected a file name ending in .mp4"):
        write_video(tmp_path / "film.gif", [stripes(0)])


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match="pip install 'av>=12'"):
        write_video(tmp_path / "film.mp4", [stripes(0)])
