"""Types of the compiled module v3dg._core."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Literal, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

# A NumPy array on the host, or a torch tensor on a CUDA device. The type cannot be
# narrower, because torch may not be installed, and the device is not part of a type.
Array: TypeAlias = Any

Float32: TypeAlias = NDArray[np.float32]
Float64: TypeAlias = NDArray[np.float64]
Int32: TypeAlias = NDArray[np.int32]
Int64: TypeAlias = NDArray[np.int64]
Uint8: TypeAlias = NDArray[np.uint8]

fade_filter_px2: float
has_cuda: bool
has_openmp: bool
min_alpha: float
sh_base0: float
stops_before: float
stops_by_cut: float

def isa() -> str: ...
def num_cuda_devices() -> int: ...

class Camera:
    """A camera of any model, or a window of its image."""

    def __init__(
        self,
        *,
        viewmat: Float64,
        K: Float64,
        width: int,
        height: int,
        near: float,
        model: Literal["pinhole", "opencv", "fisheye"] = "pinhole",
        distortion: Sequence[float] = ...,
    ) -> None: ...
    def window(self, x0: int, y0: int, x1: int, y1: int) -> Camera: ...
    @property
    def position(self) -> Float64: ...
    @property
    def K(self) -> Float64: ...
    @property
    def lens_range(self) -> float: ...
    @property
    def px2_per_steradian(self) -> float: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...

class Eyes:
    """Two cameras that look in the same direction and share a cut; or a single
    camera."""

    @overload
    def __init__(self, camera: Camera) -> None: ...
    @overload
    def __init__(self, left: Camera, right: Camera) -> None: ...

class Rule:
    """The rule of a selection, which determines the chosen clusters."""

    def __init__(
        self,
        *,
        tolerance_px2: float,
        budget: int | None,
        min_level: int,
        footprint: Literal["solid_angle", "paper"],
        culls: bool,
        fade: float = 1.0,
        frame: int = 0,
    ) -> None: ...
    @property
    def tolerance_px2(self) -> float: ...

class Instances:
    """Instances of bundles. Borrows the arrays, which are on the host."""

    def __init__(
        self,
        *,
        bundle: Int32,
        positions: Float64,
        quaternions: Float64,
        scales: Float64,
        importance: Float32,
        factors: Float32 | None = None,
    ) -> None: ...

class Rows:
    """The arrays of gaussians, on the host or on a CUDA device."""

    def __init__(
        self, means: Array, quats: Array, scales: Array, opacities: Array, sh: Array
    ) -> None: ...
    def __len__(self) -> int: ...
    @property
    def device(self) -> int: ...
    @property
    def sh_degree(self) -> int: ...

# Means, quats, scales, opacities and sh.
Columns: TypeAlias = tuple[Array, Array, Array, Array, Array]

def sh_bases(degree: int, directions: NDArray[np.float64]) -> NDArray[np.float64]: ...

class PlyFile:
    """A .ply file with gaussians, which is read in ranges of rows."""

    def __init__(self, path: str | PathLike[str]) -> None: ...
    @property
    def num_gaussians(self) -> int: ...
    @property
    def sh_degree(self) -> int: ...
    @property
    def used(self) -> list[str]:
        """Names of the properties that are used."""
    @property
    def prefix(self) -> str:
        """Prefix of the property names, before the names that trainers write."""

    def read(self, first: int, last: int) -> tuple[Float32, Float32, Float32, Float32, Float32]: ...

def ply_header(
    path: str | PathLike[str],
) -> tuple[str, int, list[tuple[str, int, list[tuple[str, str]]]]]: ...
def ply_comments(path: str | PathLike[str]) -> list[str]: ...
def ply_write(
    path: str | PathLike[str],
    means: Float32,
    quats: Float32,
    scales: Float32,
    opacities: Float32,
    sh: Float32,
    encoding: str,
    comments: list[str] = [],
) -> None: ...

nesting_margin: float
min_radius: float
most_length: float

def examine(gaussians: Rows) -> NDArray[np.uint16]: ...
def num_halvings(count: int, cluster_size: int) -> int: ...
def median_split(means: Array, offset: Int64, depth: int, unit: int = 1) -> tuple[Array, Int64]: ...
def check_tables(
    offset: Int64,
    level: Int32,
    own_group: Int32,
    parent_group: Int32,
    box: Float32,
    filter_px2: Float32,
    antialiased: Uint8,
    ball: Float32,
    weight: Float32,
    parent: Int32,
    group_level: Int32,
    error: Float32,
    *,
    num_gaussians: int,
) -> None: ...
def morton_order(means: Float32) -> Int64: ...
def bound_spheres(spheres: Array, offset: Int64) -> Array: ...
def bound_by_boxes(gaussians: Rows, offset: Int64) -> Array: ...
def prune(gaussians: Rows, in_offset: Int64, out_offset: Int64) -> Array: ...
def merge(gaussians: Rows, in_offset: Int64, out_offset: Int64) -> Columns: ...
def codebook_of(values: Float64) -> Float64: ...
def palette_of(vectors: Float32, size: int) -> tuple[Float64, NDArray[np.uint32]]: ...
def page_code_bytes(sh_degree: int) -> tuple[int, int, int]: ...
def encode_page(gaussians: Rows, offset: Int64) -> Int32: ...
def decode_page(page: Int32, offset: Int64, out: Rows) -> None: ...

DAMAGED: str
HASH_PIECE_BYTES: int

class PageRun:
    """Neighbouring pages of a file. Borrows the arrays."""

    def __init__(
        self, *, first_page: int, first_cluster: Int64, offset: Int64, places: Int64
    ) -> None: ...

def write_pages(path: str, descriptor: int, gaussians: Rows, codec: str, run: PageRun) -> Uint8: ...
def read_pages(
    path: str, descriptor: int, out: Rows | Int32, codec: str, hashes: Uint8, run: PageRun
) -> None: ...
def blake2b(messages: Sequence[Uint8]) -> list[bytes]: ...

class HashedRead:
    def wait(self) -> Uint8: ...
    def is_sound(self) -> bool: ...

class HashedReader:
    def __init__(self) -> None: ...
    def read(
        self,
        path: str,
        descriptor: int,
        before: bytes,
        offset: int,
        num_bytes: int,
        in_pieces: bool,
    ) -> HashedRead: ...

class Codes:
    """All pages of a bundle as codes, on the host. Borrows the arrays."""

    def __init__(
        self, pages: Int32, first_cluster: Int64, offset: Int64, sh_degree: int
    ) -> None: ...

def gather(
    *,
    bundles: Sequence[Rows],
    instances: Instances,
    instance: Int32,
    first_row: Int64,
    offset: Int64,
    weights: Float32 | None = None,
    device: int,
) -> Columns: ...
def transform(rows: Rows, quaternion: Float64, position: Float64, scale: float) -> Columns: ...

class ClusterTable:
    """The tables of a bundle's clusters that selection and drawing read."""

    def __init__(
        self,
        *,
        ball: Float32,
        weight: Float32,
        level: Int32,
        own_group: Int32,
        parent_group: Int32,
        box: Float32,
        filter_px2: Float32,
        antialiased: Uint8,
        offset: Int64,
        page_shift: Int64 | None = None,
        page_begins: Int32 | None = None,
    ) -> None: ...
    def bytes_on(self, device: int) -> int: ...

