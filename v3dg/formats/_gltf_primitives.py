"""Reads the gaussians of a glTF primitive, from attributes or from an embedded `.spz`,
and the properties that the primitive declares.

Source: KHR_gaussian_splatting, Ellipse Kernel (attributes) and Extending Mesh
Primitives (properties); earlier drafts for other names. docs/formats.md describes how
each property is read.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from v3dg._json import Node
from v3dg._numbers import Floats
from v3dg.formats import _axes, spz
from v3dg.formats._color_space import conversion_note, srgb_from_linear
from v3dg.formats._gltf_accessors import column, count_of, has_data, indices
from v3dg.formats._gltf_document import Document, name_text
from v3dg.formats._packing import SH_C0, assemble
from v3dg.formats._reading import check, integer_of
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

NAME = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
# An extension of a draft. It belongs to the primitive itself, whereas the others are
# nested in NAME.
_SPZ_ALONE = "KHR_spz_gaussian_splats_compression"
_SPZ_WITHIN = (SPZ, "KHR_gaussian_splatting_compression_spz")
READ_EXTENSIONS = frozenset({NAME, *_SPZ_WITHIN, _SPZ_ALONE, "KHR_mesh_quantization"})
# Drafts use a short prefix. For example, they call the attribute
# `KHR_gaussian_splatting:SCALE` just `_SCALE`.
_PREFIXES = (f"{NAME}:", "_")

_LINEAR = "lin_rec709_display"
# The supported values of each property, with the default first.
_PROPERTIES = {
    "kernel": ("ellipse",),
    "colorSpace": ("srgb_rec709_display", _LINEAR),
    "projection": ("perspective",),
    "sortingMethod": ("cameraDistance",),
}
_POINTS = 0
_TRIANGLES = 4  # the default mode of a primitive


def is_gaussians(primitive: Node) -> bool:
    """Return whether a primitive of a mesh has gaussians."""
    if not primitive.has("extensions"):
        return False
    extensions = primitive.field("extensions")
    return extensions.has(NAME) or extensions.has(_SPZ_ALONE)


def coefficients(degree: int) -> list[str]:
    """Return the names of the attributes of spherical harmonics, in order, without a
    prefix."""
    return [f"SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


@dataclass(frozen=True)
class _Packed:
    """The `.spz` of a primitive, and its header."""

    content: memoryview
    header: spz.Header


class Primitive:
    """A primitive of gaussians. Until `read` is called, only its size is known.

    Attributes:
        count: Number of gaussians. It is the number of indices or, without indices, the
            number of vertices.
        num_rows: Number of vertices.
        degree: Degree of their spherical harmonics.
        antialiased: As in `Declared`.
        notes: As in `Declared`.
    """

    def __init__(self, document: Document, node: Node) -> None:
        self._document = document
        self._node = node
        self._extension = Node({}, node.file, node.path)
        if node.field("extensions").has(NAME):
            self._extension = node.field("extensions").field(NAME)
        self._packed = self._find_packed()
        self._attributes = Node({}, node.file, f"{node.path}.attributes")
        if self._packed is None or node.has("attributes"):
            self._attributes = node.field("attributes")
        self.antialiased = self._antialiased()
        self.notes = self._notes()
        self.num_rows, self.degree = self._size()
        self.count = self.num_rows
        if node.has("indices"):
            self.count = count_of(document.item("accessors", node.field("indices")))

    def read(self) -> Gaussians:
        """Return the gaussians, in the coordinates of the mesh."""
        if self._packed is None:
            gaussians = self._read_attributes()
        else:
            content = bytes(self._packed.content)
            document = self._document
            axes = _axes.GLTF
            if self._is_released:
                axes = _axes.OPENGL
            gaussians = spz.decode(document.path, content, document.claims, axes, _axes.GLTF)
        if self._node.has("indices"):
            accessor = self._document.item("accessors", self._node.field("indices"))
            gaussians = gaussians.subset(indices(self._document, accessor, len(gaussians)))
        if self._color_space == _LINEAR:
            gaussians = srgb_from_linear(gaussians)
        return gaussians

    @property
    def packed_bytes(self) -> int:
        """Size of the embedded `.spz` in bytes, or 0 if there is none."""
        if self._packed is None:
            return 0
        return len(self._packed.content)

    @property
    def _is_released(self) -> bool:
        """Whether the primitive has the properties that the release requires. Drafts
        lack them.

        In a draft, the `.spz` has the axes of glTF: Cesium ion writes it so, and
        CesiumJS reads it so. In the release, "you must specify a Left-Up-Front (LUF)
        coordinate system" to the library of `.spz`, which converts gaussians from these
        axes to its own: KHR_gaussian_splatting_compression_spz_2, Conformance.
        """
        return any(self._extension.has(name) for name in ("kernel", "colorSpace"))

    @property
    def _color_space(self) -> object:
        if not self._extension.has("colorSpace"):
            return None
        return self._extension.field("colorSpace").value

    def _find_packed(self) -> _Packed | None:
        extensions = self._node.field("extensions")
        holders = []
        if self._extension.has("extensions"):
            inner = self._extension.field("extensions")
            holders = [inner.field(name) for name in _SPZ_WITHIN if inner.has(name)]
        if extensions.has(_SPZ_ALONE):
            holders.append(extensions.field(_SPZ_ALONE))
        if not holders:
            return None
        content = self._document.view(holders[0].field("bufferView"))
        start = content[: spz.MAX_START]
        header = spz.header_of(self._document.path, start, self._document.claims)
        return _Packed(content, header)

    def _size(self) -> tuple[int, int]:
        """Return the number of vertices, and the SH degree."""
        position = None
        if self._packed is None or self._attributes.has("POSITION"):
            position = self._document.item("accessors", self._attributes.field("POSITION"))
        if self._packed is None:
            assert position is not None
            self._check_plain()
            return count_of(position), self._degree()
        header = self._packed.header
        if position is not None and count_of(position) != header.num_gaussians:
            expected = f"{header.num_gaussians}, as the .spz has"
            raise position.field("count").error(expected)
        return header.num_gaussians, header.sh_degree

    def _check_plain(self) -> None:
        """Raise ValueError if the data of an attribute is in an extension that this
        reader does not support."""
        holders = [holder for holder in (self._node, self._extension) if holder.has("extensions")]
        names = [name for holder in holders for name in _unread(holder.field("extensions"))]
        if not names:
            return
        for number in self._attributes.some_fields(()).values():
            if not has_data(self._document.item("accessors", number)):
                name = name_text(names[0])
                raise number.located_error(
                    f"expected data in a buffer, got data in {name}, which this reader does not "
                    "support"
                )

    def _degree(self) -> int:
        """Return the SH degree, which follows from the names of attributes."""
        for degree in (3, 2, 1):
            if self._find(f"SH_DEGREE_{degree}_COEF_0") is not None:
                return degree
        return 0

    def _find(self, name: str) -> Node | None:
        """Return the index of the accessor of an attribute. Its name is the released
        one or that of a draft. Return None if it is missing."""
        for prefix in _PREFIXES:
            if self._attributes.has(prefix + name):
                return self._attributes.field(prefix + name)
        return None

    def _column(self, name: str, width: int) -> Callable[[slice], Floats]:
        number = self._find(name)
        if number is None:
            number = self._attributes.field(_PREFIXES[0] + name)  # this raises an error
        accessor = self._document.item("accessors", number)
        return column(self._document, accessor, self.num_rows, [width])

    def _read_attributes(self) -> Gaussians:
        document = self._document
        position = document.item("accessors", self._attributes.field("POSITION"))
        mean = column(document, position, self.num_rows, [3])
        scale = self._column("SCALE", 3)
        quat = self._column("ROTATION", 4)
        color, opacity = self._color_and_opacity()
        higher = [self._column(name, 3) for name in coefficients(self.degree)[1:]]

        def decode(rows: slice) -> tuple[Floats, ...]:
            widths = scale(rows)
            advice = (
                "drafts of the extension stored logarithms; write the file with a newer program"
            )
            check(
                document.path,
                not (widths < 0).any(),
                f"scales of at least 0, got negative ones; {advice}",
            )
            bands = [color(rows), *(coefficient(rows) for coefficient in higher)]
            return (
                mean(rows),
                normalised(np.roll(quat(rows), 1, axis=1)),
                widths,
                opacity(rows),
                np.stack(bands, axis=1),
            )

        return assemble(self.num_rows, self.degree, decode)

    def _color_and_opacity(self) -> tuple[Callable[[slice], Floats], Callable[[slice], Floats]]:
        """Return functions for the SH coefficient of degree 0, (N, 3), and for the
        opacity, (N,).

        Drafts store both in COLOR_0. Its colour is 0.5 plus the coefficient times
        SH_C0.
        """
        name = "SH_DEGREE_0_COEF_0"
        has_color = self._find(name) is not None
        has_opacity = self._find("OPACITY") is not None
        rgba: Callable[[slice], Floats] | None = None
        if not (has_color and has_opacity) and self._attributes.has("COLOR_0"):
            accessor = self._document.item("accessors", self._attributes.field("COLOR_0"))
            widths = [4]
            if has_opacity:
                widths = [3, 4]
            rgba = column(self._document, accessor, self.num_rows, widths)
        if rgba is not None and not has_color:
            drafted = rgba
            color: Callable[[slice], Floats] = lambda rows: (drafted(rows)[:, :3] - 0.5) / SH_C0  # noqa: E731
        else:
            color = self._column(name, 3)
        if rgba is not None and not has_opacity:
            drafted_alpha = rgba
            return color, lambda rows: drafted_alpha(rows)[:, 3]
        scalar = self._column("OPACITY", 1)
        return color, lambda rows: scalar(rows)[:, 0]

    def _antialiased(self) -> bool | None:
        """Return what the `.spz`, or the extras that `v3dg.write_asset` writes, declare
        about antialiasing."""
        if self._packed is not None:
            return self._packed.header.antialiased
        if self._extension.has("extras"):
            extras = self._extension.field("extras")
            if extras.has("antialiased") and isinstance(extras.value["antialiased"], bool):
                return bool(extras.value["antialiased"])
        return None

    def _notes(self) -> list[str]:
        """Return a sentence for each property that is ignored or converted."""
        notes = []
        for name, node in self._extension.some_fields(()).items():
            values = _PROPERTIES.get(name)
            if values is not None and node.value not in values:
                if not isinstance(node.value, str):
                    raise node.error("a string")
                value = name_text(node.value)
                notes.append(f"{NAME} has {name} {value}, which is read as {values[0]}.")
            elif values is None and name not in ("extensions", "extras"):
                notes.append(f"{name_text(name)} of {NAME} is not read.")
        if self._color_space == _LINEAR:
            notes.append(conversion_note(_LINEAR))
        mode = _TRIANGLES
        if self._node.has("mode"):
            mode = integer_of(self._node.field("mode"), "0 to 6", 0, 6)
        if mode != _POINTS:
            notes.append(f"A primitive has the mode {mode}, and is read as points.")
        if self._packed is None:
            notes += self._attribute_notes()
        else:
            notes += self._packed_notes(self._packed)
        if self._node.has("targets"):
            notes.append("Morph targets are not read.")
        return notes

    def _packed_notes(self, packed: _Packed) -> list[str]:
        notes = spz.header_notes(packed.header)
        if self._is_released:
            notes.append(
                f"Its .spz was turned from the axes of .spz to those of glTF, as {SPZ} says; "
                "CesiumJS does not turn it."
            )
        return notes

    def _attribute_notes(self) -> list[str]:
        # Files with the released names may also have COLOR_0, for programs that do not
        # support gaussians.
        read = {"POSITION", "COLOR_0"}
        for prefix in _PREFIXES:
            read |= {prefix + name for name in ("SCALE", "ROTATION", "OPACITY", *coefficients(3))}
        unread = [name for name in self._attributes.some_fields(()) if name not in read]
        return [f"The attribute {name_text(name)} is not read." for name in unread]


def _unread(extensions: Node) -> list[str]:
    return [name for name in extensions.some_fields(()) if name not in READ_EXTENSIONS]
