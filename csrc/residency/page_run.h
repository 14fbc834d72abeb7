#pragma once

// Adjacent pages of a bundle's file, which are read together.

#include <cstdint>

#include "base/span.h"
#include "io/file.h"
#include "residency/page_source.h"

namespace v3dg {

struct PageRun {
    size_t first_page;  // index of the first page in the bundle
    // [n + 1] first cluster of each page, relative to the first page, then the end
    Span<const int64_t> first_cluster;
    // First gaussian of each cluster, then the end, as indices in the bundle.
    Span<const int64_t> offset;
    // [n + 1] offset of each page in the file, in bytes, then the end
    Span<const int64_t> places;
    Span<const uint8_t> hashes;  // [n][16]

    size_t size() const { return places.size - 1; }
    size_t num_bytes(size_t page) const { return places[page + 1] - places[page]; }
    // Returns the first gaussian of each cluster of a page, then the end, as indices in
    // the bundle.
    Span<const int64_t> clusters(size_t page) const {
        return {offset.data + first_cluster[page],
                static_cast<size_t>(first_cluster[page + 1] - first_cluster[page] + 1)};
    }
};

// Reads and verifies all pages, and decodes their gaussians. Precondition: each page
// has at least the bytes that its codec needs. If a page cannot be read, throws
// PageError; the message names the page, but not the file.
void read_pages(const File& file, const PageRun& run, PageCodec codec,
                const GaussianRows<float>& out);

// Encodes and writes all pages, and computes their hashes, [n][16]. `rows` has the
// gaussians of the run. Precondition: each page has at least the bytes that its codec
// needs; any further bytes are written as zeros. Throws std::system_error, and
// std::invalid_argument if a codec cannot represent a value.
void write_pages(const File& file, const PageRun& run, PageCodec codec,
                 const GaussianRows<const float>& rows, uint8_t* hashes);

// Reads and verifies all pages, without decoding them. Throws like read_pages().
void read_codes(const File& file, const PageRun& run, Span<int32_t> words);

}  // namespace v3dg