class Cut:
    """The result of a selection: the clusters that one view needs, and statistics."""

    @property
    def instance_ids(self) -> Int32: ...
    @property
    def cluster_ids(self) -> Int32: ...
    @property
    def weights(self) -> Float32: ...
    @property
    def num_gaussians(self) -> int: ...
    @property
    def tolerance_px2(self) -> float: ...
    @property
    def fits_budget(self) -> bool: ...

def bounds_may_draw(
    tables: list[ClusterTable], instances: Instances, camera: Camera, rule: Rule, and_coarser: bool
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]: ...
def group_metrics(
    tables: Sequence[ClusterTable], instances: Instances, camera: Camera, rule: Rule
) -> tuple[Float32, Int64]: ...

class Tape:
    """The data that rasterize stores for rasterize_backward. It keeps the gaussians
    alive."""

class ViewsTape:
    """The data that rasterize_views stores for rasterize_views_backward. It keeps the
    gaussians alive."""

class RenderCounts:
    """Statistics of a picture that was drawn on the host."""

    @property
    def in_frustum(self) -> int: ...
    @property
    def records(self) -> int: ...
    @property
    def entries(self) -> int: ...
    @property
    def project_seconds(self) -> float: ...
    @property
    def bin_seconds(self) -> float: ...
    @property
    def rasterize_seconds(self) -> float: ...

