"""Checkpoints of trainers, `.pt`, `.ckpt` and `.pth`: gsplat's `simple_trainer`,
splatfacto of nerfstudio, and the code of the 3DGS paper and of 2DGS.

All of them store means, log scales, quaternions w x y z, opacity logits and SH
coefficients as tensors: gsplat in a dict `splats`, nerfstudio among the values of
`pipeline`, the code of the papers in a tuple. `_Layout` describes the differences.

The file is a zip of a pickle and of the numbers of each tensor. Of the pickle, only
operations that build dicts, plain values and tensors are followed: nothing is imported
or called. Of the tensors, only those of the gaussians are read. The settings of a run
are in a YAML file beside the checkpoint; single lines of that file are read.
"""

import math
import pickletools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import refuse
from v3dg.formats._declared import Declared
from v3dg.formats._packing import DEGREES, SH_C0, Floats, assemble
from v3dg.formats._reading import (
    AnyPath,
    Archive,
    AssetFile,
    Claims,
    check,
    listed,
    value_errors,
    whole_file,
)
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_FIELDS = ("means", "scales", "quats", "opacities", "sh0", "shN")
_NERFSTUDIO = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
# The second prefix is that of nerfstudio before version 1.1.
_NERFSTUDIO_PREFIXES = ("_model.gauss_params.", "_model.")
# Indices into the tuple that the papers' code stores, in the order of _FIELDS.
_CAPTURED = (1, 4, 5, 6, 2, 3)
_MIN_CAPTURE = 12  # length of that tuple; variants append more values
# Members of a checkpoint that do not describe gaussians.
_GSPLAT_MEMBERS = ("step", "splats", "optimizers", "schedulers", "strategy_state")
_NERFSTUDIO_MEMBERS = ("device_indicator_param", "background_color", "lpips", "psnr", "ssim")
_NOT_GAUSSIANS = {
    "app_module": (
        "The appearance model of single photographs (app_module) is ignored: colours are those "
        "without it."
    ),
    "bil_grids": (
        "The bilateral grids of single photographs are ignored: colours are those before the "
        "grids are applied."
    ),
    "pose_adjust": (
        "Training moved the cameras (pose_adjust), so those of the data set do not match exactly."
    ),
    "camera_optimizer": (
        "Training moved the cameras (camera_optimizer), so those of the data set do not match "
        "exactly."
    ),
}
_NOT_GAUSSIANS["bilagrid"] = _NOT_GAUSSIANS["bil_grids"]
_SETTINGS = ("cfg.yml", "config.yml")  # of gsplat and of nerfstudio
_MAX_SETTINGS_BYTES = 1 << 20
# Bytes; trainers write far less, and each byte could create an object.
_MAX_PICKLE = 1 << 20
_MAX_DIMENSIONS = 8
# Operations that push a plain value on the stack.
_VALUES = (
    "BININT",
    "BININT1",
    "BININT2",
    "LONG1",
    "BINFLOAT",
    "BINUNICODE",
    "NONE",
    "NEWTRUE",
    "NEWFALSE",
)
_TYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "BFloat16Storage": "<u2",
}
# Modules whose names may occur in a trainer's pickle. Other names are errors, and no
# module is imported.
_ALLOWED_MODULES = (
    "numpy",
    "numpy.core.multiarray",
    "numpy._core.multiarray",
    "torch",
    "torch._utils",
    "torch._tensor",
    "torch.nn.parameter",
    "collections",
    "_codecs",
)


# A value that a pickle creates: None, a number, a text, a tuple, a dict, a _Named or a
# _Tensor. Operations on a value of the wrong kind raise errors, which `value_errors`
# converts to ValueError.
_Value: TypeAlias = Any
_Numbers: TypeAlias = NDArray[np.number]


class _Named(NamedTuple):
    """Placeholder for a class, for a function, or for the result of a call."""

    name: str


