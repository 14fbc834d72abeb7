"""Tests gsplat's interface for rasterization. It is compared with autograd in float64,
and used by gsplat's own strategies."""

import gc
import weakref
from enum import Enum

import numpy as np
import pytest

import scenes
from compare import (
    GRADIENT_DOUBLE,
    GRADIENT_FLOAT,
    PICTURE_DOUBLE,
    assert_close,
    assert_gradients_agree,
)
from v3dg import Camera, Gaussians
from v3dg import rasterize as v3dg_rasterize
from v3dg.compat.gsplat import rasterization, rasterization_2dgs

torch = pytest.importorskip("torch")

from reference import rasterize_torch  # noqa: E402

EPS2D = 0.3  # gsplat's default
NAMES = (*scenes.NAMES, "backgrounds")
FIRST = scenes.camera(23, 19, fx=20.0, cx=6.5, cy=14.0, pose=scenes.pose(2))
CAMERAS = [FIRST]
for _seed, _shift in (
    (1, 0.1),
    (2, -0.2),
):  # near the first camera, so that both see the same gaussians
    _viewmat = FIRST.viewmat.copy()
    _viewmat[:3, 3] += _shift
    CAMERAS.append(Camera(_viewmat, FIRST.K * [[1 + _shift], [1], [1]], 23, 19))


def of_cameras(cameras, *, dtype=torch.float64, device="cpu"):
    """Return the arguments that describe the cameras."""
    return {
        "viewmats": torch.tensor(
            np.stack([c.viewmat for c in cameras]), dtype=dtype, device=device
        ),
        "Ks": torch.tensor(np.stack([c.K for c in cameras]), dtype=dtype, device=device),
        "width": cameras[0].width,
        "height": cameras[0].height,
    }


def leaves(
    cameras, num=25, *, sh_degree=3, plain=False, dtype=torch.float64, device="cpu", seed=30
):
    """Return means, quats, scales, opacities, colours and backgrounds that require
    gradients."""
    gaussians = scenes.random_gaussians(
        seed, cameras[0], num, size_px=(0.5, 6), aspect=8, sh_degree=sh_degree, opacity=(0.05, 1.1)
    )
    arrays = [np.asarray(getattr(gaussians, name), np.float64) for name in scenes.NAMES]
    if plain:
        arrays[4] = arrays[4][:, 0]  # some of them are negative
    arrays.append(np.random.default_rng(seed).uniform(-0.5, 1, (len(cameras), 3)))
    return [torch.tensor(a, dtype=dtype, device=device, requires_grad=True) for a in arrays]


def draw(inputs, cameras, **options):
    places = of_cameras(cameras, dtype=inputs[0].dtype, device=inputs[0].device)
    return draw_at(places, inputs, **options)


def draw_at(places, inputs, **options):
    """Draw from the cameras that `of_cameras` returns."""
    *shape, colors, backgrounds = inputs
    return rasterization(*shape, colors, **places, backgrounds=backgrounds, **options)


def expected(inputs, cameras, *, render_mode="RGB", sh_degree=None, antialiased=False):
    """Return the result of `draw` except the dict, computed by the reference with
    autograd."""
    *shape, colors, backgrounds = inputs
    pictures, alphas = [], []
    for camera, background in zip(cameras, backgrounds, strict=True):
        sh = colors[:, None] if sh_degree is None else colors[:, : (sh_degree + 1) ** 2]
        mode = {"filter_px2": EPS2D, "antialiased": antialiased, "plain_colors": sh_degree is None}
        color, alpha, depth = rasterize_torch.rasterize(*shape, sh, background, camera, **mode)
        parts = [color] if "RGB" in render_mode else []
        if "D" in render_mode:
            parts.append((depth if "ED" in render_mode else depth * alpha)[..., None])
        pictures.append(torch.cat(parts, dim=-1))
        alphas.append(alpha[..., None])
    return torch.stack(pictures), torch.stack(alphas)


def weighted_sum(pictures, alphas, seed=0):
    """Return a number that depends on every pixel."""
    rng = np.random.default_rng(seed)
    return sum(
        (p * torch.from_numpy(rng.normal(size=tuple(p.shape))).to(p)).sum()
        for p in (pictures, alphas)
    )


def gradients(loss, inputs):
    found = torch.autograd.grad(loss, inputs, allow_unused=True)
    return [torch.zeros_like(t) if g is None else g for g, t in zip(found, inputs, strict=True)]


