"""The JSON document of a glTF file, `.glb` or `.gltf`, and the buffers that it refers
to.

Source: glTF 2.0, sections 3.2 (URIs), 3.6.1 (buffers and views) and 4 (GLB).
"""

import base64
import contextlib
import os
import re
import struct
from pathlib import Path
from urllib.parse import unquote

from v3dg._json import Json, Node, is_one_line, json_text, parse_json
from v3dg.formats._reading import Claims, check, integer_of, value_errors

MAGIC = 0x46546C67  # "glTF"
JSON_CHUNK = 0x4E4F534A  # "JSON"
BINARY_CHUNK = 0x004E4942  # "BIN\0"

# Parsed JSON needs many times the memory of its text, except for long strings.
_MOST_JSON = 1 << 20  # bytes, not counting data: URIs
_DATA_URI = re.compile(rb'"data:[^"\\]*"')
_MOST_NAME = 255  # bytes of a file name
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
# Extensions that compress the bytes of buffer views.
_PACKED_VIEWS = ("EXT_meshopt_compression", "KHR_meshopt_compression")


class Document:
    """The JSON of a glTF file and its buffers. Objects and buffers are only looked up
    and read when they are needed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.claims = Claims()
        self._binary: memoryview | None = None
        self._buffers: dict[int, memoryview] = {}
        # Contents of files, by device and inode, because several buffers may refer to
        # one file by different names.
        self._files: dict[tuple[int, int], memoryview] = {}
        content = self.claims.read(path)
        is_binary = content[:4] == b"glTF" or path.suffix.lower() != ".gltf"
        # A file that was downloaded from a URL may have no suffix.
        if not is_binary or content[:1] == b"{":
            text = content
            expected = "a .gltf file, glTF 2.0 as JSON in UTF-8"
        else:
            text = self._text_of_binary(content)
            expected = "a complete .glb file of glTF 2.0"
        num_data = sum(match.end() - match.start() for match in _DATA_URI.finditer(text))
        structure = len(text) - num_data
        check(
            path,
            structure <= _MOST_JSON,
            f"at most {_MOST_JSON} bytes of JSON, got {structure}; the file has too many objects",
        )
        with value_errors(path, expected):
            self.root = Node(parse_json(text.decode("utf-8")), str(path), "")
        self._check_version()
        self._arrays: dict[str, list[Json]] = {}

    def _text_of_binary(self, content: bytes) -> bytes:
        """Return the JSON of a `.glb`.

        Keep its binary chunk, which follows the JSON.
        """
        expected = "a complete .glb file of glTF 2.0"
        check(self.path, len(content) >= 20, f"{expected}, got {len(content)} bytes")
        magic, version, total, size, kind = struct.unpack_from("<IIIII", content)
        is_whole = (magic, version, total, kind) == (MAGIC, 2, len(content), JSON_CHUNK)
        start = content[:20].hex(" ")
        fits = is_whole and size <= total - 20
        check(self.path, fits, f"{expected}, got {start} at the start of {len(content)} bytes")
        tail = memoryview(content)[20 + size :]
        if len(tail) >= 8:
            size_of_second, kind_of_second = struct.unpack_from("<II", tail)
            check(
                self.path,
                size_of_second <= len(tail) - 8,
                f"{expected}, got a chunk of {size_of_second} bytes where only {len(tail) - 8} "
                "follow",
            )
            if kind_of_second == BINARY_CHUNK:
                self._binary = tail[8 : 8 + size_of_second]
        return content[20 : 20 + size]

    def _check_version(self) -> None:
        """Raise ValueError if the document requires a version of glTF other than
        2.0."""
        if not self.root.has("asset"):
            return
        asset = self.root.field("asset")
        for name in ("minVersion", "version"):
            if asset.has(name):
                version = asset.field(name)
                if not version.text().startswith("2."):
                    raise version.error("glTF 2.0")
                if name == "minVersion" and version.value != "2.0":
                    raise version.error("glTF 2.0")

    def array(self, kind: str) -> list[Json]:
        """Return one of the root's arrays. If it is missing, return an empty list."""
        if kind not in self._arrays:
            values: Json = []
            if self.root.has(kind):
                values = self.root.field(kind).value
                if not isinstance(values, list):
                    raise self.root.field(kind).error("an array")
            self._arrays[kind] = values
        return self._arrays[kind]

    def index(self, kind: str, number: Node) -> int:
        """Return a checked index into one of the root's arrays."""
        last = len(self.array(kind)) - 1
        return integer_of(number, f"0 to {last}", 0, last)

    def item(self, kind: str, number: Node | int) -> Node:
        """Return an item of one of the root's arrays, by its index."""
        index = number
        if isinstance(index, Node):
            index = self.index(kind, index)
        return Node(self.array(kind)[index], self.root.file, f"{kind}[{index}]")

    def view(self, number: Node) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.item("bufferViews", number)
        buffer = self._buffer(view)
        first = offset_of(view, len(buffer))
        limit = len(buffer) - first
        num_bytes = integer_of(view.field("byteLength"), f"at most {limit} bytes", 0, limit)
        return buffer[first : first + num_bytes]

    def stride(self, number: Node, default: int) -> int:
        """Return the number of bytes from one element of a buffer view to the next."""
        view = self.item("bufferViews", number)
        if not view.has("byteStride"):
            return default
        return integer_of(view.field("byteStride"), "4 to 252", 4, 252)

    def buffer_files(self) -> list[Path]:
        """Return the files that buffers refer to."""
        files = []
        for index in range(len(self.array("buffers"))):
            buffer = self.item("buffers", index)
            if buffer.has("uri") and not _is_data(buffer.field("uri")):
                files.append(self._path_of(buffer.field("uri")))
        return list(dict.fromkeys(files))

    def claim_buffers(self) -> None:
        """Add the files of all buffers to the claims. Files that cannot be read are
        ignored, because they may not be needed."""
        for path in self.buffer_files():
            with contextlib.suppress(OSError, ValueError), self.claims.open(path):
                pass

    def _buffer(self, view: Node) -> memoryview:
        index = self.index("buffers", view.field("buffer"))
        if index not in self._buffers:
            self._buffers[index] = self._read_buffer(index, view)
        return self._buffers[index]

    def _read_buffer(self, index: int, view: Node) -> memoryview:
        buffer = self.item("buffers", index)
        if buffer.has("uri"):
            content = self._content_at(buffer.field("uri"))
        elif index == 0 and self._binary is not None:
            content = self._binary
        else:
            for name in _PACKED_VIEWS:
                if view.has("extensions") and view.field("extensions").has(name):
                    raise view.located_error(
                        f"expected uncompressed data, got {name}, which this reader does not "
                        "support"
                    )
            raise buffer.located_error("expected a uri, got a buffer without data")
        if buffer.has("byteLength"):
            limit = len(content)
            size = integer_of(buffer.field("byteLength"), f"at most {limit} bytes", 0, limit)
            content = content[:size]
        return content

    def _content_at(self, uri: Node) -> memoryview:
        """Return the bytes of a data: URI, or of a file next to the document."""
        if _is_data(uri):
            media_type, _, payload = uri.value.partition(",")
            if not media_type.endswith(";base64"):
                raise uri.error("data in base64")
            try:
                return memoryview(base64.b64decode(payload, validate=True))
            except ValueError:
                raise uri.error("complete data in base64") from None
        path = self._path_of(uri)
        try:
            status = os.stat(path)
        except (FileNotFoundError, NotADirectoryError):
            problem = uri.located_error(
                f"expected the file {path.name} beside the document, got none"
            )
            raise FileNotFoundError(str(problem)) from None
        key = (status.st_dev, status.st_ino)
        if key not in self._files:
            self._files[key] = memoryview(self.claims.read(path))
        return self._files[key]

    def _path_of(self, uri: Node) -> Path:
        """Return the file at a relative URI. URIs that lead out of the document's
        folder are rejected."""
        text = uri.text()
        if _SCHEME.match(text) or "?" in text or "#" in text:
            raise uri.error("a relative path without '?' and '#', or a data: URI")
        name = unquote(text)
        parts = name.split("/")
        is_below = not {"", ".."} & set(parts) and "\\" not in name
        is_short = all(len(os.fsencode(part)) <= _MOST_NAME for part in parts)
        if not is_below or not is_one_line(name) or not is_short:
            raise uri.error(
                "a path inside the folder of the document, with single '/' between names "
                f"of at most {_MOST_NAME} bytes, without '..', '\\' and line breaks, "
                "or a data: URI"
            )
        return self.path.parent / name


def _is_data(uri: Node) -> bool:
    return isinstance(uri.value, str) and uri.value.startswith("data:")


def offset_of(node: Node, limit: int) -> int:
    """Return the byteOffset of a view or an accessor. The default is 0."""
    if not node.has("byteOffset"):
        return 0
    return integer_of(node.field("byteOffset"), f"0 to {limit}", 0, limit)


def name_text(name: str) -> str:
    """Return a name from a document as text for a message."""
    if name and is_one_line(name) and len(name) <= 60:
        return name
    return json_text(name)
