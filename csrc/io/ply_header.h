#pragma once

// The header of a .ply file: its encoding, and its elements with their properties.

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "io/file.h"

namespace v3dg {

// The error for invalid content of a file. The text is one line of printable ASCII that
// states what was expected and what was found. It does not contain the file name.
struct PlyError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

enum class PlyEncoding { ascii, binary_little_endian, binary_big_endian };

// The scalar types of the format, integers first. The last types do not belong to the
// format, but some programs write them.
enum class PlyType {
    int8,
    uint8,
    int16,
    uint16,
    int32,
    uint32,
    float32,
    float64,
    float16,
    int64,
    uint64
};

inline size_t size_of(PlyType type) {
    constexpr size_t kSizes[] = {1, 1, 2, 2, 4, 4, 4, 8, 2, 8, 8};
    return kSizes[static_cast<size_t>(type)];
}

struct PlyProperty {
    std::string name;
    // Type of the number or, for a list, of its elements.
    PlyType type = PlyType::float32;
    bool is_list = false;
    // Integer type of the length of a list.
    PlyType count_type = PlyType::uint8;
};

struct PlyElement {
    std::string name;
    uint64_t count = 0;
    std::vector<PlyProperty> properties;

    bool has_lists() const;
    // Returns the number of bytes of a binary row in which all lists are empty.
    size_t min_row_bytes() const;
};

struct PlyHeader {
    PlyEncoding encoding = PlyEncoding::ascii;
    std::vector<PlyElement> elements;
    std::vector<std::string> comments;  // without the keyword and surrounding spaces
    size_t size = 0;                    // in bytes, including the line end_header
};

// Opens a file. Throws std::system_error if it cannot be opened, and PlyError if it is
// not a regular file.
File open_ply_file(const char* path);

// Reads and checks the header, but does not compare it with the size of the file.
// Throws PlyError.
PlyHeader read_ply_header(const File& file);

// Returns `text` in quotation marks, shortened and printable, for an error text.
std::string in_quotes(const std::string& text);

}  // namespace v3dg
