import sys

import numpy as np
import pytest

from v3dg import Camera, Gaussians, metrics, render
from v3dg.pictures import to_8bit


def picture(seed, height=40, width=56):
    """Return smooth colours with a little noise, float32 (H, W, 3) in [0, 1]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 10
    waves = np.stack([np.sin(x + k) * np.cos(y - 2 * k) for k in range(3)], -1)
    return np.clip(0.5 + 0.3 * waves + 0.05 * rng.standard_normal(waves.shape), 0, 1).astype(
        np.float32
    )


def ssim_by_windows(a, b):
    """Return SSIM by its definition, in double precision: weighted windows of 11 x 11,
    mirrored at the borders."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[:, :, None]
    a, b = (np.pad(x.astype(np.float64), ((5, 5), (5, 5), (0, 0)), mode="reflect") for x in (a, b))
    values = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mean_p, mean_q = (window * p).sum((0, 1)), (window * q).sum((0, 1))
            var_p = (window * (p - mean_p) ** 2).sum((0, 1))
            var_q = (window * (q - mean_q) ** 2).sum((0, 1))
            cov = (window * (p - mean_p) * (q - mean_q)).sum((0, 1))
            values.append(
                (2 * mean_p * mean_q + 1e-4)
                * (2 * cov + 9e-4)
                / ((mean_p**2 + mean_q**2 + 1e-4) * (var_p + var_q + 9e-4))
            )
    return np.mean(values)


def test_psnr_of_a_known_offset():
    assert metrics.psnr(np.zeros((4, 5, 3)), np.full((4, 5, 3), 0.1)) == pytest.approx(20)


def test_equal_pictures_have_no_error():
    a = picture(0)
    assert metrics.psnr(a, a) == np.inf
    assert metrics.ssim(a, a) == pytest.approx(1)
    assert metrics.flip(a, a) == 0


def test_ssim_follows_its_definition():
    a, b = picture(0, 14, 17), picture(1, 14, 17)
    assert metrics.ssim(a, b) == pytest.approx(ssim_by_windows(a, b), abs=1e-10)


def test_ssim_agrees_with_torchmetrics():
    torch = pytest.importorskip("torch")
    theirs = pytest.importorskip("torchmetrics.functional.image")
    a, b = picture(0), picture(1)
    planes = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (b, a)]
    expected = theirs.structural_similarity_index_measure(*planes, data_range=1.0)
    assert metrics.ssim(a, b) == pytest.approx(float(expected), abs=1e-5)


def test_flip_of_black_against_white_is_large_and_of_noise_small():
    black, white = np.zeros((32, 32, 3), np.float32), np.ones((32, 32, 3), np.float32)
    assert metrics.flip(black, white) > 0.9
    assert 0 < metrics.flip(picture(0), picture(1)) < 0.3


def test_flip_grows_with_the_error():
    a = picture(0)
    noise = np.random.default_rng(1).standard_normal(a.shape).astype(np.float32)
    errors = [metrics.flip(a, a + s * noise) for s in (0.01, 0.03, 0.1)]
    assert errors == sorted(errors)


def test_flip_clips_to_what_a_screen_shows():
    a = np.ones((16, 16, 3), np.float32)
    assert metrics.flip(a, 3 * a) == 0


def test_flip_map_is_per_pixel_and_local():
    a = np.full((48, 48, 3), 0.5, np.float32)
    b = a.copy()
    b[20:24, 20:24] = (1, 0, 0)
    error = metrics.flip_map(a, b)
    assert error.shape == (48, 48)
    assert error[22, 22] > 0.3
    assert error[:4].max() < 1e-3
    assert metrics.error_image(a, b).shape == (48, 48, 3)


def test_inputs_are_left_alone():
    a, b = 2 * picture(0), picture(1)
    before = a.copy(), b.copy()
    metrics.flip(a, b), metrics.ssim(a, b), metrics.psnr(a, b)
    assert np.array_equal(a, before[0])
    assert np.array_equal(b, before[1])


def test_torch_pictures_give_the_same_numbers():
    torch = pytest.importorskip("torch")
    a, b = picture(0), picture(1)
    ta, tb = torch.from_numpy(a), torch.from_numpy(b).requires_grad_()
    assert metrics.psnr(ta, tb) == metrics.psnr(a, b)
    assert metrics.ssim(ta, tb) == metrics.ssim(a, b)
    assert metrics.flip(ta, tb) == metrics.flip(a, b)


def test_box_downsample_averages_blocks():
    image = np.arange(4 * 6, dtype=np.float32).reshape(4, 6)
    expected = [[image[i : i + 2, j : j + 2].mean() for j in (0, 2, 4)] for i in (0, 2)]
    assert np.array_equal(metrics.box_downsample(image, 2), expected)
    assert metrics.box_downsample(picture(0), 2).shape == (20, 28, 3)
    assert np.array_equal(metrics.box_downsample(image, 1), image)


def test_box_downsample_keeps_torch():
    torch = pytest.importorskip("torch")
    image = torch.rand(4, 6, 3, requires_grad=True)
    small = metrics.box_downsample(image, 2)
    assert isinstance(small, torch.Tensor)
    assert small.requires_grad


@pytest.mark.parametrize(
    ("reference", "test", "error", "message"),
    [
        ([[0.0]], np.zeros((8, 8, 3)), TypeError, "reference: expected a NumPy array"),
        (np.zeros((8, 8)), np.zeros((8, 8)), ValueError, r"reference: expected shape \(H, W, 3\)"),
        (
            np.zeros((8, 8, 3)),
            np.zeros((8, 9, 3)),
            ValueError,
            "test: expected the reference's shape",
        ),
        (
            np.zeros((8, 8, 3), np.uint8),
            np.zeros((8, 8, 3)),
            ValueError,
            "divide 8-bit pictures by 255",
        ),
        (np.zeros((0, 8, 3)), np.zeros((0, 8, 3)), ValueError, "at least one pixel"),
    ],
)
@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim, metrics.flip])
def test_wrong_pictures_are_refused(metric, reference, test, error, message):
    with pytest.raises(error, match=message):
        metric(reference, test)


def test_ssim_refuses_pictures_smaller_than_half_a_window():
    with pytest.raises(ValueError, match="at least 6 px"):
        metrics.ssim(np.zeros((5, 40, 3)), np.zeros((5, 40, 3)))


def test_box_downsample_refuses_what_does_not_divide():
    with pytest.raises(ValueError, match="divisible by 2"):
        metrics.box_downsample(np.zeros((5, 4, 3)), 2)
    with pytest.raises(ValueError, match="factor: expected at least 1"):
        metrics.box_downsample(np.zeros((4, 4, 3)), 0)


def test_without_its_extra_flip_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert not metrics.has_flip()
    with pytest.raises(ImportError, match=r"pip install 'flip-evaluator>=1.6'"):
        metrics.flip(picture(0), picture(1))


def test_truth_clips_samples_before_it_averages_them():
    bright = Gaussians(
        means=np.array([[0.0, 0.0, 2.0]], np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.002, np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.full((1, 1, 3), 100, np.float32),
    )
    camera = Camera(np.eye(4), np.array([[500.0, 0, 8], [0, 500, 8], [0, 0, 1]]), 16, 16)
    samples = render(bright, camera.scaled(2), tolerance=0, device="cpu").color
    assert samples.max() > 2
    expected = metrics.box_downsample(np.clip(samples, 0, 1), 2)
    np.testing.assert_array_equal(
        metrics.draw_truth(bright, camera, device="cpu"), to_8bit(expected)
    )
