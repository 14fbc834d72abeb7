import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3dg import Camera, read_cameras, write_cameras

MATRIX = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]
# The camera is at (0, -5, 1) and looks along y, with z up.
VIEWMAT = [[1, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 5], [0, 0, 0, 1]]
# The fields that the processing of a capture writes, without those of the lens.
CAPTURE = {
    "camera_model": "OPENCV",
    "w": 640,
    "h": 480,
    "fl_x": 500.0,
    "fl_y": 510.0,
    "cx": 321.5,
    "cy": 238.5,
    "k1": 0.0,
    "k2": 0,
    "p1": 0.0,
    "p2": 0.0,
    "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
    "ply_file_path": "sparse_pc.ply",
    "frames": [
        {"file_path": "images/frame_1.png", "transform_matrix": MATRIX, "colmap_im_id": 1},
        {"file_path": "images/frame_2.png", "transform_matrix": MATRIX, "fl_x": 600, "w": 320.0},
    ],
}
# For NeRF's synthetic scenes, the image size is read from the pictures, which are
# missing here.
SYNTHETIC = {
    "camera_angle_x": 0.69,
    "frames": [
        {"file_path": "./train/r_0", "rotation": 0.01, "transform_matrix": MATRIX},
        {"file_path": "./train/r_1", "rotation": 0.01, "transform_matrix": MATRIX[:3]},
    ],
}


def put(folder, document):
    path = folder / "transforms.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def test_a_capture_is_read(tmp_path):
    cameras = read_cameras(put(tmp_path, CAPTURE))
    assert list(cameras) == ["images/frame_1.png", "images/frame_2.png"]
    first, second = cameras.values()
    np.testing.assert_allclose(first.viewmat, VIEWMAT, atol=1e-15)
    np.testing.assert_array_equal(first.K, [[500, 0, 321.5], [0, 510, 238.5], [0, 0, 1]])
    assert (first.width, first.height, first.near) == (640, 480, 0.01)
    # The focal length of a frame holds for both axes, because the file's fl_y belongs
    # to the other lens.
    assert (second.fx, second.fy, second.width, second.height) == (600, 600, 320, 480)


def test_a_synthetic_scene_is_read(tmp_path):
    path = put(tmp_path, SYNTHETIC)
    cameras = read_cameras(path, size=(800, 600))
    assert list(cameras) == ["./train/r_0", "./train/r_1"]
    for camera in cameras.values():
        np.testing.assert_allclose(camera.viewmat, VIEWMAT, atol=1e-15)
        assert camera.fx == camera.fy == pytest.approx(400 / math.tan(0.345))
        assert (camera.cx, camera.cy, camera.width, camera.height) == (400, 300, 800, 600)
    with pytest.raises(
        ValueError, match=r"frames\[0\]: expected w and h, .* got neither; pass the size"
    ):
        read_cameras(path)


def test_vertical_field_of_view_is_used(tmp_path):
    camera, _ = read_cameras(
        put(tmp_path, {**SYNTHETIC, "camera_angle_y": 0.5}), size=(80, 60)
    ).values()
    assert camera.fy == pytest.approx(30 / math.tan(0.25))


def test_applied_transform_is_undone_on_request(tmp_path):
    path = put(tmp_path, {**CAPTURE, "applied_scale": 2})
    # where the point was before the dataset was moved
    point = np.array([0.3, -0.2, 0.7])
    in_file = 2 * np.array(CAPTURE["applied_transform"]) @ [*point, 1]
    kept = next(iter(read_cameras(path).values()))
    undone = next(iter(read_cameras(path, applied_transform="undo").values()))
    seen = kept.viewmat @ [*in_file, 1]
    np.testing.assert_allclose(2 * (undone.viewmat @ [*point, 1])[:3], seen[:3], atol=1e-14)


