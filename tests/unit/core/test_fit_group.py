"""Tests fits of groups to pictures of the gaussians that they replace: views, loss and
steps."""

import math
from dataclasses import replace

import numpy as np
import pytest

import scenes
from compare import DSSIM_FLOAT, FIT_FLOAT, assert_close
from devices import host, on
from v3dg import BuildConfig, Camera, Gaussians, _core, rasterize
from v3dg.levels.fit import fit_config

torch = pytest.importorskip("torch")

from reference import loss as reference  # noqa: E402

# There is a single view size, and pictures are neither smoothed nor shifted.
PLAIN = BuildConfig(
    image_size=32, supersample=1, filter_px2=0.0, num_views=16, views_per_step=1, first_steps=1000
)
FROZEN = dict.fromkeys(
    ("step_position", "step_log_scale", "step_quat", "step_logit", "step_sh0", "step_sh_rest"), 0.0
)
CENTER, RADIUS = np.float32([3.0, -2.0, 1.0]), 0.5


def fit_groups(
    device, start, target, config, target_range, own_range, *, seed=0, streams=None, progress=None
):
    """Fit groups that all lie in the ball (CENTER, RADIUS). Return the result and the
    residuals."""
    num_groups = len(own_range)
    fitted = on(device, copied(start))
    target_range, own_range = (
        np.array(r, np.int64).reshape(-1, 2) for r in (target_range, own_range)
    )
    error = _core.fit_level(
        fit_config(config, seed, 0),
        _core.FitTarget(on(device, target).rows, 0.0, False),
        target_range,
        fitted.rows,
        own_range,
        np.tile(np.float32([*CENTER, RADIUS]), (num_groups, 1)),
        np.arange(num_groups) if streams is None else np.array(streams),
        progress or _core.FitProgress(),
    )
    return host(fitted), error


def copied(gaussians):
    return Gaussians(*(getattr(gaussians, name).copy() for name in scenes.NAMES))


def fit(device, start, target, config, *, seed=0, stream=0, progress=None):
    """Fit one group. Return the result and its residuals, the mean absolute differences
    of colour and alpha."""
    ranges = [[0, len(target)]], [[0, len(start)]]
    fitted, error = fit_groups(
        device, start, target, config, *ranges, seed=seed, streams=[stream], progress=progress
    )
    return fitted, error[0]