class Rasterized:
    """A picture of gaussians without levels.

    Attributes:
        color: (H, W, 3) colour over the background.
        alpha: (H, W) opacity.
        depth: (H, W) expected depth; None unless it was requested.
        counts: Statistics; None if a CUDA device drew the picture.
        tape: Data for the backward pass; None unless it was requested.
    """

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array: ...
    @property
    def depth(self) -> Array | None: ...
    @property
    def counts(self) -> RenderCounts | None: ...
    @property
    def tape(self) -> Tape | None: ...

class RasterizedViews:
    """Pictures of gaussians without levels for V cameras.

    Attributes:
        color: (V, H, W, 3) colour over the backgrounds.
        alpha: (V, H, W) opacity.
        depth: (V, H, W) expected depth; None unless it was requested.
        tape: Data for the backward pass; None unless it was requested.
    """

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array: ...
    @property
    def depth(self) -> Array | None: ...
    @property
    def tape(self) -> ViewsTape | None: ...

class Gradients:
    """Gradients with respect to the inputs of one or several pictures.

    Attributes:
        poses: (V, 3, 4) gradients with respect to the world-to-camera matrices of V
            cameras, or None.
        centers: (N, 2) gradient with respect to the centres on the image, or None.
        center_sizes: (N, 2) sum over pixels of the absolute gradients with respect to
            the centres, or None.
    """

    @property
    def means(self) -> Array: ...
    @property
    def quats(self) -> Array: ...
    @property
    def scales(self) -> Array: ...
    @property
    def opacities(self) -> Array: ...
    @property
    def sh(self) -> Array: ...
    @property
    def background(self) -> Array: ...
    @property
    def poses(self) -> Array | None: ...
    @property
    def centers(self) -> Array | None: ...
    @property
    def center_sizes(self) -> Array | None: ...

class Ellipses:
    """The projections of gaussians onto an image; zeros for invisible gaussians.

    Attributes:
        centers: (N, 2) in px.
        depths: (N,) in world units.
        conics: (N, 3) inverse covariances in px⁻².
        opacities: (N,) after compensation for the filter.
        radii: (N, 2) int32, in px.
    """

    @property
    def centers(self) -> Array: ...
    @property
    def depths(self) -> Array: ...
    @property
    def conics(self) -> Array: ...
    @property
    def opacities(self) -> Array: ...
    @property
    def radii(self) -> Array: ...

class RaySensor:
    """A sensor without a pose: rays with ascending azimuths and elevations. `rows` and
    `columns` are the rays' positions in the picture. The sensor's axes are x forward, y
    left and z up."""

    def __init__(
        self,
        *,
        azimuth: Float64,
        elevation: Float64,
        rows: Int32,
        columns: Int32,
        near: float,
        far: float,
        spacing: float,
        min_transmittance: float,
    ) -> None: ...

class Cast:
    """The results of casting rays at B poses: arrays of H rows and W columns, or
    None."""

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array: ...
    @property
    def range(self) -> Array: ...
    @property
    def intensity(self) -> Array: ...
    @property
    def second_range(self) -> Array: ...
    @property
    def second_intensity(self) -> Array: ...
    @property
    def gaussians(self) -> list[int]: ...

class RayFrame:
    """Casts the rays of sensors on one device."""

    def __init__(self, device: int) -> None: ...
    def set_models(self, models: list[Model]) -> None: ...
    def cast_scene(
        self,
        scene: ResidentScene,
        sensor: RaySensor,
        viewmats: Array,
        rule: Rule,
        environments: Array | None = None,
        returns: tuple[float, float] | None = None,
    ) -> Cast: ...
    def cast_model(
        self,
        model: Model,
        sensor: RaySensor,
        viewmats: Array,
        *,
        filter_px2: float,
        antialiased: bool,
        returns: tuple[float, float] | None = None,
    ) -> Cast: ...

def rasterize(
    gaussians: Rows,
    camera: Camera,
    *,
    filter_px2: float,
    antialiased: bool,
    background: Sequence[float],
    with_depth: bool,
    keep_tape: bool,
    plain_colors: bool = ...,
) -> Rasterized: ...
def rasterize_backward(
    tape: Tape,
    d_color: Array | None,
    d_alpha: Array | None,
    d_depth: Array | None,
    with_centers: bool = ...,
    with_sizes: bool = ...,
) -> Gradients: ...

