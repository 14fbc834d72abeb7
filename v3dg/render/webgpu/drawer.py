"""Draws cuts with WebGPU: gaussians are decoded and projected, sorted by depth, listed
for each tile of the picture, and blended tile by tile. The steps are those of
v3dg/export/web/renderer.js, and the shaders are the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from v3dg.render.webgpu.layout import GAUSSIANS_OF_WORKGROUP, camera_block, placements_of
from v3dg.render.webgpu.page_pool import PagePool

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import wgpu
    from numpy.typing import NDArray

    from v3dg.cameras import Camera
    from v3dg.render.webgpu.gpu import Gpu
    from v3dg.render.webgpu.layout import Cut
    from v3dg.scene import Scene

# The constants of the shaders.
_PAIRS_OF_WORKGROUP = 1024
_SIDE_OF_TILE = 16
_KEYS_OF_TILE = 1024
_DIGITS = 256
_BITS_OF_DIGIT = 8
_BITS_OF_DEPTH = 24
_MOST_TILES = (1 << 16) - 1
_MOST_WORKGROUPS = (1 << 16) - 1
_NOT_DRAWN = (1 << 32) - 1
_BYTES_OF_RECORD = 32
_BYTES_OF_SIZES = 16
_BYTES_OF_RANGE = 8
_BYTES_OF_PIXEL = 16
# Each pass of a sort moves the keys to the other side.
_DEPTH_PASSES = _BITS_OF_DEPTH // _BITS_OF_DIGIT
_DEPTH_SIDES = (("keys", "values"), ("other_keys", "other_values"))
_TILE_PASSES = 2
_TILE_SIDES = (("tiles", "gaussians"), ("other_tiles", "other_gaussians"))
_LISTED = ("other_values", "sizes", "blocks", "tiles", "gaussians", "pair_sizes")

_LEAST_CAPACITY = 1 << 14
# The buffers for pairs grow when a picture needs more.
_PAIRS_OF_GAUSSIAN = 2

# Types of the bindings of each step; None for numbers that the step does not use.
_PROJECTING = ("uniform", "read", "read", "read", "read", "write", "write", "write")
_SORTING = ("uniform", "read", "read", "write", "write", "write", "write", "read")
_LISTING = ("uniform", "read", "read", "read", "write", "write", "write", "write")
_FINDING = (None, None, "read", None, "read", "write")
_BLENDING = ("uniform", "read", None, "read", None, None, "read", "picture")


class Drawn(NamedTuple):
    """A drawn picture.

    Attributes:
        pixels: (H, W, 4) float32, premultiplied colour and alpha.
        num_gaussians: Number of gaussians in the picture.
    """

    pixels: NDArray[np.float32]
    num_gaussians: int


class Step(NamedTuple):
    """A dispatch of one pipeline, whose label is the entry point of its shader."""

    pipeline: wgpu.GPUComputePipeline
    group: wgpu.GPUBindGroup
    workgroups: tuple[int, ...]


class _Groups(NamedTuple):
    """The bind groups of all steps."""

    projecting: wgpu.GPUBindGroup
    depth_passes: list[wgpu.GPUBindGroup]
    listing: wgpu.GPUBindGroup
    tile_passes: list[wgpu.GPUBindGroup]
    finding: wgpu.GPUBindGroup
    blending: wgpu.GPUBindGroup


class _Buffers:
    """Buffers that grow, by name.

    Attributes:
        num_replaced: Number of new buffers so far.
    """

    def __init__(self, gpu: Gpu) -> None:
        from wgpu import BufferUsage

        self._gpu = gpu
        self._usage = BufferUsage.STORAGE | BufferUsage.COPY_DST | BufferUsage.COPY_SRC
        self._uniform = BufferUsage.UNIFORM | BufferUsage.COPY_DST
        self._buffers: dict[str, wgpu.GPUBuffer] = {}
        self.num_replaced = 0

    def __getitem__(self, name: str) -> wgpu.GPUBuffer:
        return self._buffers[name]

    def reserve(self, name: str, num_bytes: int) -> None:
        """Make a buffer at least this large; its content may be lost."""
        if name not in self._buffers or self._buffers[name].size < num_bytes:
            self._replace(name, num_bytes, self._usage)

    def set(self, name: str, array: NDArray[np.generic]) -> None:
        """Write an array to a buffer, which grows to hold it."""
        if name not in self._buffers or self._buffers[name].size < array.nbytes:
            self._replace(name, array.nbytes * 4 // 3, self._usage)
        self._gpu.write(self._buffers[name], array)

    def set_uniform(self, name: str, array: NDArray[np.generic]) -> None:
        if name not in self._buffers:
            self._replace(name, array.nbytes, self._uniform)
        self._gpu.write(self._buffers[name], array)

    def _replace(self, name: str, num_bytes: int, usage: int) -> None:
        if name in self._buffers:
            self._buffers.pop(name).destroy()
        self.num_replaced += 1
        self._buffers[name] = self._gpu.buffer((num_bytes + 3) // 4 * 4, usage)


def dispatch(computing: wgpu.GPUComputePassEncoder, step: Step) -> None:
    """Encode one step."""
    computing.set_pipeline(step.pipeline)
    computing.set_bind_group(0, step.group)
    computing.dispatch_workgroups(*step.workgroups)


class Drawer:
    """The pipelines and buffers of one device, which pictures use one after another.

    Attributes:
        gpu: The device.
        pool: The pages on the device.
    """

    def __init__(self, gpu: Gpu) -> None:
        self.gpu = gpu
        self.pool = PagePool(gpu)
        self._buffers = _Buffers(gpu)
        self._pair_capacity = 0
        self._picture: wgpu.GPUTexture | None = None
        self._groups: _Groups | None = None
        # What the bind groups were made for.
        self._bound: tuple[tuple[int, int], int, wgpu.GPUBuffer] | None = None
        self._layouts: dict[tuple[str | None, ...], wgpu.GPUBindGroupLayout] = {}
        project = gpu.shader("shared", "project")
        sort = gpu.shader("shared", "sort")
        tiles = gpu.shader("shared", "tiles")
        draw = gpu.shader("shared", "draw")
        self._project = self._pipeline(project, "project", _PROJECTING)
        self._count_digits = self._pipeline(sort, "count_digits", _SORTING)
        self._sum_counts = self._pipeline(sort, "sum_counts", _SORTING)
        self._move_keys = self._pipeline(sort, "move_keys", _SORTING)
        self._count_pairs = self._pipeline(tiles, "count_pairs", _LISTING)
        self._sum_blocks = self._pipeline(tiles, "sum_blocks", _LISTING)
        self._write_pairs = self._pipeline(tiles, "write_pairs", _LISTING)
        self._find_ranges = self._pipeline(draw, "find_ranges", _FINDING)
        self._blend = self._pipeline(draw, "blend", _BLENDING)

    @property
    def most_gaussians(self) -> int:
        """Largest number of gaussians of a cut."""
        by_memory = self.gpu.most_bytes // _BYTES_OF_RECORD
        return min(by_memory, _MOST_WORKGROUPS * GAUSSIANS_OF_WORKGROUP)

    def draw(self, cut: Cut, scene: Scene, camera: Camera, min_transmittance: float) -> Drawn:
        """Draw a cut whose pages are in the pool.

        Raises:
            RuntimeError: The device cannot draw so many gaussians, or so large a
                picture.
        """
        self._check_size(cut, camera)
        camera_words = camera_block(camera, cut.num_gaussians, min_transmittance)
        self._buffers.set_uniform("camera", camera_words)
        self._buffers.set("pairs", cut.pairs)
        self._buffers.set("first_pairs", cut.first_pairs)
        self._buffers.set("placements", placements_of(camera, scene, cut.instances))
        self._reserve(cut.num_gaussians)
        num_pairs = _PAIRS_OF_GAUSSIAN * max(cut.num_gaussians, _LEAST_CAPACITY)
        while True:
            self._reserve_pairs(num_pairs)
            picture = self._submit(cut.num_gaussians, camera)
            num_pairs = self._num_items("pair_sizes")
            if num_pairs <= self._pair_capacity:
                return Drawn(self._pixels(picture, camera), self._num_items("sizes"))

    def _num_items(self, name: str) -> int:
        """Return `num_items` of shared.wgsl. Waits until the picture is drawn."""
        return int(self.gpu.read(self._buffers[name], _BYTES_OF_SIZES)[3])

    def _check_size(self, cut: Cut, camera: Camera) -> None:
        columns, rows = _tiles_of(camera)
        if columns * rows > _MOST_TILES:
            raise ValueError(
                f"camera: expected a picture of at most {_MOST_TILES:,} tiles of 16 x 16 px with "
                f"WebGPU, got {camera.width} x {camera.height} px; draw it in parts"
            )
        if cut.num_gaussians > self.most_gaussians:
            raise RuntimeError(
                f"device: the cut has {cut.num_gaussians:,} gaussians, and {self.gpu.name} can "
                f"draw {self.most_gaussians:,} through WebGPU; lower the budget or raise the "
                "tolerance"
            )

    def _pipeline(
        self, module: wgpu.GPUShaderModule, entry: str, types: tuple[str | None, ...]
    ) -> wgpu.GPUComputePipeline:
        device = self.gpu.device
        if types not in self._layouts:
            self._layouts[types] = _layout_of(device, types)
        layout = device.create_pipeline_layout(bind_group_layouts=[self._layouts[types]])
        return device.create_compute_pipeline(
            label=entry, layout=layout, compute={"module": module, "entry_point": entry}
        )

    def _group(self, types: tuple[str | None, ...], names: Sequence[str]) -> wgpu.GPUBindGroup:
        """Return a bind group of the named buffers, in the order of the bindings."""
        assert self._picture is not None
        entries = []
        remaining = iter(names)
        for binding, kind in enumerate(types):
            if kind == "picture":
                entries.append({"binding": binding, "resource": self._picture.create_view()})
            elif kind is not None:
                buffer = self._buffer_of(next(remaining))
                resource = {"buffer": buffer, "offset": 0, "size": buffer.size}
                entries.append({"binding": binding, "resource": resource})
        return self.gpu.device.create_bind_group(layout=self._layouts[types], entries=entries)

    def _buffer_of(self, name: str) -> wgpu.GPUBuffer:
        if name == "pool":
            return self.pool.buffer
        return self._buffers[name]

    def _reserve(self, num_gaussians: int) -> None:
        count = max(num_gaussians, _LEAST_CAPACITY)
        self._buffers.reserve("records", _BYTES_OF_RECORD * count)
        for name in ("keys", "values", "other_keys", "other_values"):
            self._buffers.reserve(name, 4 * count)
        self._buffers.reserve("blocks", 4 * _divided(count, GAUSSIANS_OF_WORKGROUP))
        self._buffers.reserve("counts", 4 * _DIGITS * _divided(count, _KEYS_OF_TILE))
        self._buffers.reserve("totals", 4 * _DIGITS)
        self._buffers.reserve("sizes", _BYTES_OF_SIZES)
        self._buffers.reserve("pair_sizes", _BYTES_OF_SIZES)
        self._buffers.reserve("ranges", _BYTES_OF_RANGE * _MOST_TILES)

    def _reserve_pairs(self, num_pairs: int) -> None:
        max_pairs = min(self.gpu.most_bytes // 4, _MOST_WORKGROUPS * _PAIRS_OF_WORKGROUP)
        if num_pairs > max_pairs:
            raise RuntimeError(
                f"device: the picture has {num_pairs:,} pairs of gaussians and tiles, and "
                f"{self.gpu.name} can sort {max_pairs:,} through WebGPU; lower the budget or draw "
                "a smaller picture"
            )
        if num_pairs <= self._pair_capacity:
            return
        self._pair_capacity = min(num_pairs * 5 // 4, max_pairs)
        for name in ("tiles", "gaussians", "other_tiles", "other_gaussians"):
            self._buffers.reserve(name, 4 * self._pair_capacity)
        num_tiles = _divided(self._pair_capacity, _KEYS_OF_TILE)
        self._buffers.reserve("counts", 4 * _DIGITS * num_tiles)

    def _submit(self, num_gaussians: int, camera: Camera) -> wgpu.GPUTexture:
        """Enqueue all steps of a picture."""
        buffers = self._buffers
        buffers.set("sizes", np.array([num_gaussians, _NOT_DRAWN, 0, 0], np.uint32))
        buffers.set("pair_sizes", np.zeros(4, np.uint32))
        num_tiles = _divided(num_gaussians, _KEYS_OF_TILE)
        self._set_passes("depth", num_tiles, _DEPTH_PASSES, _BITS_OF_DEPTH)
        num_pair_tiles = _divided(self._pair_capacity, _KEYS_OF_TILE)
        self._set_passes("tile", num_pair_tiles, _TILE_PASSES, 0)
        self._bind(camera)
        encoder = self.gpu.device.create_command_encoder()
        encoder.clear_buffer(buffers["ranges"], 0, buffers["ranges"].size)
        self.encode(encoder, self._steps(num_gaussians, camera))
        self.gpu.device.queue.submit([encoder.finish()])
        assert self._picture is not None
        return self._picture

    def encode(self, encoder: wgpu.GPUCommandEncoder, steps: Iterator[Step]) -> None:
        """Encode the steps of a picture, each of which waits for the one before."""
        computing = encoder.begin_compute_pass()
        for step in steps:
            dispatch(computing, step)
        computing.end()

    def _set_passes(self, name: str, num_tiles: int, num_passes: int, bits: int) -> None:
        """Write the uniforms of the passes of one sort."""
        for number in range(num_passes):
            is_first = bits > 0 and number == 0
            words = [_BITS_OF_DIGIT * number, num_tiles, bits, int(is_first)]
            self._buffers.set_uniform(f"{name} pass {number}", np.array(words, np.uint32))

    def _bind(self, camera: Camera) -> None:
        """Renew the bind groups if buffers or the size of the picture have changed."""
        size = (camera.width, camera.height)
        bound = (size, self._buffers.num_replaced, self.pool.buffer)
        if self._bound == bound:
            return
        self._picture = self._new_picture(size)
        self._bound = bound
        inputs = ["camera", "pool", "pairs", "first_pairs", "placements"]
        self._groups = _Groups(
            projecting=self._group(_PROJECTING, [*inputs, "records", "keys", "sizes"]),
            depth_passes=self._pass_groups("depth", _DEPTH_PASSES, _DEPTH_SIDES, "sizes"),
            listing=self._group(_LISTING, ["camera", "records", *_LISTED]),
            tile_passes=self._pass_groups("tile", _TILE_PASSES, _TILE_SIDES, "pair_sizes"),
            finding=self._group(_FINDING, ["tiles", "pair_sizes", "ranges"]),
            blending=self._group(_BLENDING, ["camera", "records", "gaussians", "ranges"]),
        )

    def _pass_groups(
        self,
        name: str,
        num_passes: int,
        sides: tuple[tuple[str, str], tuple[str, str]],
        sizes: str,
    ) -> list[wgpu.GPUBindGroup]:
        """Return the bind groups of the passes of one sort, which read from one side
        and write to the other one."""
        groups = []
        for number in range(num_passes):
            source = sides[number % 2]
            target = sides[1 - number % 2]
            names = [f"{name} pass {number}", *source, *target, "counts", "totals", sizes]
            groups.append(self._group(_SORTING, names))
        return groups

    def _steps(self, num_gaussians: int, camera: Camera) -> Iterator[Step]:
        """Yield the steps of a picture."""
        groups = self._groups
        assert groups is not None
        num_blocks = _divided(num_gaussians, GAUSSIANS_OF_WORKGROUP)
        yield Step(self._project, groups.projecting, (num_blocks,))
        num_tiles = _divided(num_gaussians, _KEYS_OF_TILE)
        for group in groups.depth_passes:
            yield from self._sorting_steps(group, num_tiles)
        yield Step(self._count_pairs, groups.listing, (num_blocks,))
        yield Step(self._sum_blocks, groups.listing, (1,))
        yield Step(self._write_pairs, groups.listing, (num_blocks,))
        num_pair_tiles = _divided(self._pair_capacity, _KEYS_OF_TILE)
        for group in groups.tile_passes:
            yield from self._sorting_steps(group, num_pair_tiles)
        num_workgroups = _divided(self._pair_capacity, _PAIRS_OF_WORKGROUP)
        yield Step(self._find_ranges, groups.finding, (num_workgroups,))
        yield Step(self._blend, groups.blending, _tiles_of(camera))

    def _sorting_steps(self, group: wgpu.GPUBindGroup, num_tiles: int) -> Iterator[Step]:
        yield Step(self._count_digits, group, (num_tiles,))
        yield Step(self._sum_counts, group, (_DIGITS,))
        yield Step(self._move_keys, group, (num_tiles,))

    def _new_picture(self, size: tuple[int, int]) -> wgpu.GPUTexture:
        from wgpu import TextureUsage

        if self._picture is not None:
            self._picture.destroy()
        usage = TextureUsage.STORAGE_BINDING | TextureUsage.COPY_SRC
        return self.gpu.device.create_texture(size=(*size, 1), format="rgba32float", usage=usage)

    def _pixels(self, picture: wgpu.GPUTexture, camera: Camera) -> NDArray[np.float32]:
        """Return the pixels of a picture, (H, W, 4). Waits until it is drawn."""
        num_bytes = _BYTES_OF_PIXEL * camera.width
        data = self.gpu.device.queue.read_texture(
            {"texture": picture},
            {"bytes_per_row": num_bytes, "rows_per_image": camera.height},
            (camera.width, camera.height, 1),
        )
        return np.frombuffer(data, np.float32).reshape(camera.height, camera.width, 4)


def _divided(count: int, size: int) -> int:
    """Return the number of parts of a size that contain a number of items."""
    return (count + size - 1) // size


def _tiles_of(camera: Camera) -> tuple[int, int]:
    """Return the numbers of columns and of rows of tiles."""
    return _divided(camera.width, _SIDE_OF_TILE), _divided(camera.height, _SIDE_OF_TILE)


def _layout_of(device: wgpu.GPUDevice, types: tuple[str | None, ...]) -> wgpu.GPUBindGroupLayout:
    from wgpu import ShaderStage

    buffer_types = {"uniform": "uniform", "read": "read-only-storage", "write": "storage"}
    entries: list[dict[str, object]] = []
    for binding, kind in enumerate(types):
        entry: dict[str, object] = {"binding": binding, "visibility": ShaderStage.COMPUTE}
        if kind == "picture":
            entry["storage_texture"] = {"access": "write-only", "format": "rgba32float"}
        elif kind is not None:
            entry["buffer"] = {"type": buffer_types[kind]}
        if kind is not None:
            entries.append(entry)
    return device.create_bind_group_layout(entries=entries)
