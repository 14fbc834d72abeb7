"""Builds the C library once for all tests, and calls its functions through ctypes."""

import contextlib
import ctypes
import fcntl
import functools
import importlib.util
import shutil
import subprocess
from ctypes import POINTER, byref, c_char_p, c_double, c_float, c_int32, c_uint32, c_uint64
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "c_interface"
OK, ARGUMENT, FILE, SYSTEM, BUDGET, MEMORY, INTERNAL = range(7)
NO_BUDGET = (1 << 64) - 1
LENSES = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")


class SceneInfo(ctypes.Structure):
    _fields_ = (
        ("num_instances", c_uint64),
        ("num_bundles", c_uint32),
        ("num_cameras", c_uint32),
    )


class BundleInfo(ctypes.Structure):
    _fields_ = (
        ("num_gaussians", c_uint64),
        ("num_page_bytes", c_uint64),
        ("most_page_bytes", c_uint64),
        ("num_clusters", c_uint32),
        ("num_groups", c_uint32),
        ("num_pages", c_uint32),
        ("num_levels", c_uint32),
        ("sh_degree", c_int32),
        ("is_quantized", c_int32),
        ("version", c_int32),
    )


class PageInfo(ctypes.Structure):
    _fields_ = (
        ("offset", c_uint64),
        ("num_bytes", c_uint64),
        ("first_gaussian", c_uint64),
        ("num_gaussians", c_uint64),
        ("first_cluster", c_uint32),
        ("num_clusters", c_uint32),
        ("parent", c_int32),
        ("level", c_int32),
    )


class Instance(ctypes.Structure):
    _fields_ = (
        ("position", 3 * c_double),
        ("quaternion", 4 * c_double),
        ("scale", c_double),
        ("bundle", c_uint32),
        ("environment", c_int32),
        ("importance", c_float),
        ("opacity", c_float),
        ("tint", 3 * c_float),
    )


class Camera(ctypes.Structure):
    _fields_ = (
        ("viewmat", 16 * c_double),
        ("fx", c_double),
        ("fy", c_double),
        ("cx", c_double),
        ("cy", c_double),
        ("near_depth", c_double),
        ("distortion", 8 * c_double),
        ("width", c_int32),
        ("height", c_int32),
        ("lens", c_int32),
    )


class Rule(ctypes.Structure):
    _fields_ = (
        ("tolerance_px2", c_double),
        ("fade", c_double),
        ("budget", c_uint64),
        ("min_level", c_int32),
        ("culls", c_int32),
    )


class Pair(ctypes.Structure):
    _fields_ = (
        ("instance", c_int32),
        ("cluster", c_int32),
        ("page", c_uint32),
        ("first_in_page", c_uint32),
        ("num_gaussians", c_uint32),
        ("weight", c_float),
        ("filter_px2", c_float),
        ("is_antialiased", c_int32),
    )


class MissingPage(ctypes.Structure):
    _fields_ = (
        ("bundle", c_uint32),
        ("page", c_uint32),
        ("priority", c_float),
    )


class Cut(ctypes.Structure):
    _fields_ = (
        ("pairs", POINTER(Pair)),
        ("num_pairs", c_uint64),
        ("num_gaussians", c_uint64),
        ("missing", POINTER(MissingPage)),
        ("num_missing", c_uint64),
        ("revision", c_uint64),
        ("tolerance_px2", c_float),
    )


class Gaussians(ctypes.Structure):
    _fields_ = (
        ("means", POINTER(c_float)),
        ("quaternions", POINTER(c_float)),
        ("scales", POINTER(c_float)),
        ("opacities", POINTER(c_float)),
        ("sh", POINTER(c_float)),
        ("capacity", c_uint64),
        ("sh_degree", c_int32),
    )


STRUCTS = {
    "v3dg_scene_info": SceneInfo,
    "v3dg_bundle_info": BundleInfo,
    "v3dg_page_info": PageInfo,
    "v3dg_instance": Instance,
    "v3dg_camera": Camera,
    "v3dg_rule": Rule,
    "v3dg_pair": Pair,
    "v3dg_missing_page": MissingPage,
    "v3dg_cut": Cut,
    "v3dg_gaussians": Gaussians,
}