@pytest.mark.parametrize("name", ["k1", "k2", "p1", "p2", "k3"])
def test_distortion_is_read_or_ignored(tmp_path, name):
    path = put(tmp_path, {**CAPTURE, name: 0.01})
    camera = next(iter(read_cameras(path).values()))
    order = ("k1", "k2", "p1", "p2", "k3")
    assert camera.model == "OPENCV"
    assert camera.distortion == tuple(0.01 * (term == name) for term in order)
    ignored = next(iter(read_cameras(path, distortion="ignore").values()))
    assert (ignored.model, ignored.distortion) == ("PINHOLE", ())
    np.testing.assert_array_equal(
        ignored.K, read_cameras(put(tmp_path, CAPTURE))["images/frame_1.png"].K
    )


def test_all_coefficients_of_opencv_are_read_and_written(tmp_path):
    coefficients = {f"k{number}": 0.01 * number for number in range(1, 7)}
    full = {**CAPTURE, "camera_model": "FULL_OPENCV", **coefficients, "p2": 0.002}
    camera = read_cameras(put(tmp_path, full))["images/frame_1.png"]
    assert camera.model == "OPENCV"
    assert camera.distortion == pytest.approx((0.01, 0.02, 0, 0.002, 0.03, 0.04, 0.05, 0.06))
    write_cameras(tmp_path / "again.json", {"a": camera})
    assert read_cameras(tmp_path / "again.json")["a"].distortion == camera.distortion


def test_a_lens_of_opencv_with_all_coefficients_zero_is_a_pinhole(tmp_path):
    coefficients = dict.fromkeys(("k3", "k4", "k5", "k6"), 0.0)
    full = {**CAPTURE, "camera_model": "FULL_OPENCV", **coefficients}
    found = read_cameras(put(tmp_path, full))["images/frame_1.png"]
    wanted = read_cameras(put(tmp_path, CAPTURE))["images/frame_1.png"]
    np.testing.assert_array_equal(found.K, wanted.K)


@pytest.mark.parametrize("frame", [{"file_path": "images/frame_2.png"}, {}])
def test_cameras_without_names_of_their_own_get_their_place(tmp_path, frame):
    frames = [*CAPTURE["frames"], {"transform_matrix": MATRIX, **frame}]
    assert list(read_cameras(put(tmp_path, {**CAPTURE, "frames": frames}))) == ["0", "1", "2"]


