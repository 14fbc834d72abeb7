"""Reads the numbers of a glTF file from accessors of every kind: dense, sparse, and
without a buffer view.

Source: glTF 2.0, section 3.6.2.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from v3dg._json import Node
from v3dg._numbers import Floats
from v3dg.formats._gltf_document import Document, offset_of
from v3dg.formats._reading import integer_of

BYTE = 5121
FLOAT = 5126
_DTYPES = {5120: "i1", BYTE: "u1", 5122: "<i2", 5123: "<u2", FLOAT: "<f4"}
_INDEX_DTYPES = {BYTE: "u1", 5123: "<u2", 5125: "<u4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_WIDTHS = {name: width for width, name in TYPES.items()}
_MOST_ELEMENTS = 1 << 40


def count_of(accessor: Node) -> int:
    """Return the number of elements of an accessor."""
    return integer_of(accessor.field("count"), "a number of gaussians", 0, _MOST_ELEMENTS)


def has_data(accessor: Node) -> bool:
    """Return whether an accessor has data; the elements of an accessor without data are
    zero."""
    return accessor.has("bufferView") or accessor.has("sparse")


def column(
    document: Document, accessor: Node, count: int, widths: Sequence[int]
) -> Callable[[slice], Floats]:
    """Return a function that takes a slice and returns these rows of an attribute as
    doubles.

    Args:
        count: Number of rows. The caller has checked that it is plausible.
        widths: Accepted numbers of components in a row.
    """
    dtype = _dtype_of(accessor.field("componentType"), _DTYPES)
    kind = accessor.field("type")
    expected = [TYPES[width] for width in widths]
    if kind.value not in expected:
        raise kind.error(" or ".join(expected))
    integer_of(accessor.field("count"), f"{count}, as POSITION has", count, count)
    width = _WIDTHS[kind.value]
    if accessor.has("bufferView"):
        rows = _rows(document, accessor, dtype, (count, width), is_strided=True)
    else:
        rows = np.broadcast_to(np.zeros(1, dtype), (count, width))
    if accessor.has("sparse"):
        rows = _with_sparse(document, accessor.field("sparse"), rows)
    if dtype.kind == "f" or not _is_normalised(accessor):
        return lambda block: rows[block].astype(np.float64)
    divisor = float(2 ** (8 * dtype.itemsize - (dtype.kind == "i")) - 1)
    return lambda block: np.maximum(rows[block].astype(np.float64) / divisor, -1.0)


def indices(document: Document, accessor: Node, limit: int) -> NDArray[np.int64]:
    """Return the vertex indices of a primitive, each of which is below ``limit``."""
    dtype = _dtype_of(accessor.field("componentType"), _INDEX_DTYPES)
    if accessor.field("type").value != "SCALAR":
        raise accessor.field("type").error("SCALAR")
    shape = (count_of(accessor), 1)
    if accessor.has("sparse") or not accessor.has("bufferView"):
        raise accessor.problem(
            "expected indices in a buffer view, got sparse ones or none, which this reader does "
            "not support"
        )
    values = _rows(document, accessor, dtype, shape, is_strided=True)[:, 0].astype(np.int64)
    if len(values) and values.max() >= limit:
        raise accessor.problem(f"expected indices below {limit}, got {values.max()}")
    return values


def _with_sparse(
    document: Document, sparse: Node, rows: NDArray[np.generic]
) -> NDArray[np.generic]:
    """Return a copy of the rows in which those listed by a sparse accessor are
    replaced."""
    num_rows = len(rows)
    count = integer_of(sparse.field("count"), f"1 to {num_rows}", 1, num_rows)
    places = sparse.field("indices")
    kind = _dtype_of(places.field("componentType"), _INDEX_DTYPES)
    numbers = _rows(document, places, kind, (count, 1), is_strided=False)[:, 0].astype(np.int64)
    is_ascending = bool((np.diff(numbers) > 0).all()) and numbers[-1] < num_rows
    if not is_ascending:
        problem = f"expected ascending indices below {num_rows}, got others; correct the file"
        raise places.problem(problem)
    values = _rows(
        document, sparse.field("values"), rows.dtype, (count, rows.shape[1]), is_strided=False
    )
    replaced = np.array(rows)
    replaced[numbers] = values
    return replaced


def _rows(
    document: Document,
    holder: Node,
    dtype: np.dtype[np.generic],
    shape: tuple[int, int],
    *,
    is_strided: bool,
) -> NDArray[np.generic]:
    """Return rows from the buffer view of an accessor, or of one part of a sparse
    accessor."""
    count, width = shape
    number = holder.field("bufferView")
    content = document.view(number)
    size = dtype.itemsize * width
    stride = size
    if is_strided:
        stride = document.stride(number, size)
    first = offset_of(holder, len(content))
    if count and first + (count - 1) * stride + size > len(content):
        raise holder.problem(
            f"expected {count} elements in its buffer view, got one of {len(content)} bytes"
        )
    strided: NDArray[np.generic] = np.ndarray(
        shape, dtype, content, first, (stride, dtype.itemsize)
    )
    return strided


def _dtype_of(kind: Node, dtypes: dict[int, str]) -> np.dtype[np.generic]:
    if not isinstance(kind.value, int) or kind.value not in dtypes:
        raise kind.error(f"one of {', '.join(map(str, dtypes))}")
    return np.dtype(dtypes[kind.value])


def _is_normalised(accessor: Node) -> bool:
    if not accessor.has("normalized"):
        return False
    value = accessor.field("normalized").value
    if not isinstance(value, bool):
        raise accessor.field("normalized").error("true or false")
    return value