# Draws gaussians for several pinholes, whose arrays are on the CPU. `gaussians` and
# `backgrounds` are those of all cameras, or of each camera.
def rasterize_views(
    gaussians: Sequence[Rows],
    cameras: Cameras,
    *,
    filter_px2: float,
    antialiased: bool,
    backgrounds: Sequence[Sequence[float]],
    with_depth: bool,
    keep_tape: bool,
    plain_colors: bool = ...,
) -> RasterizedViews: ...

# The gradients are sums over the cameras. Exceptions are centres, backgrounds, poses,
# and gradients that are requested for each view.
def rasterize_views_backward(
    tape: ViewsTape,
    d_color: Array | None,
    d_alpha: Array | None,
    d_depth: Array | None,
    *,
    with_centers: bool = ...,
    with_sizes: bool = ...,
    with_poses: bool = ...,
    opacities_for_each_view: bool = ...,
    sh_for_each_view: bool = ...,
) -> Gradients: ...

# Returns the factors (G,) by which the balls of level 1 must grow, so that groups are
# selected at a suitable size.
def first_selected(
    leaves: Rows,
    level: Rows,
    leaf_offset: Int64,
    group_offset: Int64,
    ball: Float32,
    leaf_filter_px2: float,
    leaf_antialiased: bool,
    level_filter_px2: float,
) -> Float32: ...
def grown_balls(balls: list[Float32], growth: Float32) -> list[Float32]: ...
def ellipses(
    gaussians: Rows,
    camera: Camera,
    *,
    filter_px2: float,
    antialiased: bool,
    far_depth: float,
    min_radius_px: float,
) -> Ellipses: ...

# Returns centres (V, N, 2), depths (V, N), conics (V, N, 3), opacities (V, N) and radii
# (V, N, 2).
def ellipses_of_views(
    gaussians: Rows,
    cameras: Cameras,
    *,
    filter_px2: float,
    antialiased: bool,
    far_depth: float,
    min_radius_px: float,
) -> tuple[Array, Array, Array, Array, Array]: ...

class Stop:
    """A flag with which any thread can stop a picture in progress. The picture then
    stays unfinished."""

    def request(self) -> None: ...
    @property
    def is_requested(self) -> bool: ...

class FrameStats:
    """Statistics of a frame; times are in milliseconds."""

    @property
    def gaussians(self) -> int: ...
    @property
    def in_frustum(self) -> int: ...
    @property
    def records(self) -> int: ...
    @property
    def entries(self) -> int: ...
    @property
    def items(self) -> int: ...
    @property
    def tolerance_px2(self) -> float: ...
    @property
    def exceeds_budget(self) -> bool: ...
    @property
    def select_ms(self) -> float: ...
    @property
    def draw_ms(self) -> float: ...
    @property
    def levels(self) -> list[int]: ...
    @property
    def num_draws(self) -> int: ...

class Channels:
    """The channels of a picture (H, W) or of a batch (B, H, W); None where not
    requested. `clipped` is uint8, ids are int32."""

    @property
    def median_depth(self) -> Array | None: ...
    @property
    def normal(self) -> Array | None: ...
    @property
    def instance(self) -> Array | None: ...
    @property
    def label(self) -> Array | None: ...
    @property
    def weight(self) -> Array | None: ...
    @property
    def clipped(self) -> Array | None: ...

class Mesh:
    """The z-buffer of a picture of meshes, or of a batch of pictures; borrows the
    arrays, whose values are not checked.

    Args:
        color: (..., 3).
        depth, coverage: (...). On a CUDA device, `coverage` may be None, which means 1
            where the depth is positive and finite.
        normal: (..., 3) of any length, or None.
        instance, label: (...), or None.
        is_linear: Whether colours are in linear light.
    """

    def __init__(
        self,
        *,
        color: Array,
        depth: Array,
        coverage: Array | None,
        normal: Array | None = None,
        instance: Array | None = None,
        label: Array | None = None,
        is_linear: bool = False,
    ) -> None: ...

