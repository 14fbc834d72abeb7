"""Checkpoints of trainers, `.pt` and `.ckpt`: gsplat's `simple_trainer`, and splatfacto
of nerfstudio.

Both hold means, log scales, quaternions w x y z, logits of opacities and SH
coefficients as tensors, gsplat in a dict `splats`, nerfstudio among the values of
`pipeline`. The file is a zip of a pickle and of the numbers of each tensor. The pickle
is followed as far as it builds dicts, plain values and tensors; nothing that it names
is imported or called, and only the numbers of the gaussians are read.
"""

import math
import pickletools
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import refuse
from v3dg.formats._packing import DEGREES, Floats, assemble
from v3dg.formats._reading import (
    AnyPath,
    Archive,
    AssetFile,
    Claims,
    check,
    value_errors,
    whole_file,
)
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_FIELDS = ("means", "scales", "quats", "opacities", "sh0", "shN")
_NERFSTUDIO = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
_NERFSTUDIO_PREFIX = "_model.gauss_params."
_MAX_PICKLE = 1 << 20  # bytes; trainers' have far less, and each byte can be an object
_MAX_DIMENSIONS = 8
# Operations that push a plain value.
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
# Modules whose names a trainer's pickle may contain. Others are refused, and none is
# imported.
_ALLOWED_MODULES = (
    "torch",
    "torch._utils",
    "torch._tensor",
    "torch.nn.parameter",
    "collections",
    "_codecs",
)


# A value that a pickle builds: None, a number, text, a tuple, a dict, a _Named or a
# _Tensor. `value_errors` turns the errors of operations on another kind into
# ValueErrors.
_Value: TypeAlias = Any
_Numbers: TypeAlias = NDArray[np.number]


class _Named(NamedTuple):
    """Placeholder for a class, a function, or the result of calling one."""

    name: str


