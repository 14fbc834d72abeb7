"""Frames on CUDA equal the pictures of the CPU, whatever the stream, the buffers and
the earlier frames."""

import gc
from dataclasses import replace

import numpy as np
import pytest

import scenes
import scenes_lod
from devices import free_memory, host
from frames import CAMERA, Renderer, assert_like_cpu, assert_same_bytes, composed_scene, render
from v3dg import Camera, Gaussians, Scene, rasterize, select

pytestmark = pytest.mark.gpu

BACKGROUND = (0.1, 0.2, 0.3)
# Parts of a frame's memory that are not from the pool.
IN_PLACE = {"records", "entries", "scratch", "large"}


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("tolerance", [0.0, 2.0, np.inf])
def test_scene_looks_as_on_the_cpu(sh_degree, tolerance):
    scene = composed_scene(np.random.default_rng(sh_degree), sh_degree)
    expected = render(scene, CAMERA, tolerance=tolerance, background=BACKGROUND, device="cpu")
    image = render(scene, CAMERA, tolerance=tolerance, background=BACKGROUND, device="cuda")
    assert_like_cpu(image, expected)


@pytest.mark.parametrize("sh_degree", [0, 3])
@pytest.mark.parametrize("tops", [5, 20, 150])
def test_neighbours_that_share_a_cluster_look_as_on_the_cpu(sh_degree, tops):
    """The instances are so far away that their coarsest clusters are drawn. Instances
    are drawn alone, several at once, and of two bundles in turn."""
    rng = np.random.default_rng(tops)
    bundles = [
        scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, n, sh_degree=sh_degree), tops, past_root=0)
        for n in (2 * tops, 3 * tops)
    ]
    scene = Scene()
    for block in range(12):
        count = int(rng.integers(1, 40))
        scene.add(
            bundles[block % 2],
            positions=8 * rng.normal(size=(count, 3)),
            quaternions=rng.normal(size=(count, 4)),
            scales=np.exp(rng.normal(size=count) - 1),
        )
    expected = render(scene, CAMERA, tolerance=np.inf, background=BACKGROUND, device="cpu")
    image = render(scene, CAMERA, tolerance=np.inf, background=BACKGROUND, device="cuda")
    assert_like_cpu(image, expected)
    one_by_one = select(scene, CAMERA, tolerance=np.inf, device="cuda")
    assert_same_bytes(
        image, render(scene, CAMERA, cut=one_by_one, background=BACKGROUND, device="cuda")
    )


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_asset_looks_as_on_the_cpu(sh_degree):
    asset = scenes_lod.blob(np.random.default_rng(sh_degree), 5000, sh_degree=sh_degree)
    assert_like_cpu(render(asset, CAMERA, device="cuda"), render(asset, CAMERA, device="cpu"))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 3.0, 100.0])
def test_gaussians_of_any_size(scale):
    """The sizes range from gaussians that miss every pixel centre to gaussians that
    cover every tile."""
    rng = np.random.default_rng(1)
    blob = scenes_lod.blob(rng, 600)
    scales = (scale * np.exp(0.3 * rng.normal(size=(600, 3)))).astype(np.float32)
    asset = Gaussians(blob.means, blob.quats, scales, 0.3 * blob.opacities, blob.sh)
    assert_like_cpu(render(asset, CAMERA, device="cuda"), render(asset, CAMERA, device="cpu"))


@pytest.mark.parametrize("size", [(2100, 1500), (6000, 16)])
def test_gaussians_over_thousands_of_tiles(size):
    """A few neighbouring gaussians cover more tiles than are listed together."""
    rng = np.random.default_rng(4)
    width, height = size
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), 0.9, width=width, height=height)
    blob = scenes_lod.blob(rng, 400)
    scales = np.exp(rng.uniform(-6, 1, (400, 3))).astype(np.float32)
    asset = Gaussians(
        blob.means + np.float32([0, 0, 4]), blob.quats, scales, 0.2 * blob.opacities, blob.sh
    )
    expected = render(asset, camera, device="cpu")
    assert_like_cpu(render(asset, camera, device="cuda"), expected)
    assert (host(expected.alpha) > 0.1).mean() > 0.5


