#pragma once

// The header of a bundle's file (docs/format.md). The file may be malicious.

#include <cstdint>
#include <map>
#include <string>
#include <string_view>

#include "residency/page_source.h"

namespace v3dg {

// Bytes of a file, counted from the end of the header.
struct FilePart {
    uint64_t first, end;
};

struct BundleHeader {
    int version = 0;
    int sh_degree = 0;
    PageCodec codec = PageCodec::float32;
    std::string up;  // the axis that points up, as the bundle's config declares it, or
                     // empty
    size_t num_clusters = 0, num_groups = 0, num_pages = 0;
    uint64_t data_start = 0;                // first byte after the header
    std::map<std::string, FilePart> parts;  // tensors by their names

    uint64_t pages_bytes() const { return parts.at("pages").end; }
    // Pages begin at multiples of this number of bytes.
    uint64_t alignment() const;
    // Return the number of bytes of a page for each gaussian and for each cluster.
    uint64_t gaussian_bytes() const;
    uint64_t cluster_bytes() const;
    // Returns the number of bytes of a page, including padding.
    uint64_t page_bytes(uint64_t num_gaussians, uint64_t num_clusters) const;
};

constexpr uint64_t kMostHeaderBytes = uint64_t(1) << 20;

// For smaller files, all sizes that follow from the counts fit into 64 bits.
constexpr uint64_t kMostFileBytes = uint64_t(1) << 48;

// Parses the JSON of a header. `path` is the name of the file in messages, and
// `num_bytes` its size, which must be below kMostFileBytes. Throws Fault unless the
// header agrees with its own counts and with the size of the file. Therefore all parts
// lie inside the file, one after another.
BundleHeader read_bundle_header(const std::string& path, std::string_view text, uint64_t data_start,
                                uint64_t num_bytes);

}  // namespace v3dg