# Values and gradients.


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("sh_degree", [None, 1, 3])
def test_pictures_and_gradients_are_those_of_autograd(render_mode, sh_degree, packed):
    inputs = leaves(CAMERAS, plain=sh_degree is None)
    antialiased = render_mode in ("RGB", "RGB+ED")
    rasterize_mode = "antialiased" if antialiased else "classic"
    options = {"render_mode": render_mode, "sh_degree": sh_degree}
    got = draw(inputs, CAMERAS, packed=packed, rasterize_mode=rasterize_mode, **options)[:2]
    wanted = expected(inputs, CAMERAS, antialiased=antialiased, **options)
    for g, w in zip(got, wanted, strict=True):
        assert g.shape == w.shape
        assert (g - w).abs().max() <= PICTURE_DOUBLE.absolute
    pairs = zip(
        NAMES,
        gradients(weighted_sum(*got), inputs),
        gradients(weighted_sum(*wanted), inputs),
        strict=True,
    )
    for name, g, w in pairs:
        assert w.abs().max() > 0 or (
            render_mode in ("D", "ED") and name in ("sh", "backgrounds")
        ), name
        assert_close(g.numpy(), w.numpy(), GRADIENT_DOUBLE)


@pytest.mark.parametrize("sh_degree", [None, 2])
def test_each_camera_may_see_colors_of_its_own(sh_degree):
    inputs = leaves(CAMERAS, plain=sh_degree is None)
    factors = torch.linspace(0.5, 1.5, len(CAMERAS), dtype=torch.float64)
    colors = (inputs[4][None] * factors.view(-1, *[1] * inputs[4].ndim)).detach().requires_grad_()
    of_all = [*inputs[:4], colors, inputs[5]]
    got = draw(of_all, CAMERAS, sh_degree=sh_degree)[:2]
    total = 0
    for c, camera in enumerate(CAMERAS):
        one = [*inputs[:4], colors[c], inputs[5][c : c + 1]]
        wanted = expected(one, [camera], sh_degree=sh_degree)
        for g, w in zip(got, wanted, strict=True):
            assert (g[c] - w[0]).abs().max() <= PICTURE_DOUBLE.absolute
        total = total + weighted_sum(*wanted, seed=c)
    mine = sum(
        weighted_sum(*(part[c : c + 1] for part in got), seed=c) for c in range(len(CAMERAS))
    )
    for g, w in zip(gradients(mine, of_all), gradients(total, of_all), strict=True):
        assert_close(g.numpy(), w.numpy(), GRADIENT_DOUBLE)


@pytest.mark.parametrize("options", [{}, {"sh_degree": 2, "packed": False}], ids=["plain", "sh"])
def test_single_precision_comes_to_the_same(device, options):
    options = {**options, "render_mode": "RGB+ED", "rasterize_mode": "antialiased", "absgrad": True}
    results = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        inputs = leaves(CAMERAS, 200, plain="sh_degree" not in options, dtype=dtype, device=where)
        pictures, alphas, info = draw(inputs, CAMERAS, **options)
        info["means2d"].retain_grad()
        weighted_sum(pictures, alphas).backward()
        centers = (info["means2d"].grad, info["means2d"].absgrad)
        results.append([tensor.cpu().double() for tensor in (*(t.grad for t in inputs), *centers)])
    for double, single in zip(*results, strict=True):
        assert_gradients_agree(single, double, GRADIENT_FLOAT)


def test_a_camera_alone_is_drawn_as_v3dg_draws_it(device):
    *arrays, shades = leaves([FIRST], 60, dtype=torch.float32, device=device)
    options = {"sh_degree": 3, "render_mode": "RGB+ED", "backgrounds": shades}
    with torch.no_grad():
        pictures, alphas, _ = rasterization(*arrays, **of_cameras([FIRST]), **options)
        image = v3dg_rasterize(Gaussians(*arrays), FIRST, filter_px2=EPS2D, background=shades[0])
    np.testing.assert_array_equal(pictures[0, ..., :3].cpu(), image.color.cpu())
    np.testing.assert_array_equal(pictures[0, ..., 3].cpu(), image.depth.cpu())
    np.testing.assert_array_equal(alphas[0, ..., 0].cpu(), image.alpha.cpu())


# Gradients of poses, and several sets of gaussians.


class PosedCamera:
    """A camera whose pose is a tensor, for the reference."""

    def __init__(self, camera, viewmat):
        self.viewmat = viewmat
        self.position = -torch.linalg.inv(viewmat[:3, :3]) @ viewmat[:3, 3]
        for name in ("fx", "fy", "cx", "cy", "width", "height", "near"):
            setattr(self, name, getattr(camera, name))


def posed(cameras, viewmats):
    return [PosedCamera(*pair) for pair in zip(cameras, viewmats, strict=True)]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "RGB+ED"])