def in_ball(seed, num, **changes):
    """Return gaussians throughout the ball."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(num, 3))
    means *= (
        RADIUS
        * 0.8
        * rng.uniform(0, 1, (num, 1)) ** (1 / 3)
        / np.linalg.norm(means, axis=1, keepdims=True)
    )
    g = scenes.gaussians(
        CENTER + means,
        quats=rng.normal(size=(num, 4)),
        scales=RADIUS * np.exp(rng.uniform(-3.5, -1.5, (num, 3))),
        opacities=rng.uniform(0.2, 0.9, num),
        color=rng.uniform(0, 1, (num, 3)),
    )
    return scenes.replaced(g, **changes)


def ball(opacity, color, scale=0.3, sh=None):
    """Return one round gaussian at the centre. It looks the same from everywhere,
    except for the part of `sh` above degree 0."""
    return scenes.gaussians(CENTER, scales=scale * RADIUS, opacities=opacity, color=color, sh=sh)


def with_bases(g, degree):
    sh = np.zeros((len(g), (degree + 1) ** 2, 3), np.float32)
    sh[:, :1] = g.sh
    return scenes.replaced(g, sh=sh)


def view_of_ball(config, direction=(0, 0, 1)):
    """Return the picture of PLAIN, which is the same in all views up to a rotation."""
    eye = CENTER.astype(np.float64) - config.distance * RADIUS * np.asarray(direction, np.float64)
    fov = 2 * math.atan(64 / 2 / 88.9)
    return Camera.look_at(
        eye, CENTER, [0, 1, 0.1], fov_x=fov, width=config.image_size, height=config.image_size
    )


# ---- views and residual


def test_residual_of_what_matches_is_nothing(device):
    g = in_ball(0, 30)
    out, error = fit(device, g, g, replace(PLAIN, steps=0))
    assert (error < 2e-6).all()
    np.testing.assert_allclose(out.means, g.means, rtol=1e-6)


def test_residual_is_the_mean_difference_in_colour_and_alpha(device):
    start, target = ball(0.4, (0.2, 0.9, 0.1)), ball(0.9, (0.7, 0.3, 0.6), scale=0.4)
    pictures = [rasterize(g, view_of_ball(PLAIN)) for g in (start, target)]
    _, error = fit(device, start, target, replace(PLAIN, steps=0))
    assert_close(error[0], np.abs(pictures[0].color - pictures[1].color).mean(), FIT_FLOAT)
    assert_close(error[1], np.abs(pictures[0].alpha - pictures[1].alpha).mean(), FIT_FLOAT)


def test_targets_are_supersampled(device):
    """A gaussian between the pixel centres of a picture is visible at four times the
    resolution."""
    speck = ball(0.9, (1, 1, 1), scale=0.004)
    nothing = ball(0.0, (0, 0, 0))
    camera = view_of_ball(PLAIN).scaled(4)
    expected = rasterize(speck, camera).alpha.reshape(32, 4, 32, 4).mean()
    _, error = fit(device, nothing, speck, replace(PLAIN, steps=0, supersample=4))
    assert_close(error[1], expected, FIT_FLOAT)


def mean_colour_over_views(device, coefficient, config, **options):
    """Return the mean colour of one SH coefficient over the views of a residual, in
    units of its standard deviation over the sphere."""
    sh = np.zeros((1, 16, 3), np.float32)
    sh[0, 0] = 0.5 / scenes.SH_C0  # a colour of 1 keeps all values above 0
    sh[0, coefficient] = 0.2
    bright, nothing = ball(0.9, (1, 1, 1), sh=sh), with_bases(ball(0.0, (0, 0, 0)), 3)
    _, error = fit(device, nothing, bright, replace(config, steps=0), **options)
    return (error[0] / error[1] - 1) / (0.2 * scenes.SH_C0)


@pytest.mark.parametrize("num_views", [1, 16])
def test_views_held_out_lie_evenly_on_the_sphere(device, num_views):
    """The mean of functions on the sphere up to degree 2 is smaller over these views
    than over 8 random ones."""
    config = replace(PLAIN, num_views=num_views)
    means = [
        mean_colour_over_views(device, k, config, seed=seed)
        for k in range(1, 9)
        for seed in range(3)
    ]
    assert np.abs(means).max() < 0.2
    # with random views, it would be 0.35
    assert np.sqrt(np.mean(np.square(means))) < 0.08


def test_fresh_views_are_random_and_uniform(device):
    config = replace(PLAIN, num_views=0)
    for k in (*range(1, 9), 12, 15):
        means = np.array(
            [mean_colour_over_views(device, k, config, stream=stream) for stream in range(100)]
        )
        assert abs(means.mean()) < 4 * 0.35 / 10  # 4 standard deviations of 100 means over 8 views
        assert 0.7 < means.std() / 0.35 < 1.3


def test_seed_and_stream_change_the_views(device):
    _, first = fit(device, ball(0, (0, 0, 0)), in_ball(1, 20), replace(PLAIN, steps=0))
    for options in ({"seed": 1}, {"stream": 1}):
        _, other = fit(
            device, ball(0, (0, 0, 0)), in_ball(1, 20), replace(PLAIN, steps=0), **options
        )
        assert not np.array_equal(first, other)


@pytest.mark.parametrize("num_views", [1, 4, 29, 58, 64])
def test_every_view_is_looked_at(device, num_views):
    """Views from all directions show the fit what is only visible from some of them."""
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0], sh[0, 1:] = 1.0, np.float32([[0.5], [-0.4], [0.3]])
    target = ball(0.9, (0, 0, 0), sh=sh)
    start = with_bases(scenes.replaced(target, sh=sh[:, :1].copy()), 1)
    config = replace(
        PLAIN, **FROZEN | {"step_sh_rest": 0.02}, num_views=num_views, steps=200, final_step=0.01
    )
    fitted, _ = fit(device, start, target, config)
    close = np.abs(fitted.sh - sh).max() < 0.03
    assert close == (num_views > 1)


# ---- loss


def noise(seed, *shape):
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


@pytest.mark.parametrize(
    ("picture", "target"),
    [
        (noise(0, 23, 31), noise(1, 23, 31)),
        (noise(2, 1, 1), noise(3, 1, 1)),
        (noise(4, 3, 40), noise(5, 3, 40)),
        (noise(6, 16, 16), np.zeros((16, 16), np.float32)),
        (np.full((20, 20), 0.5, np.float32), np.full((20, 20), 0.4, np.float32)),
        (np.linspace(0, 1, 900, dtype=np.float32).reshape(30, 30), noise(7, 30, 30)),
    ],
)
def test_dssim_and_its_gradient_agree_with_reference(picture, target):
    value, gradient = _core.dssim(picture, target)
    exact = torch.tensor(picture, dtype=torch.float64, requires_grad=True)
    expected = reference.dssim(exact, torch.tensor(target, dtype=torch.float64))
    expected.backward()
    assert_close(value, expected.item(), DSSIM_FLOAT)
    size = exact.grad.abs().max().item()
    assert_close(gradient / size, exact.grad.numpy() / size, DSSIM_FLOAT)


def test_reference_gradient_agrees_with_finite_differences():
    target = torch.tensor(noise(8, 4, 6), dtype=torch.float64)
    picture = torch.tensor(noise(9, 4, 6), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: reference.dssim(x, target), picture)


def test_dssim_of_equal_pictures_is_nothing():
    value, gradient = _core.dssim(noise(10, 20, 20), noise(10, 20, 20))
    assert abs(value) < 1e-6
    assert np.abs(gradient).max() < 1e-5


@pytest.mark.parametrize(
    ("picture", "target"),
    [
        (np.zeros((3, 3)), np.zeros((3, 3), np.float32)),
        (np.zeros((3, 3), np.float32), np.zeros((3, 4), np.float32)),
        (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)),
    ],
)
def test_wrong_pictures_are_refused(picture, target):
    with pytest.raises(ValueError, match=r"picture: expected|target: expected"):
        _core.dssim(picture, target)


# ---- steps


@pytest.mark.parametrize(
    "weights",
    [
        (1.0, 0.0, 0.5, 0.0),
        (0.8, 0.2, 0.1, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (1.0, 0.0, 0.5, 1.0),
        (0.5, 0.2, 1.0, 3.0),
    ],
)
@pytest.mark.parametrize("views_per_step", [1, 3])
def test_steps_are_those_of_adam(device, weights, views_per_step):
    """A ball that looks the same from everywhere is fitted, and also optimised with
    torch.optim.Adam and differentiable pictures. The steps are equal."""
    steps = 25
    config = replace(
        PLAIN,
        **FROZEN | {"step_logit": 0.05, "step_sh0": 0.03},
        **dict(zip(("loss_l1", "loss_dssim", "loss_alpha", "loss_cells"), weights, strict=True)),
        steps=steps,
        views_per_step=views_per_step,
    )
    start, target = ball(0.3, (0.2, 0.9, 0.35)), ball(0.8, (0.6, 0.5, 0.3), scale=0.35)
    fitted, _ = fit(device, start, target, config)

    camera = view_of_ball(config)
    goal = scenes.doubles(target, torch=torch)
    goal = rasterize(goal, camera)
    g = scenes.doubles(start, torch=torch)
    logit = torch.logit(g.opacities).requires_grad_()
    sh = g.sh.clone().requires_grad_()
    optimizer = torch.optim.Adam(
        [{"params": [logit], "lr": config.step_logit}, {"params": [sh], "lr": config.step_sh0}],
        betas=(0.9, config.beta2),
        eps=1e-15,
    )
    decay = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda s: config.final_step ** (s / (steps - 1))
    )
    for _ in range(steps):
        g.opacities, g.sh = torch.sigmoid(logit), sh
        drawn = rasterize(g, camera)
        optimizer.zero_grad()
        reference.loss(drawn.color, drawn.alpha, goal.color, goal.alpha, weights).backward()
        optimizer.step()
        decay.step()
    assert_close(fitted.opacities, torch.sigmoid(logit).detach().numpy(), FIT_FLOAT)
    assert_close(fitted.sh, sh.detach().numpy(), FIT_FLOAT)


def test_first_step_has_the_sizes_that_were_set(device):
    """The first step of Adam has the length that was set, whatever the gradient is."""
    steps = {"step_position": 1e-3, "step_log_scale": 2e-3, "step_logit": 3e-3, "step_sh0": 4e-3}
    start, target = in_ball(2, 12), in_ball(3, 12)
    config = replace(
        PLAIN, **FROZEN | steps | {"step_sh_rest": 5e-3}, steps=1, views_per_step=16, image_size=64
    )
    start, target = with_bases(start, 1), with_bases(target, 1)
    fitted, _ = fit(device, start, target, config)
    assert not np.array_equal(fitted.sh, start.sh)  # the fit is better than the start

    def logit(x):
        return np.log(x / (1 - x))

    changes = {
        "step_position": (fitted.means - start.means) / RADIUS,
        "step_log_scale": np.log(fitted.scales / start.scales),
        "step_logit": logit(fitted.opacities) - logit(start.opacities),
        "step_sh0": fitted.sh[:, 0] - start.sh[:, 0],
        "step_sh_rest": fitted.sh[:, 1:] - start.sh[:, 1:],
    }
    for name, change in changes.items():
        np.testing.assert_allclose(np.abs(change), getattr(config, name), rtol=0.01, err_msg=name)


def test_position_steps_in_world_units(device):
    config = replace(
        PLAIN, **FROZEN | {"step_position": 1e-3}, position_in_world=True, steps=1, image_size=64
    )
    start = in_ball(2, 12)
    fitted, _ = fit(device, start, in_ball(3, 12), config)
    np.testing.assert_allclose(np.abs(fitted.means - start.means), 1e-3, rtol=0.01)


@pytest.mark.parametrize("changes", [{}, {"num_views": 0}, {"image_size": 0}, {"loss_dssim": 0.2}])
def test_longer_fits_come_closer(device, changes):
    start, target = in_ball(4, 20), in_ball(5, 60)
    config = replace(PLAIN, supersample=2, filter_px2=0.1, **changes)
    loss = [
        fit(device, start, target, replace(config, steps=steps))[1]
        @ [config.loss_l1, config.loss_alpha]
        for steps in (0, 20, 200)
    ]
    assert loss[1] < 0.9 * loss[0]
    assert loss[2] < 0.9 * loss[1]


def test_result_no_better_than_its_start_is_thrown_away(device):
    target = in_ball(6, 20)
    # With this start, the fit is far better than no gaussians at all.
    start = scenes.replaced(target, sh=target.sh + np.float32(0.05))
    _, before = fit(device, start, target, replace(PLAIN, steps=0))
    for step in ("step_position", "step_log_scale", "step_logit", "step_sh0"):
        out, error = fit(device, start, target, replace(PLAIN, **FROZEN | {step: 1e8}, steps=5))
        assert all(np.array_equal(getattr(out, n), getattr(start, n)) for n in scenes.NAMES), step
        np.testing.assert_array_equal(error, before)


def test_result_that_pleases_only_the_views_it_was_fitted_to_is_thrown_away(device):
    """The target is red from one side. The start has its mean colour, which is the best
    fit over all views."""
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0], sh[0, 1:, 0] = 1.0, [0.4, -0.4, 0.4]
    target = ball(0.9, (0, 0, 0), sh=sh)
    start = with_bases(scenes.replaced(target, sh=sh[:, :1].copy()), 1)
    config = replace(PLAIN, **FROZEN | {"step_sh0": 0.02}, num_views=1, steps=100)
    _, before = fit(device, start, target, replace(config, steps=0))
    out, error = fit(device, start, target, config)
    np.testing.assert_array_equal(out.sh, start.sh)
    np.testing.assert_array_equal(error, before)


@pytest.mark.parametrize(
    ("step", "target"),
    [
        (
            "step_position",
            scenes.replaced(ball(0.9, (1, 1, 1)), means=CENTER[None] + np.float32([[1, 0, 0]])),
        ),
        ("step_log_scale", ball(0.9, (1, 1, 1), scale=5.0)),
        ("step_logit", ball(1.0, (1, 1, 1))),
    ],
)
def test_nothing_runs_away(device, step, target):
    """The target is outside the ball, larger than the ball, or opaque. It is fitted
    with large steps."""
    start = ball(0.3, (1, 1, 1))
    out, error = fit(device, start, target, replace(PLAIN, **FROZEN | {step: 30.0}, steps=3))
    _, before = fit(device, start, target, replace(PLAIN, steps=0))
    assert error.sum() < before.sum()  # the initial values were kept
    assert np.abs(out.means - CENTER).max() <= RADIUS * (1 + 1e-6)
    assert out.scales.max() <= RADIUS * (1 + 1e-6)
    assert out.opacities.max() <= 1 - 0.99e-4


def test_groups_do_not_touch_each_other(device):
    """Two groups that are fitted together have the same results as each alone with its
    own stream of random numbers."""
    starts, targets = [in_ball(8, 12), in_ball(9, 7)], [in_ball(10, 30), in_ball(11, 20)]
    config = replace(PLAIN, steps=10)
    alone = [
        fit(device, s, t, config, stream=i)
        for i, (s, t) in enumerate(zip(starts, targets, strict=True))
    ]
    progress = _core.FitProgress()
    both, error = fit_groups(
        device,
        *(Gaussians.concatenate(starts), Gaussians.concatenate(targets), config),
        *([[0, 30], [30, 50]], [[0, 12], [12, 19]]),
        progress=progress,
    )
    for name in scenes.NAMES:
        expected = np.concatenate([getattr(g, name) for g, _ in alone])
        np.testing.assert_array_equal(getattr(both, name), expected)
    np.testing.assert_array_equal(error, [e for _, e in alone])
    assert progress.groups_done == 2
    np.testing.assert_allclose(
        progress.loss_sum, (error @ [config.loss_l1, config.loss_alpha]).sum(), rtol=1e-6
    )


def test_cancelled_fit_does_nothing(device):
    progress = _core.FitProgress()
    progress.cancel()
    start = in_ball(12, 10)
    out, _ = fit(device, start, in_ball(13, 10), PLAIN, progress=progress)
    assert np.array_equal(out.means, start.means)
    assert progress.groups_done == 0


def test_no_groups_are_legal(device):
    out, error = fit_groups(device, in_ball(14, 0), in_ball(14, 0), PLAIN, [], [])
    assert len(out) == len(error) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(
            (
                change,
                r"range: expected \[first, last\) within the gaussians, got numbers outside for",
            )
            for change in ({"target_range": [[0, 11]]}, {"range": [[3, 2]]}, {"range": [[-1, 2]]})
        ),
        ({"target_range": [[0, 5], [5, 10]]}, "target_range: expected shape"),
        ({"stream": [0, 1]}, "stream: expected shape"),
        (
            {"ball": np.zeros((1, 4), np.float32)},
            "ball: expected a positive radius, got none for group 0",
        ),
    ],
)
def test_wrong_groups_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        fit_one_group(in_ball(15, 10), in_ball(15, 10), change)


def fit_one_group(start, target, change):
    """Call the core with one or more arguments replaced."""
    arguments = {
        "config": fit_config(PLAIN, 0, 0),
        "target": _core.FitTarget(target.rows, 0.0, False),
        "target_range": [[0, 10]],
        "gaussians": copied(start).rows,
        "range": [[0, 10]],
        "ball": np.float32([[0, 0, 0, 1]]),
        "stream": [0],
        "progress": _core.FitProgress(),
    } | change
    for name in ("target_range", "range", "stream"):
        arguments[name] = np.array(arguments[name], np.int64)
    return _core.fit_level(**arguments)


def test_what_is_fitted_has_to_be_like_its_target():
    message = "gaussians: expected the device and the SH degree of the target, got different ones"
    with pytest.raises(ValueError, match=message):
        fit_one_group(with_bases(in_ball(15, 10), 1), in_ball(15, 10), {})


def test_what_is_fitted_has_to_be_writable():
    start = copied(in_ball(15, 10))
    start.means.flags.writeable = False
    with pytest.raises(ValueError, match="means: expected a writable array"):
        fit_one_group(in_ball(15, 10), in_ball(15, 10), {"gaussians": start.rows})


@pytest.mark.gpu
def test_what_is_fitted_has_to_be_where_its_target_is():
    message = "gaussians: expected the device and the SH degree of the target, got different ones"
    there = on("cuda", in_ball(15, 10))
    with pytest.raises(ValueError, match=message):
        fit_one_group(in_ball(15, 10), there, {})
    with pytest.raises(ValueError, match=message):
        fit_one_group(in_ball(15, 10), in_ball(15, 10), {"gaussians": there.rows})


# ---- both devices


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("num", "num_target", "degree", "changes"),
    [
        (1, 3, 0, {}),
        (2, 1, 0, {"num_views": 0}),
        (31, 60, 0, {"views_per_step": 3}),
        (60, 120, 3, {"loss_dssim": 0.2}),
        (178, 356, 0, {"image_size": 0, "supersample": 4, "filter_px2": 0.05, "views_per_step": 2}),
        (178, 356, 1, {"num_views": 0, "loss_dssim": 0.2}),
        (300, 400, 0, {"image_size": 0, "views_per_step": 2}),
        (200, 60, 0, {"image_size": 50, "loss_dssim": 0.2}),
        (3000, 4000, 3, {"image_size": 64, "num_views": 0, "loss_dssim": 0.2}),
    ],
)
@pytest.mark.parametrize("steps", [0, 1, 5])
def test_devices_agree(num, num_target, degree, changes, steps):
    """Rounding hardly changes most results. Adam, however, makes whole steps from
    gradients that consist of rounding errors only."""
    start = with_bases(in_ball(16, num), degree)
    target = with_bases(in_ball(17, num_target), degree)
    config = replace(PLAIN, steps=steps, **changes)
    (a, a_error), (b, b_error) = (fit(device, start, target, config) for device in ("cpu", "cuda"))
    np.testing.assert_allclose(b_error, a_error, rtol=1e-4, atol=1e-7)
    for name in scenes.NAMES:
        first, x, y = (getattr(g, name).astype(np.float64) for g in (start, a, b))
        moved = np.abs(x - first).max()
        assert (np.abs(x - y) > 1e-3 * moved + 1e-6).mean() < 0.01, name


@pytest.mark.gpu
@pytest.mark.parametrize("changes", [{}, {"num_views": 0, "loss_dssim": 0.2, "image_size": 64}])
def test_devices_come_as_close(changes):
    start, target = in_ball(18, 60), in_ball(19, 180)
    config = replace(PLAIN, supersample=2, filter_px2=0.1, steps=150, **changes)
    loss = [
        fit(device, start, target, config)[1] @ [config.loss_l1, config.loss_alpha]
        for device in ("cpu", "cuda")
    ]
    assert loss[1] == pytest.approx(loss[0], rel=0.03)


@pytest.mark.gpu
@pytest.mark.parametrize(("num_groups", "num"), [(1, 178), (200, 20), (3, 700)])
def test_every_run_gives_the_same_bytes(num_groups, num):
    start, target = in_ball(20, num_groups * num), in_ball(21, num_groups * num)
    ranges = np.arange(num_groups)[:, None] * num + [0, num]
    config = replace(PLAIN, steps=20, views_per_step=2, num_views=4, image_size=0)
    (a, a_error), (b, b_error) = (
        fit_groups("cuda", start, target, config, ranges, ranges) for _ in range(2)
    )
    assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in scenes.NAMES)
    np.testing.assert_array_equal(a_error, b_error)