class _Tensor(NamedTuple):
    kind: str  # kind of its storage
    key: str
    num_stored: int
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def open_file(path: AnyPath) -> AssetFile:
    """Open a checkpoint; the gaussians are all read with the first rows."""
    claims = Claims()
    with claims.open(path) as file:
        fields = _fields_of(path, Archive(path, file))[0]
    count, num_higher = _size(path, fields, claims)
    return whole_file(path, count, DEGREES[num_higher], read)


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a checkpoint."""
    claims = Claims()
    with claims.open(path) as file:
        archive = Archive(path, file)
        fields, root = _fields_of(path, archive)
        count, num_higher = _size(path, fields, claims)
        arrays = {name: _array(path, name, field, archive, root) for name, field in fields.items()}
    shapes = {
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "opacities": (count,),
        "sh0": (count, 1, 3),
        "shN": (count, num_higher, 3),
    }
    for name, shape in shapes.items():
        fits = arrays[name].size == math.prod(shape)
        check(path, fits, f"{name} of shape {shape}, got {fields[name].shape}")
        arrays[name] = arrays[name].reshape(shape)

    def decode(rows: slice) -> tuple[Floats, ...]:
        means, scales, quats, logits, *sh = (_doubles(arrays[name][rows]) for name in _FIELDS)
        opacities = 1.0 / (1.0 + np.exp(-logits))
        return means, normalised(quats), np.exp(scales), opacities, np.concatenate(sh, axis=1)

    return assemble(count, DEGREES[num_higher], decode)


def _fields_of(path: AnyPath, archive: Archive) -> tuple[dict[str, _Tensor], str]:
    """The tensors of the gaussians, and the folder of the zip that holds their
    numbers."""
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
    return _fields(path, content), root


def _size(path: AnyPath, fields: dict[str, _Tensor], claims: Claims) -> tuple[int, int]:
    """Number of gaussians, and of coefficients a channel past the first."""
    count = fields["means"].shape[0]
    claims.add(path, count)
    shape = fields["shN"].shape
    num_higher = math.prod(shape) // max(1, 3 * count)
    check(path, num_higher in DEGREES, f"SH degree 0 to 3, got shN of shape {shape}")
    return count, num_higher


def _doubles(values: _Numbers) -> Floats:
    if values.dtype == np.uint16:  # bfloat16: the upper half of a float32
        values = (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(np.float64)


def _fields(path: AnyPath, content: _Value) -> dict[str, _Tensor]:
    """The tensors of the gaussians by the names that gsplat has for them; ValueError if
    one is missing."""
    members: dict[str, _Value] = {}
    if isinstance(content, dict):
        members = content
    splats = members.get("splats")
    pipeline = members.get("pipeline")
    if isinstance(splats, dict):
        values = [splats.get(name) for name in _FIELDS]
    elif isinstance(pipeline, dict):
        values = [pipeline.get(_NERFSTUDIO_PREFIX + name) for name in _NERFSTUDIO]
    else:
        keys = ", ".join(f"{key[:40]!a}" for key in list(members)[:6]) or "none"
        refuse(path, f"'splats' (gsplat) or 'pipeline' (nerfstudio), got {keys}")
    tensors = {}
    for name, value in zip(_FIELDS, values, strict=True):
        if not isinstance(value, _Tensor) or not value.shape:
            kind = type(value).__name__
            if isinstance(value, _Named):
                kind = f"{value.name!a}"
            refuse(path, f"a tensor of floats {name} in the checkpoint, got {kind}")
        tensors[name] = value
    return tensors


def _array(path: AnyPath, name: str, tensor: _Tensor, archive: Archive, root: str) -> _Numbers:
    """The numbers of a tensor; ValueError unless each of them is stored in the file."""
    steps = zip(tensor.shape, tensor.strides, strict=True)
    last = tensor.offset + sum((size - 1) * step for size, step in steps)
    count = math.prod(tensor.shape)
    stored_count = tensor.num_stored
    is_inside = count <= stored_count and (not count or last < stored_count)
    layout = (tensor.offset, tensor.shape, tensor.strides)
    check(path, is_inside, f"{name} within the {stored_count} numbers of its storage, got {layout}")
    dtype: np.dtype[np.number] = np.dtype(_TYPES[tensor.kind])
    content = archive.read(f"{root}data/{tensor.key}")
    size = stored_count * dtype.itemsize
    check(path, len(content) == size, f"{size} bytes of {name}, got {len(content)}")
    stored = np.frombuffer(content, dtype)[tensor.offset :]
    strides = [step * dtype.itemsize for step in tensor.strides]
    return np.lib.stride_tricks.as_strided(stored, tensor.shape, strides, writeable=False)


class _Unpickler:
    """Builds what torch.save pickled: values of lists are dropped, and dict entries
    whose key is not text.

    Each operation is one of a few on a stack, so time and memory are in proportion to
    the pickle.
    """

    def __init__(self) -> None:
        self._stack: list[_Value] = []
        self._marks: list[int] = []
        self._memo: dict[int, _Value] = {}

    def run(self, pickle: bytes) -> _Value:
        """The object that a pickle holds; ValueError for an operation or a name that is
        not allowed."""
        for opcode, argument, _ in pickletools.genops(pickle):
            if opcode.name == "STOP":
                break
            if not (self._push(opcode.name, argument) or self._combine(opcode.name)):
                operation = f"pickle operation {opcode.name}"
                raise ValueError(f"one with the {operation}, which this reader does not allow")
        return self._stack.pop()

    def _push(self, operation: str, argument: _Value) -> bool:
        """Apply an operation that leaves the values on the stack as they are; whether
        it is one."""
        match operation:
            case "PROTO" | "BINPERSID":
                pass  # the tuple that names a storage stands for the storage
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
        """Apply an operation that takes values from the stack; whether it is one."""
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
    """The name of a class or function, "module name"; ValueError unless its module is
    allowed."""
    module, _, name = argument.partition(" ")
    short = f"{module[:60]}.{name[:60]}"
    if module not in _ALLOWED_MODULES:
        raise ValueError(f"one whose pickle refers to {short}, which this reader does not allow")
    return _Named(short)


def _called(name: str, arguments: tuple[_Value, ...]) -> _Value:
    """The result of a call, without calling anything."""
    if name.startswith("collections."):
        return {}
    if name == "torch._utils._rebuild_parameter":
        return arguments[0]
    if name != "torch._utils._rebuild_tensor_v2":
        return _Named(name)
    (_, storage, key, _, num_stored), offset, shape, strides = arguments[:4]
    kind = storage.name.removeprefix("torch.")
    # Only as many numbers as a tensor may have dimensions: many calls can share a long
    # tuple.
    numbers = (num_stored, offset, *shape[:_MAX_DIMENSIONS], *strides[:_MAX_DIMENSIONS])
    is_plain = all(type(number) is int and 0 <= number < 1 << 48 for number in numbers)
    if (
        not is_plain
        or not isinstance(key, str)
        or not len(shape) == len(strides) <= _MAX_DIMENSIONS
    ):
        raise ValueError("one with a tensor whose shape is not plain numbers")
    if kind not in _TYPES:
        return _Named(kind)
    return _Tensor(kind, key, num_stored, offset, shape, strides)