@pytest.mark.parametrize("sh_degree", [None, 3])
def test_gradients_of_poses_are_those_of_autograd(render_mode, sh_degree, packed):
    inputs = leaves(CAMERAS, plain=sh_degree is None)
    antialiased = render_mode != "D"
    rasterize_mode = "antialiased" if antialiased else "classic"
    options = {"render_mode": render_mode, "sh_degree": sh_degree}
    places = of_cameras(CAMERAS)
    viewmats = places["viewmats"].requires_grad_()
    got = draw_at(places, inputs, packed=packed, rasterize_mode=rasterize_mode, **options)[:2]
    wanted = expected(inputs, posed(CAMERAS, viewmats), antialiased=antialiased, **options)
    of_all = [viewmats, *inputs]
    wanted_gradients = gradients(weighted_sum(*wanted), of_all)
    assert (wanted_gradients[0].abs().amax((1, 2)) > 0).all()
    for g, w in zip(gradients(weighted_sum(*got), of_all), wanted_gradients, strict=True):
        assert_close(g.numpy(), w.numpy(), GRADIENT_DOUBLE)


def test_gradients_of_poses_in_single_precision(device):
    results = []
    for dtype, target in ((torch.float64, "cpu"), (torch.float32, device)):
        inputs = leaves(CAMERAS, 200, dtype=dtype, device=target)
        places = of_cameras(CAMERAS, dtype=dtype, device=target)
        places["viewmats"].requires_grad_()
        pictures, alphas, _ = draw_at(places, inputs, sh_degree=3, render_mode="RGB+ED")
        weighted_sum(pictures, alphas).backward()
        assert places["viewmats"].grad.device == places["viewmats"].device
        results.append([t.grad.cpu().double() for t in (places["viewmats"], *inputs[:5])])
    for double, single in zip(*results, strict=True):
        assert_gradients_agree(single, double, GRADIENT_FLOAT)


def test_a_pose_is_found_from_a_picture(device):
    *shape, colors, _ = leaves([FIRST], 60, dtype=torch.float32, device=device)
    places = of_cameras([FIRST], dtype=torch.float32, device=device)
    fixed = {"Ks": places["Ks"], "width": 23, "height": 19, "sh_degree": 3}
    tensors = [t.detach() for t in (*shape, colors)]
    target = rasterization(*tensors, places["viewmats"], **fixed)[0]
    shift = torch.tensor([0.05, -0.04, 0.06], device=device, requires_grad=True)
    optimizer = torch.optim.Adam([shift], lr=4e-3)
    first = shift.detach().norm()
    for _ in range(60):
        moved = torch.zeros(1, 4, 4, device=device)
        moved[0, :3, 3] = shift
        picture = rasterization(*tensors, places["viewmats"] + moved, **fixed)[0]
        optimizer.zero_grad()
        (picture - target).square().sum().backward()
        optimizer.step()
    assert shift.detach().norm() < 0.2 * first


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("clip", [{}, {"radius_clip": 2.0}], ids=["all", "clipped"])
def test_cameras_together_give_the_bits_of_each_alone(device, packed, clip):
    """The poses are trained, because on a GPU, a single camera with a fixed pose has
    separate kernels."""
    options = {"packed": packed, "absgrad": True, "sh_degree": 3, "render_mode": "RGB+ED", **clip}
    inputs = leaves(CAMERAS, 600, dtype=torch.float32, device=device)
    places = of_cameras(CAMERAS, dtype=torch.float32, device=device)
    viewmats = places["viewmats"].requires_grad_()
    pictures, alphas, info = draw_at(places, inputs, **options)
    info["means2d"].retain_grad()
    weights = [torch.rand_like(part) for part in (pictures, alphas)]
    (pictures * weights[0]).sum().add((alphas * weights[1]).sum()).backward()
    sums = None
    rows = 0
    for c, camera in enumerate(CAMERAS):
        alone = [*(t.detach().requires_grad_() for t in inputs[:5]), inputs[5][c : c + 1].detach()]
        place = of_cameras([camera], dtype=torch.float32, device=device)
        place["viewmats"].requires_grad_()
        picture, alpha, info_alone = draw_at(place, alone, **options)
        assert torch.equal(pictures[c], picture[0])
        assert torch.equal(alphas[c], alpha[0])
        info_alone["means2d"].retain_grad()
        loss = (picture[0] * weights[0][c]).sum() + (alpha[0] * weights[1][c]).sum()
        loss.backward()
        assert torch.equal(viewmats.grad[c], place["viewmats"].grad[0])
        grads = [t.grad for t in alone[:5]]
        sums = grads if sums is None else [a + b for a, b in zip(sums, grads, strict=True)]
        of_camera = c
        if packed:
            of_camera = slice(rows, rows + len(info_alone["means2d"]))
            rows = of_camera.stop
        for name in ("grad", "absgrad"):
            got = getattr(info["means2d"], name)[of_camera]
            assert torch.equal(got, getattr(info_alone["means2d"], name).view(got.shape))
    for name, t, wanted in zip(scenes.NAMES, inputs[:5], sums, strict=True):
        # each camera has its own opacities, and torch adds their gradients
        if clip and name == "opacities":
            torch.testing.assert_close(t.grad, wanted)
        else:
            assert torch.equal(t.grad, wanted)