@given(seed=st.integers(0, 2**32 - 1), names=st.sets(st.text("ab/. ä", min_size=1), max_size=4))
def test_what_is_written_reads_back(tmp_path_factory, seed, names):
    rng = np.random.default_rng(seed)
    cameras = {}
    for name in sorted(names):
        eye = 100 * rng.normal(size=3)
        camera = Camera.look_at(eye, eye + rng.normal(size=3), width=64, height=48, near=0.5)
        K = np.array([[50, 0, rng.normal()], [0, 60, rng.normal()], [0, 0, 1]])
        cameras[name] = Camera(camera.viewmat, K, 70, 80, camera.near)
    path = tmp_path_factory.mktemp("cameras") / "transforms.json"
    write_cameras(path, cameras)
    again = read_cameras(path)
    assert list(again) == list(cameras)
    for name, camera in cameras.items():
        np.testing.assert_allclose(again[name].viewmat, camera.viewmat, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(again[name].K, camera.K)
        got = (again[name].width, again[name].height, again[name].near)
        assert got == (camera.width, camera.height, camera.near)
    assert [entry.name for entry in path.parent.iterdir()] == ["transforms.json"]


def with_frame(**change):
    return {**CAPTURE, "frames": [CAPTURE["frames"][0], {**CAPTURE["frames"][1], **change}]}


def without(*keys):
    return {key: value for key, value in CAPTURE.items() if key not in keys}


BAD = {
    "no frames": (without("frames"), "top level: expected the field frames"),
    "frames of another kind": ({**CAPTURE, "frames": {}}, "frames: expected an array, got {}"),
    "a frame of another kind": ({**CAPTURE, "frames": [3]}, "frames[0]: expected an object, got 3"),
    "no matrix": ({**CAPTURE, "frames": [{}]}, "frames[0]: expected the field transform_matrix"),
    "matrix of two rows": (
        with_frame(transform_matrix=MATRIX[:2]),
        "frames[1].transform_matrix: expected 4 rows of 4 numbers",
    ),
    "matrix with a word": (
        with_frame(transform_matrix=[[1, 0, 0, "x"], *MATRIX[1:]]),
        'frames[1].transform_matrix[0][3]: expected a number, got "x"',
    ),
    "matrix that scales": (
        with_frame(transform_matrix=(2 * np.array(MATRIX)).tolist()),
        "frames[1].transform_matrix: expected a rotation in the upper left 3x3",
    ),
    "matrix that overflows": (
        with_frame(transform_matrix=(1e300 * np.array(MATRIX)).tolist()),
        "frames[1].transform_matrix: expected a rotation in the upper left 3x3",
    ),
    "matrix that mirrors": (
        with_frame(transform_matrix=(np.diag([-1, 1, 1, 1]) @ np.array(MATRIX)).tolist()),
        "frames[1].transform_matrix: expected a rotation in the upper left 3x3",
    ),
    "position beyond doubles": (
        with_frame(
            transform_matrix=[[0.6, 0.8, 0, 1.7e308], [-0.8, 0.6, 0, 1.7e308], [0, 0, 1, 0]]
        ),
        "frames[1].viewmat: expected finite numbers, got",
    ),
    "no focal length": (
        without("fl_x", "fl_y"),
        "frames[0]: expected fl_x or camera_angle_x, in the frame or at the top, got neither",
    ),
    "no size": (
        without("h"),
        "frames[0]: expected w and h, in the frame or at the top, got focal lengths",
    ),
    "size of half a pixel": (
        with_frame(w=320.5),
        "frames[1].w: expected a positive whole number, got 320.5",
    ),
    "endless size": (
        {**CAPTURE, "w": 1 << 40},
        "w: expected at most 1048576 px, got 1099511627776",
    ),
    "negative focal length": (
        with_frame(fl_x=-1),
        "frames[1].fl_x: expected a positive number, got -1",
    ),
    "angle beyond a half turn": (
        {**without("fl_x"), "camera_angle_x": 3.5},
        "camera_angle_x: expected radians between 0 and pi, got 3.5",
    ),
    "angle of no focal length": (
        {**SYNTHETIC, "w": 8, "h": 6, "camera_angle_y": 5e-324},
        "frames[0].fov_y: expected radians between 0 and pi, got 5e-324",
    ),
    "principal point of another kind": ({**CAPTURE, "cx": True}, "cx: expected a number, got true"),
    "another model": (
        {**CAPTURE, "camera_model": "EQUIRECTANGULAR"},
        "camera_model: expected a camera model of OpenCV (PINHOLE, SIMPLE_PINHOLE, OPENCV, "
        "FULL_OPENCV, SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, "
        'RADIAL_FISHEYE), got "EQUIRECTANGULAR"; undistort the pictures first',
    ),
    "fourth coefficient, which OpenCV has not": (
        with_frame(k4=-0.1),
        "frames[1].k4: expected 0 unless the camera is a fisheye or a FULL_OPENCV, got -0.1",
    ),
    "coefficient of another kind": (with_frame(k2="a"), "frames[1].k2: expected a number"),
    "name of another kind": (
        with_frame(file_path=7),
        "frames[1].file_path: expected a string, got 7",
    ),
    "not an object": ([], "top level: expected an object, got []"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_values_are_named_by_their_place(tmp_path, case):
    document, message = BAD[case]
    with pytest.raises(ValueError, match="^" + re.escape(f"transforms.json: {message}")):
        read_cameras(put(tmp_path, document))


@pytest.mark.parametrize("sign", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheyes_are_read(tmp_path, sign):
    path = put(tmp_path, {**CAPTURE, **sign, "k1": 0.1, "k4": 0.02})
    camera = next(iter(read_cameras(path).values()))
    assert (camera.model, camera.distortion) == ("OPENCV_FISHEYE", (0.1, 0, 0, 0.02))
    with pytest.raises(ValueError, match=r"expected a pinhole camera, got .*; draw the distor"):
        read_cameras(path, distortion="ignore")


def test_lenses_that_are_written_read_back(tmp_path):
    K = np.array([[50.0, 0, 30], [0, 60, 20], [0, 0, 1]])
    lens = {
        "fisheye": Camera(np.eye(4), K, 64, 48, 0.5, (0.1, 0.2, 0.3, 0.4), "OPENCV_FISHEYE"),
        "barrel": Camera(np.eye(4), K, 64, 48, 0.5, (-0.1, 0.2, 0.01, 0.02, 0.3), "OPENCV"),
        "plain": Camera(np.eye(4), K, 64, 48),
    }
    path = tmp_path / "transforms.json"
    write_cameras(path, lens)
    again = read_cameras(path)
    for name, camera in lens.items():
        assert (again[name].model, again[name].distortion) == (camera.model, camera.distortion)


def test_an_applied_transform_that_scales_is_not_undone(tmp_path):
    path = put(
        tmp_path, {**CAPTURE, "applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}
    )
    read_cameras(path)
    with pytest.raises(
        ValueError, match=r"^transforms.json: applied_transform: expected a rotation and"
    ):
        read_cameras(path, applied_transform="undo")


@pytest.mark.parametrize("argument", ["distortion", "applied_transform"])
def test_unknown_choices_are_refused(tmp_path, argument):
    with pytest.raises(ValueError, match=f"{argument}: expected '.*' or '.*', got 'maybe'"):
        read_cameras(put(tmp_path, CAPTURE), **{argument: "maybe"})


def cameras_of_3dgs(cameras):
    """Return the cameras that the code of the 3DGS paper writes for these cameras."""
    entries = []
    for number, (name, camera) in enumerate(cameras.items()):
        to_world = np.linalg.inv(camera.viewmat)
        entry = {
            "id": number,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": to_world[:3, 3].tolist(),
            "rotation": to_world[:3, :3].tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        entries.append(entry)
    return entries


@pytest.mark.parametrize("names", [("DSC_1", "DSC_2"), ("a", "a"), ("", "b")])
def test_cameras_of_the_3dgs_code_are_read(tmp_path, names):
    pair = [
        Camera.look_at((1, 2, 3), (0, 0, 0), width=640, height=480),
        Camera.look_at((3, -2, 1), (0, 1, 0), fov_x=1.0, width=320, height=200),
    ]
    entries = cameras_of_3dgs(dict(zip("xy", pair, strict=True)))
    for entry, name in zip(entries, names, strict=True):
        entry["img_name"] = name
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(entries))
    wanted_names = list(names) if names == ("DSC_1", "DSC_2") else ["0", "1"]
    for place in (path, tmp_path):
        found = read_cameras(place)
        assert list(found) == wanted_names
        for camera, wanted in zip(found.values(), pair, strict=True):
            np.testing.assert_allclose(camera.viewmat, wanted.viewmat, atol=1e-12)
            np.testing.assert_allclose(camera.K, wanted.K, rtol=1e-12)
            assert (camera.width, camera.height) == (wanted.width, wanted.height)


PATH = {
    "default_fov": 75,
    "default_transition_sec": 2,
    "keyframes": [{"matrix": [1.0] * 16, "fov": 60, "aspect": 1.5}],
    "camera_type": "perspective",
    "render_height": 480,
    "render_width": 640,
    "fps": 30,
    "seconds": 2,
    "is_cycle": False,
    "camera_path": [
        {"camera_to_world": np.array(MATRIX).ravel().tolist(), "fov": 60, "aspect": 4 / 3},
        {"camera_to_world": MATRIX, "fov": 50.0, "aspect": 4 / 3},
    ],
}


def test_a_path_of_the_viewer_of_nerfstudio_is_read(tmp_path):
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(PATH))
    for place in (path, tmp_path):
        found = read_cameras(place)
        assert list(found) == ["0", "1"]
        for camera, fov in zip(found.values(), (60, 50), strict=True):
            np.testing.assert_allclose(camera.viewmat, VIEWMAT, atol=1e-15)
            # The field of view is vertical, and pixels are square.
            focal = 240 / math.tan(math.radians(fov) / 2)
            np.testing.assert_allclose(camera.K, [[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
            assert (camera.width, camera.height) == (640, 480)


def test_frames_of_a_path_may_have_names(tmp_path):
    frames = [
        {**frame, "file_path": name} for frame, name in zip(PATH["camera_path"], "ba", strict=True)
    ]
    assert list(read_cameras(put(tmp_path, PATH | {"camera_path": frames}))) == ["b", "a"]


def without_size():
    return {key: value for key, value in PATH.items() if not key.startswith("render_")}


def test_a_path_without_a_size_needs_one(tmp_path):
    with pytest.raises(
        ValueError, match="expected render_width and render_height, got neither; pass the s"
    ):
        read_cameras(put(tmp_path, without_size()))
    camera = read_cameras(put(tmp_path, without_size()), size=(64, 48))["0"]
    assert (camera.width, camera.height) == (64, 48)


OTHER_FILES = {
    "a path of another kind": (
        PATH | {"camera_type": "equirectangular"},
        'camera_type: expected "perspective", got "equirectangular"',
    ),
    "keyframes alone": (
        {"keyframes": PATH["keyframes"]},
        "top level: expected frames in camera_path, got none; save the path in",
    ),
    "keyframes and an empty path": (
        PATH | {"camera_path": []},
        "top level: expected frames in camera_path, got none; save the path in",
    ),
    "a path of another model": (
        PATH | {"camera_model": "fisheye"},
        'camera_model: expected "perspective", got "fisheye"',
    ),
    "an open angle": (
        PATH | {"camera_path": [PATH["camera_path"][0] | {"fov": 180}]},
        "camera_path[0].fov: expected degrees between 0 and 180, got 180",
    ),
    "a matrix of nine": (
        PATH | {"camera_path": [{"camera_to_world": [1.0] * 9, "fov": 60}]},
        "camera_path[0].camera_to_world: expected 4 rows of 4 numbers",
    ),
    "the transform of a training": (
        {"transform": MATRIX[:3], "scale": 0.5},
        "top level: expected cameras, got the transform of a run's training; give the folder",
    ),
    "poses without lenses": (
        [{"file_path": "a.png", "transform": MATRIX[:3]}],
        "[0]: expected position, rotation, fx and fy, got only a pose, as written by ns-export",
    ),
    "a camera of 3DGS without a rotation": (
        [{"position": [0, 0, 0], "fx": 1, "fy": 1, "width": 8, "height": 8}],
        "[0]: expected the field rotation",
    ),
    "a camera of 3DGS that scales": (
        [
            {"position": [0, 0, 0], "fx": 1, "fy": 1, "width": 8, "height": 8}
            | {"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}
        ],
        "[0].viewmat: expected a rotation in the upper left 3x3",
    ),
}


@pytest.mark.parametrize("case", OTHER_FILES)
def test_other_files_are_named_by_what_they_are(tmp_path, case):
    document, message = OTHER_FILES[case]
    with pytest.raises(ValueError, match="^" + re.escape(f"transforms.json: {message}")):
        read_cameras(put(tmp_path, document))


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path):
    wanted = read_cameras(put(tmp_path, CAPTURE))
    path = tmp_path / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert list(read_cameras(path)) == list(wanted)
    path.write_bytes(json.dumps(CAPTURE).encode("utf-16"))
    with pytest.raises(ValueError, match="does not parse: the file is in UTF-16; save it as UTF-8"):
        read_cameras(path)
