"""Cuts of the C library equal those of `v3dg.select`, and their gaussians equal those
of `Selection.gaussians`."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import c_library
from c_library import CScene, Failure, c_camera, c_instances, c_rule, missing_of, pairs_of
from partial import closed_residency, resident_scene, rule
from random_bundle import random_bundle
from scenes_lod import blob, lod_bundle, random_camera
from v3dg import Bundle, Camera, Scene, StereoCamera, select

pytestmark = pytest.mark.slow  # slow, because the library is compiled first
NUM_TRIALS = 300


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    """Return paths of small bundles with both codecs and several SH degrees, and of one
    with more clusters."""
    folder = tmp_path_factory.mktemp("bundles")
    rng = np.random.default_rng(5)
    made = [
        random_bundle(1, num_levels=4),
        random_bundle(2, num_levels=5, sh_degree=3),
        random_bundle(3, num_levels=3, sh_degree=1, codec="quantized"),
        lod_bundle(rng, blob(rng, 3000, size=1.0, sh_degree=2), 64),
        random_bundle(4, num_levels=0),
    ]
    paths = []
    for number, bundle in enumerate(made):
        paths.append(folder / f"{number}.v3dg")
        bundle.write(paths[-1])
    return paths


@pytest.fixture(scope="module")
def opened(bundles):
    """Yield the same bundles in Python and in one scene of the C library."""
    with CScene(bundles[0]) as scene:
        for path in bundles[1:]:
            scene.add_bundle(path)
        yield [Bundle.open(path) for path in bundles], scene


def placed(rng, bundles, count):
    """Return a scene of random bundles in random poses, some of them with factors."""
    scene = Scene()
    for _ in range(count):
        factors = {}
        if rng.random() < 0.3:
            factors = {"opacity": rng.choice([0.0, 0.001, 0.5]), "tint": rng.random(3)}
        scene.add(
            bundles[rng.integers(len(bundles))],
            5 * rng.normal(size=3),
            rng.normal(size=4),
            np.exp(rng.normal()),
            np.exp(rng.normal()),
            **factors,
        )
    return scene


def numbers_of(scene, bundles):
    """Return the index in `bundles` of each bundle of a scene."""
    return [bundles.index(bundle) for bundle in scene.bundles]


def any_camera(rng):
    """Return a pinhole, a lens or two eyes."""
    camera = random_camera(rng, distance=float(rng.choice([0.3, 5.0, 100.0])))
    kind = rng.integers(4)
    if kind == 0:
        return StereoCamera.of(camera, 0.1)
    arguments = (camera.viewmat, camera.K, camera.width, camera.height, camera.near)
    if kind == 1:
        values = rng.normal(0, 0.05, rng.choice([4, 5, 8]))
        return Camera(*arguments, tuple(values), "OPENCV")
    if kind == 2:
        return Camera(*arguments, tuple(rng.normal(0, 0.02, 4)), "OPENCV_FISHEYE")
    return camera


def eyes_of(camera):
    return [c_camera(eye) for eye in getattr(camera, "eyes", (camera,))]


def any_options(rng):
    """Return arguments of `select` that choose a cut."""
    options = {"min_level": int(rng.choice([0, 0, 0, 1, 9])), "cull": bool(rng.random() < 0.8)}
    if rng.random() < 0.8:
        options["tolerance"] = float(rng.choice([0, 1e-3, 0.3, 3, 50, 1e4, 1e300, np.inf]))
    if rng.random() < 0.5:
        options["budget"] = int(rng.choice([0, 20, 100, 500, 3000, 10**6]))
    if rng.random() < 0.5:
        options["fade"] = float(rng.choice([1, 1.02, 1.5, 30]))
    return options


def selected(scene, camera, options):
    """Return the cut of Python and an empty text, or None and the error message."""
    try:
        return select(scene, camera, device="cpu", **options), ""
    except ValueError as error:
        return None, str(error)


def check_same(cut, selection):
    pairs = pairs_of(cut)
    np.testing.assert_array_equal(pairs["instance"], selection.instance_ids)
    np.testing.assert_array_equal(pairs["cluster"], selection.cluster_ids)
    np.testing.assert_array_equal(pairs["weight"], selection.weights)
    assert cut.num_gaussians == selection.num_gaussians
    assert cut.tolerance_px2 == selection.tolerance
    count = pairs["num_gaussians"]
    np.testing.assert_array_equal(np.repeat(pairs["filter_px2"], count), selection.filters_px2)
    np.testing.assert_array_equal(
        np.repeat(pairs["is_antialiased"] == 1, count), selection.antialiased
    )


def test_cuts_are_those_of_python(opened):
    bundles, c_scene = opened
    num_cuts = 0
    num_over_budget = 0
    for seed in range(NUM_TRIALS):
        rng = np.random.default_rng(seed)
        scene = placed(rng, bundles, int(rng.integers(0, 12)))
        c_scene.set_instances(c_instances(scene, numbers_of(scene, bundles)))
        camera = any_camera(rng)
        options = any_options(rng)
        selection, refusal = selected(scene, camera, options)
        eyes = eyes_of(camera)
        if selection is None:
            with (
                pytest.raises(Failure) as failure,
                c_scene.cut(*eyes, rule=c_rule(**options)),
            ):
                pass
            assert failure.value.status == c_library.BUDGET
            assert str(failure.value) == refusal
            num_over_budget += 1
            continue
        with c_scene.cut(*eyes, rule=c_rule(**options)) as cut:
            check_same(cut, selection)
            num_cuts += cut.num_pairs > 0
    assert num_cuts > NUM_TRIALS / 4
    assert num_over_budget > 5


def test_the_default_rule_is_that_of_python(opened):
    bundles, c_scene = opened
    rng = np.random.default_rng(0)
    scene = placed(rng, bundles, 5)
    c_scene.set_instances(c_instances(scene, numbers_of(scene, bundles)))
    camera = random_camera(rng)
    with c_scene.cut(c_camera(camera)) as cut:
        check_same(cut, select(scene, camera, device="cpu"))


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gaussians_of_a_cut_are_those_of_python(opened, sh_degree):
    bundles, c_scene = opened
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = placed(rng, bundles, 6)
        c_scene.set_instances(c_instances(scene, numbers_of(scene, bundles)))
        camera = random_camera(rng)
        selection = select(scene, camera, tolerance=1.0, fade=1.5, device="cpu")
        expected = selection.gaussians(camera.position, device="cpu")
        with c_scene.cut(c_camera(camera), rule=c_rule(1.0, fade=1.5)) as cut:
            rows = c_scene.read_cut(cut, sh_degree, camera.position)
        names = ("means", "quats", "scales", "opacities")
        for name, values in zip(names, rows, strict=False):
            np.testing.assert_array_equal(values, getattr(expected, name), err_msg=name)
        common = min(expected.sh.shape[1], (sh_degree + 1) ** 2)
        np.testing.assert_array_equal(rows[4][:, :common], expected.sh[:, :common])
        assert not rows[4][:, common:].any()


def test_pages_are_those_of_python(opened):
    bundles, c_scene = opened
    for number, bundle in enumerate(bundles):
        info = c_scene.bundle_info(number)
        assert info.num_pages == bundle.num_pages
        assert info.num_gaussians == bundle.num_gaussians
        assert info.num_clusters == len(bundle.clusters)
        assert info.num_levels == bundle.num_levels
        assert info.num_page_bytes == bundle.page_bytes
        for page in range(bundle.num_pages):
            clusters = bundle.page_range(page)
            place = c_scene.page_info(page, number)
            assert (place.first_cluster, place.num_clusters) == (clusters.start, len(clusters))
            assert place.level == bundle.clusters.level[clusters.start]
            with open(bundle.path, "rb") as file:
                file.seek(place.offset)
                assert c_scene.read_page(page, number) == file.read(place.num_bytes)
            expected = bundle.read_page(page)
            rows = c_scene.read_gaussians(page, number, bundle.sh_degree)
            for values, wanted in zip(rows, vars(expected).values(), strict=False):
                np.testing.assert_array_equal(values, wanted)


def test_pairs_say_where_their_gaussians_are(opened):
    bundles, c_scene = opened
    scene = placed(np.random.default_rng(7), bundles, 5)
    c_scene.set_instances(c_instances(scene, numbers_of(scene, bundles)))
    with c_scene.cut(c_camera(random_camera(np.random.default_rng(7)))) as cut:
        pairs = pairs_of(cut)
    assert len(pairs) > 0
    for pair in pairs:
        bundle = scene.bundles[scene.instance_bundle[pair["instance"]]]
        page = bundle.read_page(int(pair["page"]))
        last = pair["first_in_page"] + pair["num_gaussians"]
        expected = bundle.cluster_gaussians(int(pair["cluster"]))
        np.testing.assert_array_equal(page.means[pair["first_in_page"] : last], expected.means)


def test_cuts_of_resident_pages_and_what_they_miss(opened):
    """The cut and the priorities equal those of the core. Missing pages can be loaded
    in the order of the list. Once all of them are loaded, the cut is that of all
    pages."""
    bundles, c_scene = opened
    num_missing = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        bundle_number = int(rng.integers(4))
        bundle = bundles[bundle_number]
        scene = placed(rng, [bundle], 3)
        scene.set_opacity(1.0)  # `resident_scene` places instances without factors
        scene.set_tint((1.0, 1.0, 1.0))
        c_scene.set_instances(c_instances(scene, [bundle_number]))
        camera = random_camera(rng)
        there = closed_residency(rng, bundle)
        shift = np.where(there, 0, np.iinfo(np.int64).min)
        core = resident_scene(scene, [shift])
        core_rule = rule(0.5, fade=1.02)
        expected = core.select(camera.core, core_rule)
        (needs,) = core.page_needs(camera.core, core_rule)
        c_scene.set_resident(bundle_number, there)
        with c_scene.cut(c_camera(camera), rule=c_rule(0.5, fade=1.02)) as cut:
            pairs = pairs_of(cut)
            missing = missing_of(cut)
        np.testing.assert_array_equal(pairs["cluster"], expected.cluster_ids)
        np.testing.assert_array_equal(pairs["weight"], expected.weights)
        assert there[pairs["page"]].all()
        directly_needed = np.flatnonzero((np.asarray(needs) >= 0.5) & ~there)
        assert set(directly_needed) <= set(missing["page"])
        assert (missing["priority"][1:] <= missing["priority"][:-1]).all()
        for page in missing["page"]:
            assert not there[page]
            assert there[bundle.groups.parent[page]]
            there[page] = True
            c_scene.set_resident(bundle_number, there)
        num_missing += len(missing)
        c_scene.set_resident(bundle_number, None)
    assert num_missing > 100


def test_loading_what_is_missing_leads_to_the_cut_of_all_pages(opened):
    bundles, c_scene = opened
    number = 3
    scene = placed(np.random.default_rng(0), [bundles[number]], 2)
    c_scene.set_instances(c_instances(scene, [number]))
    camera = random_camera(np.random.default_rng(1))
    there = np.zeros(bundles[number].num_pages, bool)
    there[-1] = True
    is_settled = False
    while not is_settled:
        c_scene.set_resident(number, there)
        with c_scene.cut(c_camera(camera), rule=c_rule(10.0)) as cut:
            pairs = pairs_of(cut)
            missing = missing_of(cut)
        urgent = missing["page"][missing["priority"] > 1]
        there[urgent] = True
        is_settled = len(urgent) == 0
    c_scene.set_resident(number, None)
    with c_scene.cut(c_camera(camera), rule=c_rule(10.0)) as cut:
        np.testing.assert_array_equal(pairs_of(cut), pairs)
    assert 1 < there.sum() < len(there)


def test_threads_share_a_scene(opened):
    bundles, c_scene = opened
    scene = placed(np.random.default_rng(3), bundles, 8)
    c_scene.set_instances(c_instances(scene, numbers_of(scene, bundles)))
    cameras = [random_camera(np.random.default_rng(seed)) for seed in range(40)]

    def work(camera):
        with c_scene.cut(c_camera(camera), rule=c_rule(1.0, fade=1.02)) as cut:
            return pairs_of(cut), c_scene.read_cut(cut)

    alone = [work(camera) for camera in cameras]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(work, cameras))
    for (pairs, rows), (other_pairs, other_rows) in zip(alone, together, strict=True):
        np.testing.assert_array_equal(pairs, other_pairs)
        for values, others in zip(rows, other_rows, strict=True):
            np.testing.assert_array_equal(values, others)


def test_instances_are_those_of_python_to_the_last_bit(opened):
    bundles, c_scene = opened
    scene = placed(np.random.default_rng(11), bundles, 200)
    raw = c_instances(scene, numbers_of(scene, bundles))
    rng = np.random.default_rng(12)
    quaternions = rng.normal(size=(200, 4)) * np.exp(rng.uniform(-300, 300, (200, 1)))
    for instance, quaternion in zip(raw, quaternions, strict=True):
        instance.quaternion[:] = quaternion
    scene.move(quaternions=quaternions)
    c_scene.set_instances(raw)
    found = np.array([list(instance.quaternion) for instance in c_scene.instances()])
    np.testing.assert_array_equal(found, scene.quaternions)