@pytest.mark.parametrize("packed", [False, True])
def test_a_camera_with_a_fixed_pose_gives_the_same(device, packed):
    """The picture has the same bits. On a GPU, the last bits of gradients may differ,
    because other kernels compute them, with contraction."""
    options = {"packed": packed, "absgrad": True, "sh_degree": 3, "render_mode": "RGB+ED"}
    results = []
    for trains_pose in (False, True):
        inputs = leaves([FIRST], 600, dtype=torch.float32, device=device)
        places = of_cameras([FIRST], dtype=torch.float32, device=device)
        places["viewmats"].requires_grad_(trains_pose)
        pictures, alphas, info = draw_at(places, inputs, **options)
        info["means2d"].retain_grad()
        weighted_sum(pictures, alphas).backward()
        centers = info["means2d"]
        found = [*(t.grad for t in inputs), centers.grad, centers.absgrad]
        results.append((pictures, alphas, [gradient.cpu().double() for gradient in found]))
    fixed, trained = results
    assert torch.equal(fixed[0], trained[0])
    assert torch.equal(fixed[1], trained[1])
    for got, wanted in zip(fixed[2], trained[2], strict=True):
        assert_gradients_agree(got, wanted, GRADIENT_FLOAT)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("for_each_camera", [False, True], ids=["shared", "for each"])
def test_sets_of_gaussians_are_drawn_apart(device, packed, for_each_camera):
    """The batch dimensions (2, 2) mean four sets with two cameras each."""
    cameras = CAMERAS[:2]
    sets = [
        leaves(cameras, 40, sh_degree=1, dtype=torch.float32, device=device, seed=seed)
        for seed in range(4)
    ]
    if for_each_camera:
        for one in sets:
            one[4] = torch.stack([one[4], 0.5 * one[4]]).detach().requires_grad_()
    together = [
        torch.stack([t.detach() for t in kind]).unflatten(0, (2, 2)).requires_grad_()
        for kind in zip(*sets, strict=True)
    ]
    places = of_cameras(cameras, dtype=torch.float32, device=device)
    viewmats = places["viewmats"].expand(2, 2, 2, 4, 4).clone().requires_grad_()
    options = {"packed": packed, "sh_degree": 1, "radius_clip": 1.0}
    pictures, alphas, info = rasterization(
        *together[:5],
        viewmats,
        places["Ks"].expand(2, 2, 2, 3, 3),
        places["width"],
        places["height"],
        backgrounds=together[5],
        **options,
    )
    assert pictures.shape == (2, 2, 2, 19, 23, 3)
    assert alphas.shape == (2, 2, 2, 19, 23, 1)
    assert (info["n_batches"], info["n_cameras"]) == (4, 2)
    weights = torch.rand_like(pictures)
    grads = torch.autograd.grad((pictures * weights).sum(), [viewmats, *together])
    first = 0
    for number, one in enumerate(sets):
        index = divmod(number, 2)
        places["viewmats"] = places["viewmats"].detach().requires_grad_()
        picture, alpha, of_set = draw_at(places, one, **options)
        assert torch.equal(pictures[index], picture)
        assert torch.equal(alphas[index], alpha)
        alone = torch.autograd.grad((picture * weights[index]).sum(), [places["viewmats"], *one])
        for g, w in zip(grads, alone, strict=True):
            assert torch.equal(g[index], w)
        for name in ("means2d", "depths", "conics", "opacities", "radii"):
            part = slice(first, first + len(of_set[name])) if packed else index
            rows = info[name][part]
            assert torch.equal(rows, of_set[name])
        if packed:
            ids = info["batch_ids"][first : first + len(of_set["depths"])]
            assert (ids == number).all()
            first += len(of_set["depths"])


@pytest.mark.gpu
def test_cameras_that_are_drawn_in_parts_give_the_same():
    cameras = [
        scenes.camera(2048, 2048, fx=1500.0, pose=_near(seed)) for seed in range(3)
    ]  # two of them fit into a part
    inputs = leaves(cameras, 300, sh_degree=1, dtype=torch.float32, device="cuda")
    places = of_cameras(cameras, dtype=torch.float32, device="cuda")
    places["viewmats"].requires_grad_()
    picture, _, _ = draw_at(places, inputs, sh_degree=1)
    together = torch.autograd.grad(picture.square().sum(), [places["viewmats"], *inputs[:5]])
    sums = None
    for c, camera in enumerate(cameras):
        place = of_cameras([camera], dtype=torch.float32, device="cuda")
        place["viewmats"].requires_grad_()
        one = [*inputs[:5], inputs[5][c : c + 1]]
        alone, _, _ = draw_at(place, one, sh_degree=1)
        assert torch.equal(picture[c], alone[0])
        grads = torch.autograd.grad(alone.square().sum(), [place["viewmats"], *inputs[:5]])
        assert torch.equal(together[0][c], grads[0][0])
        of_inputs = list(grads[1:])
        sums = of_inputs if sums is None else [a + b for a, b in zip(sums, of_inputs, strict=True)]
    for g, w in zip(together[1:], sums, strict=True):
        assert torch.equal(g, w)


