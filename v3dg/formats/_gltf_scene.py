"""All gaussians of a glTF file's scene: which primitives they are, and where."""

from v3dg._json import Node
from v3dg.formats._gltf_document import Document, name_text
from v3dg.formats._gltf_nodes import Placement, placed, placements
from v3dg.formats._gltf_primitives import NAME, READ_EXTENSIONS, Primitive, is_gaussians
from v3dg.formats._reading import check
from v3dg.gaussians import Gaussians, common, empty, put

# Extensions of what is not read anyway: surfaces, their textures, and lights.
_OTHER_EXTENSIONS = (
    "EXT_lights_",
    "EXT_texture_",
    "KHR_lights_",
    "KHR_materials_",
    "KHR_texture_",
)
_MOST_NOTES = 20


class Scene:
    """The gaussians of a scene, of which nothing but their numbers is read at first.

    Attributes:
        count: Number of gaussians, each as often as nodes place it.
        degree: The highest SH degree of a primitive.
        antialiased: As in `Declared`, if it is the same for all.
        notes: As in `Declared`.
    """

    def __init__(self, document: Document) -> None:
        self._document = document
        self.notes = _extension_notes(document)
        self._placements, notes = placements(document)
        self.notes += notes
        self._primitives: dict[int, list[Primitive]] = {}  # by mesh
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
            self.notes[_MOST_NOTES:] = [f"There are {count} more of such notes."]
        self._check_claims()

    def read(self) -> Gaussians:
        """The gaussians, in the order of nodes and primitives."""
        gaussians = empty(self.count, self.degree)
        uses: dict[int, list[tuple[Placement, int]]] = {}  # of a mesh, with its first row
        row = 0
        for placement in self._placements:
            uses.setdefault(placement.mesh, []).append((placement, row))
            row += sum(primitive.count for primitive in self._primitives[placement.mesh])
        for mesh, places in uses.items():
            offset = 0
            for primitive in self._primitives[mesh]:
                part = primitive.read()  # once, and one after another
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
        """Raise ValueError unless the file may have so many gaussians, and expand so
        much."""
        path = self._document.path
        claims = self._document.claims
        self._document.claim_buffers()
        primitives = [primitive for mesh in self._primitives.values() for primitive in mesh]
        claims.add(path, self.count)
        claims.add(path, sum(max(0, part.num_rows - part.count) for part in primitives))
        # Limited, so that many primitives cannot share one large stream.
        num_packed = sum(primitive.packed_bytes for primitive in primitives)
        limit = claims.num_bytes
        check(path, num_packed <= limit, f"{limit} bytes of .spz, got {num_packed}")

    def _elsewhere(self) -> str:
        """The end of a message about a scene without gaussians."""
        unused = self._unused_meshes()
        if unused:
            return f" in the scene that is shown; {len(unused)} meshes outside of it have some"
        return "; meshes are not read"

    def _left_out(self) -> list[str]:
        count = len(self._unused_meshes())
        if not count:
            return []
        return [f"{count} meshes with gaussians that no node of the scene has are left out."]

    def _unused_meshes(self) -> list[int]:
        """Meshes with gaussians that the scene does not have."""
        document = self._document
        return [
            mesh
            for mesh in range(len(document.array("meshes")))
            if mesh not in self._primitives and _has_gaussians(document.item("meshes", mesh))
        ]


def _has_gaussians(mesh: Node) -> bool:
    return mesh.has("primitives") and any(map(is_gaussians, mesh.field("primitives").items()))


def _extension_notes(document: Document) -> list[str]:
    """Sentences about what is not read; ValueError names an extension that is required
    and not read."""
    for name, node in _extensions(document, "extensionsRequired"):
        if name not in READ_EXTENSIONS and not name.startswith(_OTHER_EXTENSIONS):
            text = f"expected extensions that are read, got {name_text(name)}"
            raise node.problem(f"{text}; write the file without it")
    notes = [
        f"The extension {name_text(name)} is not read."
        for name, _ in _extensions(document, "extensionsUsed")
        if name not in READ_EXTENSIONS and not name.startswith(_OTHER_EXTENSIONS)
    ]
    if document.array("animations"):
        notes.append("Animations are not read: nodes are where they are at rest.")
    return notes


def _extensions(document: Document, kind: str) -> list[tuple[str, Node]]:
    """Names of extensions, with their places."""
    if not document.root.has(kind):
        return []
    names = document.root.field(kind)
    places = []
    for item in names.items("an array of names"):
        if not isinstance(item.value, str):
            raise item.error("the name of an extension")
        places.append((item.value, item))
    return places
