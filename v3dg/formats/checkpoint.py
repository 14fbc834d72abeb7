"""Checkpoints of trainers, `.pt` and `.ckpt`: gsplat's `simple_trainer`, and splatfacto of nerfstudio.

Both hold means, log scales, quaternions w x y z, logits of opacities and SH coefficients as tensors, gsplat
in a dict `splats`, nerfstudio among the values of `pipeline`. The file is a zip of a pickle and of the
numbers of each tensor. The pickle is followed as far as it builds dicts, plain values and tensors; nothing
that it names is imported or called, and only the numbers of the gaussians are read.
"""

import math
import pickletools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import DEGREES, Floats, assemble
from v3dg.formats._reading import Archive, AssetFile, Claims, Path, check, telling, whole_file
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_FIELDS = ("means", "scales", "quats", "opacities", "sh0", "shN")
_NERFSTUDIO = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
_NERFSTUDIO_PREFIX = "_model.gauss_params."
_MAX_PICKLE = 1 << 20  # bytes; trainers' have far less, and each byte can be an object
_MAX_DIMENSIONS = 8
# Operations that push a value; of those without one, no field is told by it.
_VALUES = ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "NONE", "NEWTRUE", "NEWFALSE")
_TYPES = {"DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "BFloat16Storage": "<u2"}
# Modules of which a trainer's own values are, such as a device. Others are refused, and none is imported.
_KNOWN = ("torch", "torch._utils", "torch._tensor", "torch.nn.parameter", "collections", "_codecs")


class _Named(NamedTuple):
    """What stands for a class, a function or what a call of it would make."""

    name: str


class _Tensor(NamedTuple):
    kind: str  # of its storage
    key: str
    num_stored: int
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def open_file(path: Path) -> AssetFile:
    """Open a checkpoint; the gaussians are all read with the first rows."""
    claims = Claims()
    with claims.open(path) as file:
        fields = _fields_of(path, Archive(path, file))[0]
    count, num_higher = _size(path, fields, claims)
    return whole_file(path, count, DEGREES[num_higher], read)


def read(path: Path) -> Gaussians:
    """Read the gaussians of a checkpoint."""
    claims = Claims()
    with claims.open(path) as file:
        archive = Archive(path, file)
        fields, root = _fields_of(path, archive)
        count, num_higher = _size(path, fields, claims)
        arrays = {name: _array(path, name, field, archive, root) for name, field in fields.items()}
    wanted = ((count, 3), (count, 3), (count, 4), (count,), (count, 1, 3), (count, num_higher, 3))
    for name, shape in zip(_FIELDS, wanted, strict=True):
        fits = arrays[name].size == math.prod(shape)
        check(path, fits, f"{name} of shape {shape}, got {fields[name].shape}")
        arrays[name] = arrays[name].reshape(shape)

    def decode(rows: slice) -> tuple[Floats, ...]:
        means, scales, quats, logits, *sh = (_doubles(arrays[name][rows]) for name in _FIELDS)
        opacities = 1.0 / (1.0 + np.exp(-logits))
        return means, normalised(quats), np.exp(scales), opacities, np.concatenate(sh, axis=1)

    return assemble(count, DEGREES[num_higher], decode)


def _fields_of(path: Path, archive: Archive) -> tuple[dict[str, _Tensor], str]:
    """Where the tensors of the gaussians are, and in which folder of the zip."""
    root = next((name[:-8] for name in archive.names if name.endswith("data.pkl")), "")
    pickle = archive.read(f"{root}data.pkl")
    check(path, len(pickle) <= _MAX_PICKLE, f"a pickle of at most {_MAX_PICKLE} bytes, got {len(pickle)}")
    is_little = f"{root}byteorder" not in archive.names or archive.read(f"{root}byteorder") == b"little"
    check(path, is_little, "little-endian numbers, got a checkpoint of another byte order")
    with telling(path, "a checkpoint of tensors and plain values"):
        content = _followed(pickle)
    return _fields(path, content), root


def _size(path: Path, fields: dict[str, _Tensor], claims: Claims) -> tuple[int, int]:
    """How many gaussians there are, and how many coefficients a channel past the first."""
    count = fields["means"].shape[0]
    claims.add(path, count)
    shape = fields["shN"].shape
    num_higher = math.prod(shape) // max(1, 3 * count)
    check(path, num_higher in DEGREES, f"SH degree 0 to 3, got shN of shape {shape}")
    return count, num_higher


def _doubles(values: NDArray[Any]) -> Floats:
    if values.dtype == np.uint16:  # bfloat16: the upper half of a float32
        values = (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(np.float64)


def _fields(path: Path, content: Any) -> dict[str, _Tensor]:
    found: dict[str, Any] = content if isinstance(content, dict) else {}
    keys = ", ".join(f"{key[:40]!a}" for key in list(found)[:6]) or "none"
    if isinstance(found.get("splats"), dict):
        values = [found["splats"].get(name) for name in _FIELDS]
    else:
        is_known = isinstance(found.get("pipeline"), dict)
        check(path, is_known, f"'splats' (gsplat) or 'pipeline' (nerfstudio), got {keys}")
        values = [found["pipeline"].get(_NERFSTUDIO_PREFIX + name) for name in _NERFSTUDIO]
    for field, tensor in zip(_FIELDS, values, strict=True):
        kind = f"{tensor.name!a}" if isinstance(tensor, _Named) else type(tensor).__name__
        is_tensor = isinstance(tensor, _Tensor) and tensor.shape
        check(path, is_tensor, f"a tensor of floats {field} in the checkpoint, got {kind}")
    return dict(zip(_FIELDS, values, strict=True))


def _array(path: Path, name: str, tensor: _Tensor, archive: Archive, root: str) -> NDArray[Any]:
    """The numbers of a tensor, which must all be in the file: none stands for many."""
    steps = zip(tensor.shape, tensor.strides, strict=True)
    last = tensor.offset + sum((size - 1) * step for size, step in steps)
    count, stored_count = math.prod(tensor.shape), tensor.num_stored
    is_inside = count <= stored_count and (not count or last < stored_count)
    check(path, is_inside, f"{name} within the {stored_count} numbers of its storage, got {tensor[3:]}")
    dtype = np.dtype(_TYPES[tensor.kind])
    content = archive.read(f"{root}data/{tensor.key}")
    size = stored_count * dtype.itemsize
    check(path, len(content) == size, f"{size} bytes of {name}, got {len(content)}")
    stored = np.frombuffer(content, dtype)[tensor.offset :]
    strides = [step * dtype.itemsize for step in tensor.strides]
    return np.lib.stride_tricks.as_strided(stored, tensor.shape, strides, writeable=False)


def _followed(pickle: bytes) -> Any:
    """What a pickle of torch.save builds: values of lists are dropped, of dicts all but those with a name.

    Every step is one of a few on a stack, so time and memory are in proportion to the pickle.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def above_mark() -> list[Any]:
        start = marks.pop()
        values = stack[start:]
        del stack[start:]
        return values

    argument: Any
    for opcode, argument, _ in pickletools.genops(pickle):
        match opcode.name:
            case "PROTO" | "BINPERSID":
                pass  # the tuple that names a storage stands for it
            case "STOP":
                break
            case "MARK":
                marks.append(len(stack))
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST" | "EMPTY_TUPLE":
                stack.append(())
            case name if name in _VALUES:
                stack.append(argument)
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "TUPLE":
                stack.append(tuple(above_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                size = int(opcode.name[-1])
                stack[-size:] = [tuple(stack[-size:])]
            case "SETITEM" | "SETITEMS":
                items = above_mark() if opcode.name == "SETITEMS" else [stack.pop(-2), stack.pop()]
                pairs = zip(items[::2], items[1::2], strict=True)
                stack[-1].update((key, value) for key, value in pairs if isinstance(key, str))
            case "APPEND" | "BUILD":
                stack.pop()
            case "APPENDS":
                above_mark()
            case "GLOBAL":
                module, _, name = argument.partition(" ")
                stack.append(_Named(f"{module[:60]}.{name[:60]}"))
                if module not in _KNOWN:
                    raise ValueError(f"one that needs more: {stack[-1].name}")
            case "REDUCE" | "NEWOBJ":
                arguments = stack.pop()
                stack[-1] = _called(stack[-1].name, arguments)
            case _:
                raise ValueError(f"one that needs more: the operation {opcode.name}")
    return stack.pop()


def _called(name: str, arguments: tuple[Any, ...]) -> Any:
    if name.startswith("collections."):
        return {}
    if name == "torch._utils._rebuild_parameter":
        return arguments[0]
    if name != "torch._utils._rebuild_tensor_v2":
        return _Named(name)
    (_, kind, key, _, num_stored), offset, shape, strides = arguments[:4]
    kind = kind.name.removeprefix("torch.")
    # No more of them than may be: many calls can share what is long.
    numbers = (num_stored, offset, *shape[:_MAX_DIMENSIONS], *strides[:_MAX_DIMENSIONS])
    is_plain = all(type(number) is int and 0 <= number < 1 << 48 for number in numbers)
    if not is_plain or not isinstance(key, str) or not len(shape) == len(strides) <= _MAX_DIMENSIONS:
        raise ValueError("a tensor of another shape")
    return _Tensor(kind, key, num_stored, offset, shape, strides) if kind in _TYPES else _Named(kind)