# The dict of intermediate values.


@pytest.fixture
def located(monkeypatch):
    """Return the tensors of centres in the reference, one per picture. They keep their
    gradients."""
    found, project = [], rasterize_torch.project

    def remember(*arguments):
        result = project(*arguments)
        result[0].retain_grad()
        found.append(result)
        return result

    monkeypatch.setattr(rasterize_torch, "project", remember)
    return found


def test_centers_take_the_gradient_of_the_pictures(located):
    inputs = leaves(CAMERAS)
    pictures, alphas, info = draw(inputs, CAMERAS, sh_degree=3, packed=False)
    info["means2d"].retain_grad()
    weighted_sum(pictures, alphas).backward()
    weighted_sum(*expected(inputs, CAMERAS, sh_degree=3)).backward()
    for c, (centers, *_) in enumerate(located):
        assert centers.grad.abs().max() > 0
        assert_close(info["means2d"].grad[c].numpy(), centers.grad.numpy(), GRADIENT_DOUBLE)


def test_absgrad_sums_the_sizes_of_what_pixels_give(located):
    inputs = leaves(CAMERAS[:2], 12)
    pictures, alphas, info = draw(inputs, CAMERAS[:2], sh_degree=3, packed=False, absgrad=True)
    rng = np.random.default_rng(0)
    weights = [torch.from_numpy(rng.normal(size=tuple(p.shape))) for p in (pictures, alphas)]
    sum((w * p).sum() for w, p in zip(weights, (pictures, alphas), strict=True)).backward()
    wanted = expected(inputs, CAMERAS[:2], sh_degree=3)
    pixels = sum((w * p).sum(-1) for w, p in zip(weights, wanted, strict=True))
    for c, (centers, *_) in enumerate(located):
        sizes = torch.zeros_like(centers)
        for pixel in pixels[c].flatten():
            sizes += torch.autograd.grad(pixel, centers, retain_graph=True)[0].abs()
        assert_close(info["means2d"].absgrad[c].numpy(), sizes.numpy(), GRADIENT_DOUBLE)


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_dict_says_where_gaussians_are(device, located, rasterize_mode):
    inputs = leaves(CAMERAS, 60, dtype=torch.float32, device=device)
    options = {"sh_degree": 3, "packed": False, "rasterize_mode": rasterize_mode}
    info = draw(inputs, CAMERAS, **options)[2]
    info = {
        name: v.detach().cpu().double() if torch.is_tensor(v) else v for name, v in info.items()
    }
    doubles = leaves(CAMERAS, 60)
    expected(doubles, CAMERAS, sh_degree=3)
    for c, (camera, (centers, covariance, depth, compensation, _)) in enumerate(
        zip(CAMERAS, located, strict=True)
    ):
        a, b, d, determinant = covariance.detach().unbind(1)
        opacity = doubles[3].detach()
        if rasterize_mode == "antialiased":
            opacity = opacity * compensation.detach()
        reach = (2 * (255 * opacity).clamp(min=1e-30).log()).clamp(min=0).sqrt()
        half = torch.stack([reach * a.sqrt(), reach * d.sqrt()], dim=1)
        x, y = centers.detach().unbind(1)
        is_seen = (depth >= camera.near) & (opacity >= 1 / 255)
        is_seen &= (x + half[:, 0].ceil() > 0) & (x - half[:, 0].ceil() < camera.width)
        is_seen &= (y + half[:, 1].ceil() > 0) & (y - half[:, 1].ceil() < camera.height)
        assert 0 < is_seen.sum() < len(is_seen)
        radii = torch.where(is_seen[:, None], half.ceil(), 0.0)
        at_a_step = ((half - half.round()).abs() < 1e-3).any(1)
        assert at_a_step.sum() < 5
        np.testing.assert_array_equal(info["radii"][c][~at_a_step], radii[~at_a_step])
        conics = torch.stack([d, -b, a], dim=1) / determinant[:, None]
        for name, value in (
            ("means2d", centers),
            ("depths", depth),
            ("conics", conics),
            ("opacities", opacity),
        ):
            shown = torch.where(is_seen.view(-1, *[1] * (value.ndim - 1)), value.detach(), 0.0)
            np.testing.assert_allclose(info[name][c], shown, rtol=1e-4, atol=1e-4, err_msg=name)
    assert (info["width"], info["height"], info["n_cameras"]) == (23, 19, 3)
    assert info["camera_ids"] is info["gaussian_ids"] is None


