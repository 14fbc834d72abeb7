"""All gaussians of a glTF file's scene, in the coordinates of the scene."""

from v3dg._json import Node
from v3dg.formats._gltf_document import Document, name_text
from v3dg.formats._gltf_nodes import Placement, placed, placements
from v3dg.formats._gltf_primitives import NAME, READ_EXTENSIONS, Primitive, is_gaussians
from v3dg.formats._reading import check
from v3dg.gaussians import Gaussians, common, empty, put

# Extensions of content that is ignored in any case: surfaces, textures and lights.
_OTHER_EXTENSIONS = (
    "EXT_lights_",
    "EXT_texture_",
    "KHR_lights_",
    "KHR_materials_",
    "KHR_texture_",
)
_MOST_NOTES = 20


class Scene:
    """The gaussians of a scene. Until `read` is called, only their numbers are known.

    Attributes:
        count: Number of gaussians in the scene. A mesh counts once for each node that
            places it.
        degree: The highest SH degree of a primitive.
        antialiased: As in `Declared`. It is None if primitives differ.
        notes: As in `Declared`.
    """

    def __init__(self, document: Document) -> None:
        self._document = document
        self.notes = _extension_notes(document)
        self._placements, notes = placements(document)
        self.notes += notes
        self._primitives: dict[int, list[Primitive]] = {}  # by the index of the mesh
        for placement in self._placements:
            if placement.mesh not in self._primitives:
                self._primitives[placement.mesh] = self._primitives_of(placement.mesh)
        primitives = [primitive for mesh in self._primitives.values() for primitive in mesh]
        check(document.path, primitives, f"a primitive with {NAME}, got none{self._elsewhere()}")
        self.count = sum(
            primitive.count
            for placement in self._placements
            for primitive in self._primitives[placement.mesh]
        )
        self.degree = max(primitive.degree for primitive in primitives)
        self.antialiased = common([primitive.antialiased for primitive in primitives])
        self.notes += [note for primitive in primitives for note in primitive.notes]
        self.notes += self._left_out()
        self.notes = list(dict.fromkeys(self.notes))
        if len(self.notes) > _MOST_NOTES:
            count = len(self.notes) - _MOST_NOTES
            self.notes[_MOST_NOTES:] = [f"{count} more notes are omitted."]
        self._check_claims()

    def read(self) -> Gaussians:
        """Return the gaussians, in the order of nodes and primitives."""
        gaussians = empty(self.count, self.degree)
        # For each mesh, its placements, and the first row of the gaussians of each
        # placement.
        uses: dict[int, list[tuple[Placement, int]]] = {}
        row = 0
        for placement in self._placements:
            uses.setdefault(placement.mesh, []).append((placement, row))
            row += sum(primitive.count for primitive in self._primitives[placement.mesh])
        for mesh, places in uses.items():
            offset = 0
            for primitive in self._primitives[mesh]:
                # Each primitive is read once, and freed before the next one is read.
                part = primitive.read()
                for placement, first in places:
                    put(placed(part, placement), gaussians, first + offset)
                offset += primitive.count
        return gaussians

    def _primitives_of(self, mesh: int) -> list[Primitive]:
        node = self._document.item("meshes", mesh)
        return [
            Primitive(self._document, item)
            for item in node.field("primitives").items()
            if is_gaussians(item)
        ]

    def _check_claims(self) -> None:
        """Raise ValueError if the file is too small for its number of gaussians, or for
        the decompressed size of its data."""
        path = self._document.path
        claims = self._document.claims
        self._document.claim_buffers()
        primitives = [primitive for mesh in self._primitives.values() for primitive in mesh]
        claims.add(path, self.count)
        claims.add(path, sum(max(0, part.num_rows - part.count) for part in primitives))
        # The limit applies to all primitives together, so that they cannot all refer to
        # one large stream.
        num_packed = sum(primitive.packed_bytes for primitive in primitives)
        limit = claims.num_bytes
        check(
            path,
            num_packed <= limit,
            f"at most {limit} bytes of .spz in a file of that size, got {num_packed}",
        )

    def _elsewhere(self) -> str:
        """Return the end of a message about a scene without gaussians."""
        unused = self._unused_meshes()
        if unused:
            return f" in the scene that is shown; {len(unused)} meshes outside of it have some"
        return "; surfaces cannot be read"

    def _left_out(self) -> list[str]:
        count = len(self._unused_meshes())
        if not count:
            return []
        return [
            (f"{count} meshes with gaussians are ignored, because no node of the scene has them.")
        ]

    def _unused_meshes(self) -> list[int]:
        """Return the meshes with gaussians that no node of the scene uses."""
        document = self._document
        return [
            mesh
            for mesh in range(len(document.array("meshes")))
            if mesh not in self._primitives and _has_gaussians(document.item("meshes", mesh))
        ]


def _has_gaussians(mesh: Node) -> bool:
    return mesh.has("primitives") and any(map(is_gaussians, mesh.field("primitives").items()))


def _extension_notes(document: Document) -> list[str]:
    """Return notes about ignored content. Raise ValueError for a required extension
    that this reader does not support."""
    for name, node in _extensions(document, "extensionsRequired"):
        if name not in READ_EXTENSIONS and not name.startswith(_OTHER_EXTENSIONS):
            text = f"expected required extensions that this reader supports, got {name_text(name)}"
            raise node.located_error(f"{text}; write the file without it")
    notes = [
        f"The extension {name_text(name)} is not read."
        for name, _ in _extensions(document, "extensionsUsed")
        if name not in READ_EXTENSIONS and not name.startswith(_OTHER_EXTENSIONS)
    ]
    if document.array("animations"):
        notes.append("Animations are not read: nodes keep their rest poses.")
    return notes


def _extensions(document: Document, kind: str) -> list[tuple[str, Node]]:
    """Return the names in a list of extensions of the root, each with its JSON node."""
    if not document.root.has(kind):
        return []
    names = document.root.field(kind)
    places = []
    for item in names.items("an array of names"):
        if not isinstance(item.value, str):
            raise item.error("the name of an extension")
        places.append((item.value, item))
    return places