class Sensor:
    """The channels and the meshes of a request."""

    def __init__(self, channels: list[str], mesh: Mesh | None = None) -> None: ...
    def of_eye(self, number: int) -> Sensor:
        """Return the sensor with the meshes of one of two eyes."""

class Picture:
    """The arrays of a picture."""

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array: ...
    @property
    def depth(self) -> Array | None: ...
    @property
    def channels(self) -> Channels: ...

class Drawing:
    """A frame that has been drawn, or enqueued on a device."""

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array: ...
    @property
    def depth(self) -> Array | None: ...
    @property
    def channels(self) -> Channels: ...
    @property
    def right(self) -> Picture: ...
    def finish(self) -> FrameStats: ...

def level_colors(count: int) -> Float32: ...
def cluster_colors(count: int) -> Float32: ...
def ramp(values: NDArray[Any]) -> Float32: ...
def missing_colors(values: NDArray[Any]) -> Float32: ...

class Model:
    """Gaussians in the layout that frames of their device read."""

    @overload
    def __init__(self, gaussians: Rows) -> None: ...
    @overload
    def __init__(self, codes: Codes, device: int) -> None: ...
    def __len__(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    def decode(self, cluster_ids: Int32) -> Columns: ...

class BudgetSteps:
    """The state of a sequence of pictures with a budget."""

class ResidentScene:
    """The data of a scene that selection reads on one device."""

    def __init__(self, device: int) -> None: ...
    def set_bundles(self, tables: list[ClusterTable]) -> None: ...
    def set_instances(
        self,
        bundle: Int32,
        importance: Float32,
        positions: Array,
        quaternions: Array,
        scales: Array,
        factors: Float32 | None = None,
        environments: Int32 | None = None,
        labels: Int32 | None = None,
    ) -> None: ...
    def set_poses(self, positions: Array, quaternions: Array, scales: Array) -> None: ...
    def select(
        self, camera: Camera | Eyes, rule: Rule, steps: BudgetSteps | None = None
    ) -> Cut: ...
    def page_needs(self, camera: Camera, rule: Rule) -> list[Float32]: ...

class PoolStatus:
    """The state of a pool: resident and missing pages, and errors."""

    @property
    def num_slots(self) -> int: ...
    @property
    def num_resident(self) -> int: ...
    @property
    def needed(self) -> int: ...
    @property
    def missing(self) -> int: ...
    @property
    def failed(self) -> int: ...
    @property
    def pages_in(self) -> int: ...
    @property
    def bytes_in(self) -> int: ...
    @property
    def least_tolerance_px2(self) -> float: ...
    @property
    def error(self) -> str: ...
    @property
    def is_damage(self) -> bool: ...

class SettlingStep:
    """The result of one step towards a settled view."""

    @property
    def tolerance_px2(self) -> float: ...
    @property
    def is_decided(self) -> bool: ...
    @property
    def num_absent(self) -> int: ...

class FileSource:
    """The file that contains the pages of a bundle.

    Args:
        places: (P+1,) offset of each page in the file, and the end.
        hashes: (P, 16) hashes of the pages.
        fetch: Called with ranges of bytes before they are read; None for a local file.
    """

    def __init__(
        self,
        *,
        name: str,
        descriptor: int,
        codec: str,
        sh_degree: int,
        places: Int64,
        hashes: Uint8,
        fetch: Callable[[list[tuple[int, int]]], None] | None = None,
    ) -> None: ...

class PagePool:
    """A pool: memory of a fixed size on one device for pages of bundles."""

    def __init__(
        self,
        tables: list[ClusterTable],
        sources: Sequence[Rows | FileSource],
        device: int,
        num_bytes: int,
        num_threads: int,
    ) -> None: ...
    def settle_step(
        self, scene: ResidentScene, camera: Camera | Eyes, rule: Rule, begins: bool
    ) -> SettlingStep: ...
    def status(self) -> PoolStatus: ...
    def arrived(self, bundle: int) -> Int32: ...
    def resident(self, bundle: int) -> NDArray[np.bool_]: ...
    def raise_tolerance(self, from_px2: float) -> bool: ...
    def wait(self, seconds: float) -> bool: ...
    def read_one(self) -> bool: ...

class Palette:
    """Colours for the clusters of a bundle, with which gaussians can be drawn."""

    def __init__(self, table: ClusterTable, sh: NDArray[np.float32], device: int) -> None: ...

def stop_of_tolerance(tolerance_px2: float) -> float: ...

class Shade:
    """The background of a picture, the transmittance at which its pixels stop, and
    whether depth is drawn.

    Args:
        min_transmittance: 0 or more, or one of two constants: `stops_before` stops
            pixels as `v3dg.rasterize` does, and `stops_by_cut` uses the tolerance of
            the cut.
    """

    def __init__(
        self, *, background: Sequence[float], min_transmittance: float, with_depth: bool
    ) -> None: ...
    @property
    def background(self) -> Sequence[float]: ...
    @property
    def min_transmittance(self) -> float: ...
    @property
    def with_depth(self) -> bool: ...

class Cameras:
    """The cameras of a batch; borrows the arrays.

    Args:
        viewmats: (B, 4, 4).
        K: (B, 3, 3), or (3, 3) for all cameras.
        environments: (B,), or None if each camera sees all instances.
        lenses: The cameras on the CPU if some have lens distortion, or None.
    """

    def __init__(
        self,
        *,
        viewmats: Array,
        K: Array,
        width: int,
        height: int,
        near: float,
        environments: Array | None = None,
        lenses: list[Camera] | None = None,
    ) -> None: ...
    def __len__(self) -> int: ...

def fault_of_cameras(viewmats: Float64, K: Float64) -> tuple[int, str] | None: ...

class BatchPlanes:
    """The arrays of a batch, which the object keeps alive.

    Args:
        color: (B, H, W, 3 or 4).
        alpha: (B, H, W), or None.
        depth, median_depth, weight: (B, H, W), or None.
        normal: (B, H, W, 3), or None.
        instance, label: (B, H, W) int32, or None.
    """

    def __init__(
        self,
        color: Array,
        alpha: Array | None = None,
        depth: Array | None = None,
        *,
        median_depth: Array | None = None,
        normal: Array | None = None,
        instance: Array | None = None,
        label: Array | None = None,
        weight: Array | None = None,
    ) -> None: ...

class BatchStats:
    """The statistics of each picture of a batch."""

    @property
    def gaussians(self) -> list[int]: ...
    @property
    def in_frustum(self) -> list[int]: ...
    @property
    def select_ms(self) -> list[float]: ...
    @property
    def draw_ms(self) -> list[float]: ...
    @property
    def levels(self) -> list[list[int]]: ...
    @property
    def num_parts(self) -> int: ...

class Batch:
    """Pictures that have been drawn, or enqueued on a device."""

    @property
    def color(self) -> Array: ...
    @property
    def alpha(self) -> Array | None: ...
    @property
    def depth(self) -> Array | None: ...
    @property
    def channels(self) -> Channels: ...
    def finish(self) -> None: ...
    def stats(self) -> BatchStats: ...

class GivenCut:
    """A cut that was selected earlier. Borrows the arrays.

    Args:
        weights: (S,) weights of clusters, 0 to 1; None if all are 1.
    """

    def __init__(
        self, instance_ids: Array, cluster_ids: Array, weights: Array | None = None
    ) -> None: ...

class Look:
    """The colours that a picture shows instead of the frame's own colours, and the
    choice of its cut.

    Args:
        shows: "error" shows metrics as fractions of the tolerance; "count" replaces
            depth by the number of gaussians that a pixel blends; "residency" shows
            where pages are missing. Any other value shows the colours of the gaussians
            or of a palette.
        colors: For a pool: (C, 3) colours of the clusters of each bundle.
        chooser: The camera for which the cut is selected; None for the camera of the
            picture.
        aside: For a pool: whether to draw only pages that were resident for the last
            picture, without requesting any.
    """

    def __init__(
        self,
        shows: str = "appearance",
        colors: list[Float32] = ...,
        chooser: Camera | Eyes | None = None,
        aside: bool = False,
    ) -> None: ...

class FrameRequest:
    """The request for one picture.

    Args:
        rule: The rule of the selection. With a cut, only its tolerance is used, for
            metrics.
        cut: A cut that is drawn instead of a selected one.
        look: The colours that the picture shows; None for the frame's own colours.
        sensor: Channels besides colour, and meshes; None for neither.
    """

    def __init__(
        self,
        camera: Camera | Eyes,
        rule: Rule | None = None,
        shade: Shade | None = None,
        cut: GivenCut | None = None,
        look: Look | None = None,
        sensor: Sensor | None = None,
    ) -> None: ...

class Pick:
    """The gaussian with the largest weight in a pixel."""

    @property
    def instance(self) -> int: ...
    @property
    def cluster(self) -> int: ...
    @property
    def weight(self) -> float: ...
    @property
    def depth(self) -> float: ...

class SceneFrame:
    """Draws scenes with the same bundles on one device, from models that were set, or
    from the resident part of a pool."""

    def __init__(self, device: int) -> None: ...
    def set_models(self, models: list[Model], palettes: list[Palette]) -> None: ...
    def draw(
        self,
        scene: ResidentScene,
        request: FrameRequest,
        pool: PagePool | None = None,
        steps: BudgetSteps | None = None,
        stop: Stop | None = None,
    ) -> Drawing: ...
    def draw_batch(
        self,
        scene: ResidentScene,
        cameras: Cameras,
        rule: Rule,
        shade: Shade,
        planes: BatchPlanes | None = None,
        sensor: Sensor | None = None,
    ) -> Batch: ...
    def pick(
        self, scene: ResidentScene, request: FrameRequest, pool: PagePool | None = None
    ) -> Pick | None: ...
    def memory(self) -> dict[str, int]: ...

class AssetFrame:
    """Draws gaussians without levels on the device where they are."""

    def __init__(
        self, model: Model, *, filter_px2: float = 0.0, antialiased: bool = False
    ) -> None: ...
    def draw(
        self,
        camera: Camera,
        shade: Shade,
        stop: Stop | None = None,
        sensor: Sensor | None = None,
    ) -> Drawing: ...

class FitConfig:
    """The settings of a fit. All of them are required."""

    def __init__(
        self,
        *,
        steps: int,
        views_per_step: int,
        num_views: int,
        supersample: int,
        image_size: int,
        px2_per_gaussian: float,
        distance: float,
        filter_px2: float,
        antialiased: bool,
        loss_l1: float,
        loss_dssim: float,
        loss_alpha: float,
        loss_cells: float,
        step_position: float,
        step_log_scale: float,
        step_quat: float,
        step_logit: float,
        step_sh0: float,
        step_sh_rest: float,
        position_in_world: bool,
        final_step: float,
        beta2: float,
        seed: int,
    ) -> None: ...

class FitProgress:
    """The progress of a fit. Any thread may read it and cancel the fit."""

    @property
    def groups_done(self) -> int: ...
    @property
    def loss_sum(self) -> float: ...
    def cancel(self) -> None: ...

class CutPictures:
    def __init__(
        self,
        *,
        table: ClusterTable,
        asset: Rows,
        cameras: Sequence[Camera],
        seed: int,
    ) -> None: ...
    def view(self, number: int, cut: int = 0) -> tuple[Camera, Int32, int]: ...

class FitTarget:
    """The gaussians to which groups are fitted."""

    def __init__(self, gaussians: Rows, filter_px2: float, antialiased: bool) -> None: ...

# Overwrites `gaussians`; returns (G, 2) the remaining errors of the groups.
def fit_level(
    config: FitConfig,
    target: FitTarget,
    target_range: Int64,
    gaussians: Rows,
    range: Int64,
    ball: Float32,
    stream: Int64,
    progress: FitProgress,
) -> Float32: ...

# The comparison of cuts with the asset. `refine_cuts` overwrites `gaussians`.
class CutComparison:
    """The number of windows per step of a refinement, the number of cuts per view, and
    the weight of the mean differences of windows."""

    def __init__(
        self, *, windows_per_step: int, cuts_per_view: int, window_means: float
    ) -> None: ...

def refine_cuts(
    *,
    config: FitConfig,
    comparison: CutComparison,
    target: FitTarget,
    gaussians: Rows,
    radius: Float32,
    pictures: CutPictures,
    progress: FitProgress,
) -> None: ...
def weigh_cuts(
    config: FitConfig, gaussians: Rows, pictures: CutPictures, progress: FitProgress
) -> tuple[Float64, Int32]: ...
def ssim(picture: Float32 | Float64, target: Float32 | Float64) -> float: ...
def dssim(picture: Float32, target: Float32) -> tuple[float, Float32]: ...