def test_packed_dict_holds_the_pairs_in_sight(device):
    results = {}
    for packed in (True, False):
        inputs = leaves(CAMERAS, 60, dtype=torch.float32, device=device)
        pictures, alphas, info = draw(inputs, CAMERAS, sh_degree=3, packed=packed, absgrad=True)
        info["means2d"].retain_grad()
        weighted_sum(pictures, alphas).backward()
        info |= {"grad": info["means2d"].grad, "absgrad": info["means2d"].absgrad}
        results[packed] = info, [tensor.grad for tensor in inputs]
    (of_pairs, got), (of_all, wanted) = results[True], results[False]
    is_seen = (of_all["radii"] > 0).all(-1)
    ids = torch.where(is_seen)
    for name, found in zip(("camera_ids", "gaussian_ids"), ids, strict=True):
        np.testing.assert_array_equal(of_pairs[name].cpu(), found.cpu())
    for name in ("means2d", "depths", "conics", "opacities", "radii", "grad", "absgrad"):
        np.testing.assert_array_equal(
            of_pairs[name].detach().cpu(), of_all[name][ids].detach().cpu()
        )
    for g, w in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(g.cpu(), w.cpu())
    hidden = of_all["grad"][~is_seen]
    assert hidden.numel() > 0
    assert not hidden.any()


@pytest.mark.parametrize(
    ("clip", "is_kept"),
    [
        ({"far_plane": 2.5}, lambda info: (info["depths"] > 0) & (info["depths"] <= 2.5)),
        ({"near_plane": 2.0}, lambda info: info["depths"] >= 2.0),
        ({"radius_clip": 5.0}, lambda info: (info["radii"] > 5).any(-1)),
    ],
    ids=["far_plane", "near_plane", "radius_clip"],
)
def test_what_is_clipped_is_not_there(device, clip, is_kept):
    """One camera may clip a gaussian that another camera shows."""
    inputs = leaves(CAMERAS, 60, dtype=torch.float32, device=device)
    kept = is_kept(draw(inputs, CAMERAS, sh_degree=3, packed=False)[2])
    assert 0 < kept.sum() < kept.numel()
    pictures, alphas, info = draw(inputs, CAMERAS, sh_degree=3, packed=False, **clip)
    np.testing.assert_array_equal((info["radii"] > 0).all(-1).cpu(), kept.cpu())
    for c, camera in enumerate(CAMERAS):
        few = [*(t[kept[c]] for t in inputs[:5]), inputs[5][c : c + 1]]
        picture, alpha, _ = draw(few, [camera], sh_degree=3)
        np.testing.assert_array_equal(pictures[c].detach().cpu(), picture[0].detach().cpu())
        np.testing.assert_array_equal(alphas[c].detach().cpu(), alpha[0].detach().cpu())
        alone = torch.autograd.grad(pictures[c].sum(), inputs[:5], retain_graph=True)
        for g, w in zip(alone, torch.autograd.grad(picture.sum(), inputs[:5]), strict=True):
            assert_gradients_agree(g.cpu(), w.cpu(), GRADIENT_FLOAT)


def test_nothing_is_drawn_of_no_gaussians(device):
    inputs = [
        t[:0].detach().requires_grad_() for t in leaves(CAMERAS, dtype=torch.float32, device=device)
    ]
    inputs[5] = torch.full((3, 3), 0.25, device=device)
    pictures, alphas, info = draw(inputs, CAMERAS, sh_degree=3)
    assert (pictures == 0.25).all()
    assert not alphas.any()
    assert info["means2d"].shape == (0, 2)
    pictures.sum().backward()
    assert inputs[0].grad.shape == (0, 3)


def test_gradients_may_be_taken_twice():
    inputs = leaves(CAMERAS)
    pictures, alphas, _ = draw(inputs, CAMERAS, sh_degree=3)
    loss = weighted_sum(pictures, alphas)
    first = torch.autograd.grad(loss, inputs, retain_graph=True)
    for f, s in zip(first, torch.autograd.grad(loss, inputs), strict=True):
        assert torch.equal(f, s)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", ["means2d", "depths"])
@pytest.mark.parametrize("with_picture", [False, True])
def test_a_loss_that_would_be_lost_is_refused(name, packed, with_picture):
    inputs = leaves(CAMERAS)
    pictures, _, info = draw(inputs, CAMERAS, sh_degree=3, packed=packed)
    loss = info[name].square().sum() + (pictures.sum() if with_picture else 0)
    with pytest.raises(ValueError, match="means2d, depths: expected a loss on pictures only"):
        loss.backward()