@pytest.mark.parametrize(
    "depths", ["spread", "one before all", "equal", "in one step", "on sheets"]
)
@pytest.mark.parametrize("count", [3000, 60_000])
def test_tiles_blended_in_parts_have_the_same_bytes(depths, count):
    """A few tiles have most of the entries. A frame that keeps a tape does not blend
    tiles in parts."""
    rng = np.random.default_rng(count)
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), 0.9, width=640, height=400)
    ranges = {"spread": (2, 3), "one before all": (4, 4.1), "on sheets": (2, 2.0001)}
    depth = rng.uniform(*ranges.get(depths, (2, 2)), count)
    if depths == "one before all":
        depth[0] = 0.02
    if depths == "in one step":  # the depths by which lists are sorted
        depth = np.where(rng.random(count) < 0.5, depth, np.nextafter(np.float32(2), np.float32(3)))
    if depths == "on sheets":
        depth += rng.integers(0, 7, count) ** 2
    asset = scenes.gaussians(
        np.stack([*(rng.uniform(-0.15, 0.15, (2, count)) * depth), depth], axis=1),
        scales=rng.uniform(0.001, 0.01, (count, 3)),
        opacities=rng.uniform(0.05, 0.9, count),
        sh=rng.normal(0, 1, (count, 1, 3)).astype(np.float32),
    ).torch("cuda")
    in_parts = rasterize(asset, camera, background=BACKGROUND)
    kept = replace(asset, means=asset.means.clone().requires_grad_())
    whole = rasterize(kept, camera, background=BACKGROUND)
    assert whole.color.requires_grad
    assert_same_bytes(in_parts, whole)
    assert host(whole.alpha).max() > 0.9


@pytest.mark.parametrize("millions", [70, 140])
def test_frames_with_room_for_many_records_have_the_same_bytes(millions):
    """Lists of such frames have fewer bits for the depth. Many depths here are equal,
    or differ by one float."""
    rng = np.random.default_rng(millions)
    blob = scenes_lod.blob(rng, 20_000, size=0.5)
    faint = replace(blob, opacities=np.full(len(blob), 0.003, np.float32))  # too faint for a record
    one, other = (scenes_lod.lod_bundle(rng, asset, 512) for asset in (faint, blob))
    scene, alone = Scene(), Scene()
    count = 51 * millions
    scene.add(one, positions=rng.uniform(-0.5, 0.5, (count, 3)), scales=np.full(count, 1e-4))
    for shown in (scene, alone):
        shown.add(other, positions=np.random.default_rng(0).integers(-2, 3, (40, 3)) * 2e-7)
    image = render(scene, CAMERA, tolerance=0.0, device="cuda")
    assert image.stats.gaussians_selected > 1e6 * millions
    assert_same_bytes(image, render(alone, CAMERA, tolerance=0.0, device="cuda"))


def test_poisoned_gaussians_are_left_out():
    asset = scenes_lod.blob(np.random.default_rng(2), 400)
    poisoned = {name: np.array(getattr(asset, name)) for name in scenes.NAMES}
    for i, name in enumerate(scenes.NAMES):
        for k, value in enumerate((np.nan, np.inf, -np.inf, 0.0, 1e30)):
            poisoned[name][40 * i + k] = value
    poisoned["sh"][:] = asset.sh  # a NaN colour is NaN on both devices
    subject = Gaussians(**poisoned)
    assert_like_cpu(render(subject, CAMERA, device="cuda"), render(subject, CAMERA, device="cpu"))


@pytest.mark.parametrize(
    "subject", [Scene(), scenes_lod.blob(np.random.default_rng(0), 0)], ids=["scene", "asset"]
)
def test_nothing_gives_the_background(subject):
    image = render(subject, CAMERA, background=BACKGROUND, device="cuda")
    assert (host(image.color) == np.float32(BACKGROUND)).all()
    assert not host(image.alpha).any()
    assert image.stats.gaussians_selected == 0


def test_buffers_that_were_too_small_leave_no_trace():
    """The first frame of a renderer has hardly any memory. Later frames have as much as
    earlier frames needed."""
    subject = composed_scene(np.random.default_rng(3))
    renderer = Renderer(subject)
    first, second = (renderer.render(CAMERA, tolerance=0.0) for _ in range(2))
    assert first.stats.gaussians_selected > 20_000
    third = renderer.render(CAMERA, tolerance=0.0)
    assert_same_bytes(first, third)
    assert_same_bytes(second, third)


def memory_of(renderer):
    return renderer._frame.chosen(renderer.subject).core.memory()


def test_memory_of_a_frame_is_told_by_part():
    renderer = Renderer(composed_scene(np.random.default_rng(4)), device="cuda")
    count = renderer.render(CAMERA, tolerance=0.0).stats.gaussians_selected
    parts = memory_of(renderer)
    reserved, used = parts.pop("pool, reserved"), parts.pop("pool, used")
    assert parts["records"] >= 40 * count > 0
    assert sum(parts[name] for name in parts.keys() - IN_PLACE) <= used <= reserved


def crowd():
    """A scene of two million gaussians."""
    rng = np.random.default_rng(4)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 20_000), 512)
    scene = Scene()
    scene.add(bundle, positions=rng.uniform(-0.5, 0.5, (100, 3)))
    return scene


def drawn(renderer):
    """Return the number of gaussians of a finished frame that draws all gaussians."""
    return renderer.render(CAMERA, tolerance=0.0).stats.gaussians_selected


def test_buffers_exceed_a_frame_by_a_sixteenth():
    renderer = Renderer(crowd(), device="cuda")
    count = drawn(renderer)
    page = 2 << 20
    assert count > 1_000_000
    assert 40 * count <= memory_of(renderer)["records"] <= 40 * count * 17 / 16 + page


