// Opens .ply files, and chooses how to read their rows. ply_fields.h defines the
// meaning of a row, ply_rows.h reads binary rows, and ply_text.h reads lines of text.

#include "io/ply.h"

#include <algorithm>
#include <cassert>
#include <string>
#include <utility>

#include "io/ply_fields.h"
#include "io/ply_rows.h"
#include "io/ply_text.h"

namespace v3dg {

namespace {

// Throws PlyError if the file is too short for all rows of the element.
void check_size(const PlyFile& ply, const PlyElement& element, size_t offset) {
    const bool is_text = ply.encoding == PlyEncoding::ascii;
    // A number and its separator have at least two characters. The separator may be
    // missing after the last number of the file.
    const size_t row_bytes = is_text ? 2 * element.properties.size() : element.min_row_bytes();
    // `offset` can exceed file_bytes if the file has grown since it was opened.
    const size_t left = ply.file_bytes - std::min(offset, ply.file_bytes);
    if (row_bytes != 0 && element.count > (left + (is_text ? 1 : 0)) / row_bytes)
        throw PlyError("expected " + std::to_string(element.count) + " rows of element " +
                       in_quotes(element.name) + " with " +
                       (is_text || element.has_lists() ? "at least " : "") +
                       std::to_string(row_bytes) + " bytes each, got " + std::to_string(left) +
                       " bytes; the file is truncated");
}

// Returns the offset of the end of the element that begins at `offset`.
size_t skip_element(const PlyFile& ply, const PlyElement& element, size_t offset) {
    check_size(ply, element, offset);
    if (element.properties.empty()) return offset;
    if (ply.encoding == PlyEncoding::ascii) return skip_text(ply, element, offset);
    if (!element.has_lists()) return offset + element.count * element.min_row_bytes();
    return skip_rows_with_lists(ply, element, offset);
}

}  // namespace

PlyFile open_ply(const char* path) {
    File file = open_ply_file(path);
    const size_t size = file.size();
    const PlyHeader header = read_ply_header(file);
    PlyFile ply = {.file = std::move(file),
                   .file_bytes = size,
                   .encoding = header.encoding,
                   .vertex = {},
                   .vertex_offset = header.size,
                   .layout = {}};
    const auto is_vertex = [](const PlyElement& element) { return element.name == "vertex"; };
    const auto num_found = std::count_if(header.elements.begin(), header.elements.end(), is_vertex);
    if (num_found != 1)
        throw PlyError("expected one element 'vertex', got " + std::to_string(num_found));
    const auto vertex = std::find_if(header.elements.begin(), header.elements.end(), is_vertex);
    ply.vertex = *vertex;
    ply.layout = layout_of(ply.vertex);
    for (auto element = header.elements.begin(); element != vertex; ++element)
        ply.vertex_offset = skip_element(ply, *element, ply.vertex_offset);
    check_size(ply, ply.vertex, ply.vertex_offset);
    return ply;
}

PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known,
                  const PlyGaussians<float>& out) {
    assert(first + out.opacities.size <= ply.num_gaussians());
    if (out.opacities.size == 0) return known;
    const PlyPlace nearest = known.row <= first ? known : ply.begin();
    PlyElement skipped = ply.vertex;
    skipped.count = first - nearest.row;
    const PlyPlace begin = {first, skip_element(ply, skipped, nearest.offset)};
    if (ply.encoding == PlyEncoding::ascii) return read_text(ply, begin, out);
    return ply.vertex.has_lists() ? read_rows_with_lists(ply, begin, out)
                                  : read_fixed_rows(ply, begin, out);
}

}  // namespace v3dg