class _Tensor(NamedTuple):
    kind: str  # the type of the stored numbers
    key: str
    num_stored: int
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Layout(NamedTuple):
    """The tensors of the gaussians in a checkpoint, and their encoding.

    Attributes:
        fields: The tensors, by their names in gsplat. If `shN` is missing, `sh0`
            contains logits of colours without view dependence.
        notes: Sentences about other content of the checkpoint.
    """

    fields: dict[str, _Tensor]
    notes: tuple[str, ...] = ()

    @property
    def has_logits(self) -> bool:
        return "shN" not in self.fields

    @property
    def num_scales(self) -> int:
        """Number of stored scales per gaussian: 2 for 2DGS, whose gaussians are
        flat."""
        if self.fields["scales"].shape[1:] == (2,):
            return 2
        return 3


class _Settings(NamedTuple):
    """The settings of a training run that affect its gaussians."""

    antialiased: bool | None = None
    is_flat: bool = False
    notes: tuple[str, ...] = ()


def open_file(path: AnyPath) -> AssetFile:
    """Open a checkpoint. The first read loads all gaussians."""
    claims = Claims()
    with claims.open(path) as file:
        layout = _layout_of(path, Archive(path, file))[0]
    count, num_higher = _size(path, layout, claims)
    settings = _settings_of(path)
    notes = [*layout.notes, *settings.notes]
    if layout.num_scales == 2 or settings.is_flat:
        notes.append(
            "The gaussians are those of 2DGS; they were read as ellipsoids of no thickness."
        )
    if layout.has_logits:
        notes.append("Colours are stored as logits without view dependence, and were read as such.")
    declared = Declared(antialiased=settings.antialiased, notes=tuple(notes))
    return whole_file(path, count, DEGREES[num_higher], read, declared=declared)


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a checkpoint."""
    claims = Claims()
    with claims.open(path) as file:
        archive = Archive(path, file)
        layout, root = _layout_of(path, archive)
        count, num_higher = _size(path, layout, claims)
        arrays = {
            name: _array(path, name, field, archive, root) for name, field in layout.fields.items()
        }
    shapes = {
        "means": (count, 3),
        "scales": (count, layout.num_scales),
        "quats": (count, 4),
        "opacities": (count,),
        "sh0": (count, 1, 3),
        "shN": (count, num_higher, 3),
    }
    for name, array in arrays.items():
        shape = shapes[name]
        fits = array.size == math.prod(shape)
        check(path, fits, f"{name} of shape {shape}, got {layout.fields[name].shape}")
        arrays[name] = array.reshape(shape)
    is_flat = _settings_of(path).is_flat

    def decode(rows: slice) -> tuple[Floats, ...]:
        block = {name: _doubles(array[rows]) for name, array in arrays.items()}
        scales = np.zeros((len(block["means"]), 3))
        scales[:, : layout.num_scales] = np.exp(block["scales"])
        if is_flat:
            scales[:, 2] = 0.0
        sh = block["sh0"]
        if layout.has_logits:
            sh = (_sigmoid(sh) - 0.5) / SH_C0
        else:
            sh = np.concatenate([sh, block["shN"]], axis=1)
        opacities = _sigmoid(block["opacities"])
        return block["means"], normalised(block["quats"]), scales, opacities, sh

    return assemble(count, DEGREES[num_higher], decode)


def _sigmoid(logits: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))


def _layout_of(path: AnyPath, archive: Archive) -> tuple[_Layout, str]:
    """Return the layout of the gaussians, and the folder of the zip that contains the
    tensors."""
    root = next((name[:-8] for name in archive.names if name.endswith("data.pkl")), "")
    pickle = archive.read(f"{root}data.pkl")
    check(
        path,
        len(pickle) <= _MAX_PICKLE,
        f"a pickle of at most {_MAX_PICKLE} bytes, got {len(pickle)}",
    )
    is_little = (
        f"{root}byteorder" not in archive.names or archive.read(f"{root}byteorder") == b"little"
    )
    check(path, is_little, "little-endian numbers, got a checkpoint of another byte order")
    with value_errors(path, "a checkpoint of tensors and plain values"):
        content = _Unpickler().run(pickle)
    return _layout(path, content), root


def _size(path: AnyPath, layout: _Layout, claims: Claims) -> tuple[int, int]:
    """Return the number of gaussians, and the number of higher SH coefficients per
    channel."""
    count = layout.fields["means"].shape[0]
    claims.add(path, count)
    if layout.has_logits:
        return count, 0
    shape = layout.fields["shN"].shape
    num_higher = math.prod(shape) // max(1, 3 * count)
    check(path, num_higher in DEGREES, f"SH degree 0 to 3, got shN of shape {shape}")
    return count, num_higher


def _settings_of(path: AnyPath) -> _Settings:
    """Return the settings of the run from a file in the folder of the checkpoint or the
    folder above; defaults if there is no such file."""
    folder = Path(path).absolute().parent
    files = [place / name for place in (folder, folder.parent) for name in _SETTINGS]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return _Settings()
    with Claims().open(file) as opened:
        content = opened.read(_MAX_SETTINGS_BYTES + 1)
    if len(content) > _MAX_SETTINGS_BYTES:
        note = f"{file.name} is too large for the settings of a run and was ignored."
        return _Settings(notes=(note,))
    # The YAML may contain Python objects, so only lines with a name and a plain value
    # are read.
    pattern = r"^[ ]*(\w+): +'?([\w.+-]+)'?[ ]*\r?$"
    if file.name == _SETTINGS[0]:
        # Only unindented lines are settings of the run itself.
        pattern = pattern.replace("[ ]*", "", 1)
    text = content.decode("utf-8", errors="replace")
    values: dict[str, str] = {}
    for name, value in re.findall(pattern, text, re.MULTILINE):
        values.setdefault(name, value)
    return _settings(values)


def _settings(values: Mapping[str, str]) -> _Settings:
    antialiased: bool | None = None
    if "rasterize_mode" in values:
        antialiased = values["rasterize_mode"] == "antialiased"
    elif "antialiased" in values:
        antialiased = values["antialiased"] == "true"
    notes = []
    if values.get("with_eval3d") == "true":
        notes.append(
            "Gaussians were trained to be evaluated along rays (with_eval3d), so pictures that "
            "project them differ."
        )
    return _Settings(antialiased, values.get("model_type", "").startswith("2dgs"), tuple(notes))


def _doubles(values: _Numbers) -> Floats:
    if values.dtype == np.uint16:  # bfloat16: the upper half of a float32
        values = (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(np.float64)


def _layout(path: AnyPath, content: _Value) -> _Layout:
    """Return the layout of the gaussians in the pickled object; raise ValueError if a
    part is missing."""
    members: dict[str, _Value] = {}
    if isinstance(content, dict):
        members = content
    splats = members.get("splats")
    pipeline = members.get("pipeline")
    if isinstance(splats, dict):
        unread = _left_out(name for name in members if name not in _GSPLAT_MEMBERS)
        return _gsplat_layout(path, splats, unread)
    if isinstance(pipeline, dict):
        return _nerfstudio_layout(path, pipeline)
    is_captured = isinstance(content, tuple) and len(content) == 2
    if not is_captured or not isinstance(content[0], tuple):
        expected = "'splats' (gsplat), 'pipeline' (nerfstudio) or a tuple (the code of 3DGS)"
        refuse(path, f"{expected}, got {listed(members) or 'none'}")
    captured = content[0]
    has_fields = len(captured) >= _MIN_CAPTURE
    check(
        path,
        has_fields,
        f"at least {_MIN_CAPTURE} values in the tuple of the 3DGS code, got {len(captured)}",
    )
    values = dict(zip(_FIELDS, (captured[i] for i in _CAPTURED), strict=True))
    return _Layout(_tensors(path, values))


def _gsplat_layout(path: AnyPath, splats: dict[str, _Value], notes: tuple[str, ...]) -> _Layout:
    values = {name: splats.get(name) for name in _FIELDS}
    used = set(_FIELDS)
    if "colors" in splats and "sh0" not in splats:  # trained with app_opt
        used = {*_FIELDS[:4], "colors", "features"}
        values = {name: splats.get(name) for name in _FIELDS[:4]} | {"sh0": splats["colors"]}
        notes = _left_out(["app_module"]) + tuple(
            note for note in notes if note != _NOT_GAUSSIANS["app_module"]
        )
    unread = [name for name in splats if name not in used]
    if unread:
        notes += (f"Tensors of splats were ignored: {listed(unread)}.",)
    return _Layout(_tensors(path, values), notes)


def _nerfstudio_layout(path: AnyPath, pipeline: dict[str, _Value]) -> _Layout:
    prefix = next(
        (prefix for prefix in _NERFSTUDIO_PREFIXES if f"{prefix}means" in pipeline),
        _NERFSTUDIO_PREFIXES[0],
    )
    names = [prefix + name for name in _NERFSTUDIO]
    values = {field: pipeline.get(name) for field, name in zip(_FIELDS, names, strict=True)}
    modules = [
        name.removeprefix("_model.").split(".")[0]
        for name in pipeline
        if name.startswith("_model.") and name not in names
    ]
    unread = dict.fromkeys(name for name in modules if name not in _NERFSTUDIO_MEMBERS)
    notes = _left_out(unread)
    tensors = _tensors(path, values)
    if math.prod(tensors["shN"].shape) == 0 and tensors["means"].shape[0] > 0:
        # With SH degree 0, splatfacto stores logits of colours.
        del tensors["shN"]
    return _Layout(tensors, notes)


def _left_out(members: Iterable[str]) -> tuple[str, ...]:
    """Return a sentence for each ignored member that is known to change the picture,
    and one sentence for all other ignored members."""
    names = list(members)
    notes = [_NOT_GAUSSIANS[name] for name in names if name in _NOT_GAUSSIANS]
    unknown = [name for name in names if name not in _NOT_GAUSSIANS]
    if unknown:
        notes.append(f"Parts of the checkpoint were ignored: {listed(unknown)}.")
    return tuple(notes)


def _tensors(path: AnyPath, values: Mapping[str, _Value]) -> dict[str, _Tensor]:
    tensors = {}
    for name, value in values.items():
        if not isinstance(value, _Tensor) or not value.shape:
            kind = type(value).__name__
            if isinstance(value, _Named):
                kind = f"{value.name!a}"
            refuse(path, f"{name} in the checkpoint to be a tensor of floats, got {kind}")
        tensors[name] = value
    return tensors


def _array(path: AnyPath, name: str, tensor: _Tensor, archive: Archive, root: str) -> _Numbers:
    """Return the numbers of a tensor; raise ValueError unless the file contains all of
    them."""
    steps = zip(tensor.shape, tensor.strides, strict=True)
    last = tensor.offset + sum((size - 1) * step for size, step in steps)
    count = math.prod(tensor.shape)
    stored_count = tensor.num_stored
    is_inside = count <= stored_count and (not count or last < stored_count)
    layout = (tensor.offset, tensor.shape, tensor.strides)
    check(
        path,
        is_inside,
        f"{name} within the {stored_count} numbers of its storage, got offset, shape and strides "
        f"{layout}",
    )
    dtype: np.dtype[np.number] = np.dtype(_TYPES[tensor.kind])
    content = archive.read(f"{root}data/{tensor.key}")
    size = stored_count * dtype.itemsize
    check(path, len(content) == size, f"{size} bytes of {name}, got {len(content)}")
    stored = np.frombuffer(content, dtype)[tensor.offset :]
    strides = [step * dtype.itemsize for step in tensor.strides]
    return np.lib.stride_tricks.as_strided(stored, tensor.shape, strides, writeable=False)


class _Unpickler:
    """Builds the object that torch.save pickled, without the values of lists and
    without dict entries whose key is not text.

    Only a few stack operations are allowed, so time and memory are proportional to the
    size of the pickle.
    """

    def __init__(self) -> None:
        self._stack: list[_Value] = []
        self._marks: list[int] = []
        self._memo: dict[int, _Value] = {}

    def run(self, pickle: bytes) -> _Value:
        """Return the object in a pickle; raise ValueError for an operation or a name
        that is not allowed."""
        for opcode, argument, _ in pickletools.genops(pickle):
            if opcode.name == "STOP":
                break
            if not (self._push(opcode.name, argument) or self._combine(opcode.name)):
                operation = f"pickle operation {opcode.name}"
                advice = "save it as .ply with the trainer"
                raise ValueError(f"one with the {operation}, which is not allowed; {advice}")
        return self._stack.pop()

    def _push(self, operation: str, argument: _Value) -> bool:
        """Apply an operation that only adds to the stack; return whether `operation` is
        one of these."""
        match operation:
            case "PROTO" | "BINPERSID":
                # The tuple that describes a storage is used in place of the storage.
                pass
            case "MARK":
                self._marks.append(len(self._stack))
            case "EMPTY_DICT":
                self._stack.append({})
            case "EMPTY_LIST" | "EMPTY_TUPLE":
                self._stack.append(())
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = self._stack[-1]
            case "BINGET" | "LONG_BINGET":
                self._stack.append(self._memo[argument])
            case "GLOBAL":
                self._stack.append(_allowed_name(argument))
            case _:
                if operation not in _VALUES:
                    return False
                self._stack.append(argument)
        return True

    def _combine(self, operation: str) -> bool:
        """Apply an operation that takes values from the stack; return whether
        `operation` is one of these."""
        match operation:
            case "TUPLE":
                self._stack.append(tuple(self._above_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                size = int(operation[-1])
                self._stack[-size:] = [tuple(self._stack[-size:])]
            case "SETITEM":
                key = self._stack.pop(-2)
                self._set_items([key, self._stack.pop()])
            case "SETITEMS":
                self._set_items(self._above_mark())
            case "APPEND" | "BUILD":
                self._stack.pop()
            case "APPENDS":
                self._above_mark()
            case "REDUCE" | "NEWOBJ":
                arguments = self._stack.pop()
                self._stack[-1] = _called(self._stack[-1].name, arguments)
            case _:
                return False
        return True

    def _above_mark(self) -> list[_Value]:
        start = self._marks.pop()
        values = self._stack[start:]
        del self._stack[start:]
        return values

    def _set_items(self, items: list[_Value]) -> None:
        pairs = zip(items[::2], items[1::2], strict=True)
        self._stack[-1].update((key, value) for key, value in pairs if isinstance(key, str))


def _allowed_name(argument: str) -> _Named:
    """Return the placeholder for a class or a function, given "module name"; raise
    ValueError if the module is not allowed."""
    module, _, name = argument.partition(" ")
    short = f"{module[:60]}.{name[:60]}"
    if module not in _ALLOWED_MODULES:
        advice = "save it as .ply with the trainer"
        raise ValueError(f"one that refers to {short}, which is not allowed; {advice}")
    return _Named(short)


def _called(name: str, arguments: tuple[_Value, ...]) -> _Value:
    """Return a placeholder for the result of a call; nothing is called."""
    if name.startswith("collections."):
        return {}
    if name == "torch._utils._rebuild_parameter":
        return arguments[0]
    if name != "torch._utils._rebuild_tensor_v2":
        return _Named(name)
    (_, storage, key, _, num_stored), offset, shape, strides = arguments[:4]
    kind = storage.name.removeprefix("torch.")
    # Limited to the number of dimensions that a tensor may have, because many calls can
    # share a long tuple.
    numbers = (num_stored, offset, *shape[:_MAX_DIMENSIONS], *strides[:_MAX_DIMENSIONS])
    is_plain = all(type(number) is int and 0 <= number < 1 << 48 for number in numbers)
    if (
        not is_plain
        or not isinstance(key, str)
        or not len(shape) == len(strides) <= _MAX_DIMENSIONS
    ):
        raise ValueError("one with a tensor whose shape is damaged")
    if kind not in _TYPES:
        return _Named(kind)
    return _Tensor(kind, key, num_stored, offset, shape, strides)