def test_full_device_gets_back_the_memory_of_frames():
    """There is room for one frame, but not for two."""
    scene = crowd()
    renderer = Renderer(scene, device="cuda")
    drawn(renderer)
    num_bytes = sum(memory_of(renderer)[name] for name in IN_PLACE)
    assert num_bytes > 100 << 20
    del renderer
    gc.collect()
    with free_memory(3 * num_bytes // 2):
        for _ in range(3):
            assert drawn(Renderer(scene, device="cuda")) > 1_000_000
            gc.collect()


def test_full_device_is_a_memory_error_of_a_frame():
    scene = crowd()
    expected = Renderer(scene, device="cuda").render(CAMERA, tolerance=0.0)
    renderer = Renderer(scene, device="cuda")
    renderer.render(CAMERA, tolerance=np.inf).stats  # noqa: B018  waits
    gc.collect()
    with (
        free_memory(48 << 20),
        pytest.raises(MemoryError, match=r"requested .* MiB, free: .* MiB of .* MiB"),
    ):
        drawn(renderer)
    assert_same_bytes(renderer.render(CAMERA, tolerance=0.0), expected)


def test_every_renderer_draws_the_same_bytes():
    subject = composed_scene(np.random.default_rng(4))
    assert_same_bytes(Renderer(subject).render(CAMERA), Renderer(subject).render(CAMERA))


def test_pictures_drawn_ahead_stay_apart():
    subject = composed_scene(np.random.default_rng(5))
    cameras = [scenes_lod.turned(CAMERA, np.random.default_rng(seed)) for seed in range(12)] + [
        CAMERA
    ]
    renderer = Renderer(subject)
    ahead = [renderer.render(camera, tolerance=0.0) for camera in cameras]
    for camera, image in zip(cameras, ahead, strict=True):
        assert_same_bytes(image, Renderer(subject).render(camera, tolerance=0.0))


def test_sizes_may_change_from_picture_to_picture():
    subject = composed_scene(np.random.default_rng(6))
    renderer = Renderer(subject)
    for factor in (1, 3, 2):
        camera = CAMERA.scaled(factor)
        assert_same_bytes(renderer.render(camera), Renderer(subject).render(camera))


def test_what_is_added_to_a_scene_is_drawn():
    rng = np.random.default_rng(7)
    scene = composed_scene(rng)
    render(scene, CAMERA, device="cuda")
    scene.add(scene.bundles[1], positions=(0.0, -1.0, 0.0))
    assert_like_cpu(render(scene, CAMERA, device="cuda"), render(scene, CAMERA, device="cpu"))


def test_other_streams_see_the_picture():
    import torch

    subject = composed_scene(np.random.default_rng(8))
    renderer = Renderer(subject)
    expected = renderer.render(CAMERA)
    expected.stats  # noqa: B018  waits
    streams = [torch.cuda.Stream() for _ in range(2)]
    for turn in range(6):
        with torch.cuda.stream(streams[turn % 2]):
            image = renderer.render(CAMERA)
            color = image.color.clone()
        streams[turn % 2].synchronize()
        assert torch.equal(color, expected.color)


@pytest.mark.parametrize("options", [{"tolerance": 0.0}, {"tolerance": 2.0, "fade": 1.5}])
def test_a_graph_draws_again(options):
    import torch

    subject = composed_scene(np.random.default_rng(9))
    renderer = Renderer(subject)
    expected = renderer.render(CAMERA, **options)
    count = expected.stats.gaussians_in_frustum
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        image = renderer.render(CAMERA, **options)
    # Other pictures are drawn in between. They need other buffers.
    other = renderer.render(CAMERA.scaled(4), tolerance=0.0)
    other.stats  # noqa: B018  waits
    for _ in range(3):
        image.color.zero_()
        graph.replay()
        torch.cuda.synchronize()
        assert_same_bytes(image, expected)
        assert image.stats.gaussians_in_frustum == count


def test_a_graph_of_what_was_not_drawn_before_is_refused():
    import torch

    scene, same, moved = (composed_scene(np.random.default_rng(10)) for _ in range(3))
    renderer = Renderer(scene)
    poses = 1.5 * scene.positions

    def assert_refused():
        with torch.cuda.graph(torch.cuda.CUDAGraph()):
            # torch warns about empty graphs, so enqueue something
            torch.zeros(1, device="cuda")
            with pytest.raises(RuntimeError, match=r"draw .* once before the capture"):
                renderer.render(CAMERA)

    assert_refused()
    assert_same_bytes(renderer.render(CAMERA), Renderer(same).render(CAMERA))
    scene.move(positions=poses)
    assert_refused()
    moved.move(positions=poses)
    assert_same_bytes(renderer.render(CAMERA), Renderer(moved).render(CAMERA))