class Failure(Exception):
    """A status other than V3DG_OK, and the message of the library."""

    def __init__(self, status, text):
        super().__init__(text)
        self.status = status


@functools.cache
def json_folder():
    """Return the folder with nlohmann/json.hpp of the package from PyPI. None means
    that CMake searches the folders of the system."""
    package = importlib.util.find_spec("nlohmann_json")
    if package is None:
        return None
    return Path(package.submodule_search_locations[0]) / "include"


def configure(build, *options):
    """Configure a build of the C library without the Python module."""
    arguments = [
        "-DV3DG_PYTHON=OFF",
        "-DV3DG_C_LIBRARY=ON",
        "-DCMAKE_BUILD_TYPE=Release",
        *options,
    ]
    if json_folder() is not None:
        arguments.append(f"-DV3DG_JSON_INCLUDE_DIR={json_folder()}")
    elif not Path("/usr/include/nlohmann/json.hpp").exists():
        pytest.skip("needs nlohmann/json.hpp: pip install nlohmann-json")
    command = ["cmake", "-G", "Ninja", "-S", ROOT, "-B", build, *arguments]
    subprocess.run(command, check=True, capture_output=True, text=True)


@contextlib.contextmanager
def building():
    """Hold the lock of the shared build folder, so that only one process builds."""
    BUILD.mkdir(parents=True, exist_ok=True)
    with open(BUILD / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@functools.cache
def built():
    """Build the library from the sources that have changed. Return the build folder."""
    if shutil.which("cmake") is None or shutil.which("ninja") is None:
        pytest.skip("needs cmake and ninja")
    with building():
        configure(BUILD)
        done = subprocess.run(["cmake", "--build", BUILD], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout
    return BUILD


@functools.cache
def library():
    """Return the loaded library. `call` raises its errors as Failure."""
    loaded = ctypes.CDLL(str(built() / "lib" / "libv3dg.so"))
    loaded.v3dg_last_error.restype = c_char_p
    loaded.v3dg_close.argtypes = [ctypes.c_void_p]
    loaded.v3dg_free_cut.argtypes = [POINTER(Cut)]
    loaded.v3dg_look_at.argtypes = [POINTER(c_double)] * 3 + [
        c_double,
        c_int32,
        c_int32,
        c_double,
        POINTER(Camera),
    ]
    return loaded


def call(name, *arguments):
    """Call a function, and raise Failure unless it returns V3DG_OK."""
    status = getattr(library(), name)(*arguments)
    if status != OK:
        raise Failure(status, library().v3dg_last_error().decode("utf-8", "replace"))


class CScene:
    """A scene of the C library."""

    def __init__(self, path):
        self.handle = ctypes.c_void_p()
        call("v3dg_open", str(path).encode(), byref(self.handle))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        library().v3dg_close(self.handle)
        self.handle = None

    def info(self):
        info = SceneInfo()
        call("v3dg_get_scene_info", self.handle, byref(info))
        return info

    def bundle_info(self, bundle=0):
        info = BundleInfo()
        call("v3dg_get_bundle_info", self.handle, c_uint32(bundle), byref(info))
        return info

    def page_info(self, page, bundle=0):
        info = PageInfo()
        call("v3dg_get_page_info", self.handle, c_uint32(bundle), c_uint32(page), byref(info))
        return info

    def camera(self, index):
        camera = Camera()
        name = c_char_p()
        call("v3dg_get_camera", self.handle, c_uint32(index), byref(camera), byref(name))
        return name.value.decode(), camera

    def instances(self):
        count = self.info().num_instances
        instances = (Instance * count)()
        call("v3dg_get_instances", self.handle, instances, c_uint64(count))
        return instances

    def set_instances(self, instances):
        array = (Instance * len(instances))(*instances)
        call("v3dg_set_instances", self.handle, array, c_uint64(len(instances)))

    def add_bundle(self, path):
        bundle = c_uint32()
        call("v3dg_add_bundle", self.handle, str(path).encode(), byref(bundle))
        return bundle.value

    def set_resident(self, bundle, is_resident):
        flags = None
        count = 0
        if is_resident is not None:
            count = len(is_resident)
            flags = bytes(np.asarray(is_resident, np.uint8))
        call("v3dg_set_resident", self.handle, c_uint32(bundle), flags, c_uint32(count))

    @contextlib.contextmanager
    def cut(self, *cameras, rule=None):
        """Yield the cut of a camera, or of two eyes."""
        eyes = (Camera * len(cameras))(*cameras)
        cut = POINTER(Cut)()
        given_rule = None
        if rule is not None:
            given_rule = byref(rule)
        count = c_uint32(len(cameras))
        call("v3dg_select", self.handle, eyes, count, given_rule, byref(cut))
        try:
            yield cut.contents
        finally:
            library().v3dg_free_cut(cut)

    def read_page(self, page, bundle=0):
        size = self.page_info(page, bundle).num_bytes
        out = ctypes.create_string_buffer(size)
        place = (c_uint32(bundle), c_uint32(page))
        call("v3dg_read_page", self.handle, *place, out, c_uint64(size))
        return out.raw

    def read_gaussians(self, page, bundle=0, sh_degree=0):
        arrays = empty_rows(self.page_info(page, bundle).num_gaussians, sh_degree)
        memory = memory_of(arrays)
        place = (c_uint32(bundle), c_uint32(page))
        call("v3dg_read_gaussians", self.handle, *place, byref(memory))
        return arrays

    def read_cut(self, cut, sh_degree=0, origin=None):
        arrays = empty_rows(cut.num_gaussians, sh_degree)
        memory = memory_of(arrays)
        shift = None
        if origin is not None:
            shift = (3 * c_double)(*origin)
        call("v3dg_read_cut", self.handle, byref(cut), shift, byref(memory))
        return arrays


def empty_rows(count, sh_degree):
    """Return arrays of means, quats, scales, opacities and sh, filled with NaN."""
    bases = (sh_degree + 1) ** 2
    return tuple(
        np.full((count, *row), np.nan, np.float32) for row in ((3,), (4,), (3,), (), (bases, 3))
    )


def memory_of(arrays):
    pointers = [array.ctypes.data_as(POINTER(c_float)) for array in arrays]
    bases = arrays[4].shape[1]
    return Gaussians(*pointers, len(arrays[0]), int(bases**0.5) - 1)


def array_of(pointer, count, kind):
    """Return a copy of a C array of structs as a NumPy array with named fields."""
    if count == 0:
        return np.zeros(0, np.dtype(kind))
    return np.ctypeslib.as_array(pointer, (count,)).copy()


def pairs_of(cut):
    return array_of(cut.pairs, cut.num_pairs, Pair)


def missing_of(cut):
    return array_of(cut.missing, cut.num_missing, MissingPage)


def c_camera(camera):
    """Return a camera of v3dg for the C library."""
    out = Camera(
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        near_depth=camera.near,
        width=camera.width,
        height=camera.height,
        lens=LENSES.index(camera.model),
    )
    out.viewmat[:] = camera.viewmat.ravel().tolist()
    out.distortion[: len(camera.distortion)] = camera.distortion
    return out


def c_rule(tolerance=None, budget=None, min_level=0, fade=None, *, cull=True):
    """Return the rule of `v3dg.select` with these arguments."""
    if tolerance is None:
        tolerance = 3.0
        if budget is not None:
            tolerance = 0.0
    most = NO_BUDGET
    if budget is not None:
        most = budget
    return Rule(tolerance, fade or 1.0, most, min_level, int(cull))


def c_instances(scene, bundle_numbers):
    """Return the instances of a scene of v3dg for the C library. bundle_numbers maps
    indices of its bundles to indices of bundles in the C scene."""
    return [
        Instance(
            (3 * c_double)(*scene.positions[i]),
            (4 * c_double)(*scene.quaternions[i]),
            scene.scales[i],
            bundle_numbers[scene.instance_bundle[i]],
            scene.environments[i],
            scene.importance[i],
            scene.opacity[i],
            (3 * c_float)(*scene.tint[i]),
        )
        for i in range(len(scene))
    ]