def test_no_call_outlives_its_results():
    inputs = leaves(CAMERAS)
    gc.disable()
    try:
        pictures, alphas, info = draw(inputs, CAMERAS, sh_degree=3, absgrad=True)
        pictures.sum().backward()
        watched = [
            weakref.ref(pictures),
            weakref.ref(info["means2d"]),
            weakref.ref(info["means2d"].grad_fn),
        ]
        del pictures, alphas, info
        assert [ref() for ref in watched] == [None] * 3
    finally:
        gc.enable()


# Arguments that are rejected.


class Shutter(Enum):
    """Its text is that of gsplat's RollingShutterType."""

    GLOBAL, TOP_TO_BOTTOM = range(2)

    def __str__(self):
        return f"RollingShutterType.{self.name}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera_model": "fisheye"}, "camera_model: 'fisheye' is not supported; only pinholes"),
        ({"radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs: .* is not supported"),
        ({"rolling_shutter": Shutter.TOP_TO_BOTTOM}, "rolling_shutter: .* is not supported"),
        ({"with_ut": True}, "with_ut: True is not supported"),
        ({"with_eval3d": True}, "with_eval3d: True is not supported"),
        ({"covars": torch.zeros(25, 3, 3)}, "covars: .* pass quats and scales"),
        ({"sparse_grad": True}, "sparse_grad: .* gradients are always dense"),
        ({"distributed": True}, "distributed: .* train on one device"),
        ({"render_mode": "RGBD"}, "render_mode: expected 'RGB' or 'D'"),
        ({"rasterize_mode": "sharp"}, "rasterize_mode: expected 'classic'"),
        ({"eps2d": -1}, "eps2d: expected a variance"),
        ({"sh_degree": 4}, "sh_degree: expected at most 3"),
        ({"sh_degree": None}, r"colors: expected shape \(25, 3\).* got \(25, 16, 3\)"),
        ({"backgrounds": torch.zeros(1, 4)}, r"backgrounds: expected shape \(1, 3\)"),
    ],
)
def test_what_is_not_done_is_an_error_that_names_it(options, message):
    *shape, colors, _ = leaves([FIRST])
    with pytest.raises(ValueError, match=message):
        rasterization(*shape, colors, **{**of_cameras([FIRST]), "sh_degree": 3, **options})


def test_what_asks_for_nothing_is_accepted():
    *shape, colors, _ = leaves([FIRST])
    nothing = dict.fromkeys(("covars", "radial_coeffs", "viewmats_rs", "ftheta_coeffs"))
    nothing |= dict.fromkeys(("sparse_grad", "distributed", "with_ut", "with_eval3d"), False)
    nothing |= {"camera_model": "pinhole", "rolling_shutter": Shutter.GLOBAL}
    nothing |= {"tile_size": 16, "channel_chunk": 32, "segmented": True}
    assert len(rasterization(*shape, colors, **of_cameras([FIRST]), sh_degree=3, **nothing)) == 3


def test_wrong_kinds_are_refused():
    *shape, colors, _ = leaves([FIRST])
    with pytest.raises(TypeError, match="quats: expected a torch tensor, got ndarray"):
        rasterization(
            shape[0], shape[1].detach().numpy(), *shape[2:], colors, **of_cameras([FIRST])
        )
    with pytest.raises(TypeError, match="glossy: expected an argument of gsplat"):
        rasterization(*shape, colors, **of_cameras([FIRST]), sh_degree=3, glossy=True)
    places = of_cameras(CAMERAS[:2])
    places["Ks"] = places["Ks"][:1]
    with pytest.raises(ValueError, match=r"Ks: expected as many as viewmats \(2\), got 1"):
        rasterization(*shape, colors, **places, sh_degree=3)
    places = of_cameras(CAMERAS[:2])
    places["viewmats"] = places["viewmats"][None]
    with pytest.raises(ValueError, match=r"viewmats: expected shape \(C, 4, 4\), got \(1, 2, 4, 4"):
        rasterization(*shape, colors, **places, sh_degree=3)
    places = of_cameras(CAMERAS[:2])
    with pytest.raises(ValueError, match=r"quats: expected the batch dimensions \(1,\) of means"):
        rasterization(shape[0][None], *shape[1:], colors, **places, sh_degree=3)
    places["viewmats"][1, 0, 0] = 2
    with pytest.raises(ValueError, match="camera 1: expected a rotation"):
        rasterization(*shape, colors, **places, sh_degree=3)
    with pytest.raises(
        NotImplementedError, match="rasterization_2dgs: 2D gaussians are not supported"
    ):
        rasterization_2dgs(*shape, colors)


# gsplat's strategies.


@pytest.fixture
def gsplat(monkeypatch):
    """Return the module gsplat. Its CUDA operations that the strategies use are
    replaced by torch operations."""
    gsplat = pytest.importorskip("gsplat")
    from gsplat.strategy import ops

    def covariances(quats, scales, **_):
        rotation = ops.normalized_quat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
        half = rotation * scales[:, None]
        return half @ half.transpose(1, 2), None

    def relocated(opacities, scales, ratios, binoms):
        return 1 - (1 - opacities) ** (1 / ratios), scales

    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", covariances)
    monkeypatch.setattr(ops, "compute_relocation", relocated)
    return gsplat


class Trainer:
    """Trains a few gaussians so that they look like pictures of others."""

    def __init__(self, device, *, packed, absgrad=False):
        self.cameras = [
            scenes.camera(48, 40),
            *(scenes.camera(48, 40, pose=_near(seed)) for seed in (1, 2)),
        ]
        self.options = {"packed": packed, "absgrad": absgrad, "sh_degree": 1}
        *target, _ = leaves(
            self.cameras, 40, sh_degree=1, dtype=torch.float32, device=device, seed=5
        )
        with torch.no_grad():
            self.target = self.draw(*target)[0]
        *first, _ = leaves(
            self.cameras, 60, sh_degree=1, dtype=torch.float32, device=device, seed=6
        )
        first[2] = first[2].log()
        first[3] = torch.logit(first[3].clamp(0.1, 0.9))
        first[3][:10] = -8  # so faint that it is pruned
        names = ("means", "quats", "scales", "opacities", "sh")
        self.params = {n: torch.nn.Parameter(t.detach()) for n, t in zip(names, first, strict=True)}
        self.optimizers = {n: torch.optim.Adam([p], lr=5e-3) for n, p in self.params.items()}
        self.losses = []

    def draw(self, *tensors):
        places = of_cameras(self.cameras, dtype=tensors[0].dtype, device=tensors[0].device)
        return rasterization(*tensors, **places, **self.options)

    def step(self, before_backward=lambda info: None):
        p = self.params
        pictures, _, info = self.draw(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), p["sh"]
        )
        loss = (pictures - self.target).abs().mean()
        before_backward(info)
        loss.backward()
        self.losses.append(loss.item())
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        return info

    def assert_trained(self):
        assert np.mean(self.losses[-5:]) < 0.8 * np.mean(self.losses[:5])
        assert all(torch.isfinite(p).all() for p in self.params.values())


def _near(seed):
    viewmat = np.eye(4)
    viewmat[:3, 3] = np.random.default_rng(seed).uniform(-0.2, 0.2, 3)
    return viewmat


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_default_strategy_grows_and_prunes(gsplat, device, packed, absgrad):
    trainer = Trainer(device, packed=packed, absgrad=absgrad)
    options = {
        "refine_start_iter": 5,
        "refine_every": 10,
        "grow_grad2d": 1e-3,
        "refine_scale2d_stop_iter": 100,
    }
    strategy = gsplat.DefaultStrategy(
        absgrad=absgrad, prune_scale2d=10, grow_scale3d=0.05, **options
    )
    strategy.check_sanity(trainer.params, trainer.optimizers)
    state = strategy.initialize_state()
    sizes = []
    for step in range(60):

        def before(info, step=step):
            strategy.step_pre_backward(trainer.params, trainer.optimizers, state, step, info)

        info = trainer.step(before)
        faint = trainer.params["opacities"].sigmoid().min()
        strategy.step_post_backward(
            trainer.params, trainer.optimizers, state, step, info, packed=packed
        )
        sizes.append(len(trainer.params["means"]))
        if step == 10:
            assert faint < strategy.prune_opa <= trainer.params["opacities"].sigmoid().min()
    assert sizes[9] == 60
    assert max(sizes) > 60
    assert {len(p) for p in trainer.params.values()} == {sizes[-1]}
    trainer.assert_trained()


def test_default_strategy_sees_the_same_packed_or_not(gsplat, device):
    states = []
    for packed in (False, True):
        trainer, strategy = Trainer(device, packed=packed), gsplat.DefaultStrategy()
        state = strategy.initialize_state()
        info = trainer.step(lambda info: info["means2d"].retain_grad())
        strategy.step_post_backward(
            trainer.params, trainer.optimizers, state, 1, info, packed=packed
        )
        states.append(state)
    for name in ("grad2d", "count"):
        assert states[0][name].max() > 0
        torch.testing.assert_close(states[0][name], states[1][name])


def test_mcmc_strategy_relocates_and_adds(gsplat, device):
    trainer = Trainer(device, packed=False)
    strategy = gsplat.MCMCStrategy(cap_max=70, refine_start_iter=5, refine_every=10, noise_lr=1.0)
    strategy.check_sanity(trainer.params, trainer.optimizers)
    state = strategy.initialize_state()
    for step in range(60):
        info = trainer.step()
        strategy.step_post_backward(trainer.params, trainer.optimizers, state, step, info, lr=1e-4)
        if step == 10:
            assert trainer.params["opacities"].sigmoid().min() >= strategy.min_opacity
    assert {len(p) for p in trainer.params.values()} == {70}
    trainer.assert_trained()
