#pragma once

// The header of a .ply file: its encoding, and its elements with their properties.

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "io/posix_file.h"

namespace v3dg {

// The content of a file is wrong. The message states what was expected and what was
// found, in one line of printable ASCII, without the name of the file.
struct PlyError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

enum class PlyEncoding { ascii, binary_little_endian, binary_big_endian };

// The types of the format, integers first, then those that some writers use besides.
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
    PlyType type = PlyType::float32;  // type of a number, or of the elements of a list
    bool is_list = false;
    PlyType count_type = PlyType::uint8;  // type of the length of a list; an integer type
};

struct PlyElement {
    std::string name;
    uint64_t count = 0;
    std::vector<PlyProperty> properties;

    bool has_lists() const;
    // Returns the size of a row in a binary file if its lists are empty.
    size_t min_row_bytes() const;
};

struct PlyHeader {
    PlyEncoding encoding = PlyEncoding::ascii;
    std::vector<PlyElement> elements;
    std::vector<std::string> comments;  // without the keyword, and without outer spaces
    size_t size = 0;                    // bytes, including the line end_header
};

// Throws std::system_error, or PlyError if the path is not a regular file.
PosixFile open_ply_file(const char* path);

// Reads and checks the header, but not against the size of the file. Throws PlyError.
PlyHeader read_ply_header(const PosixFile& file);

// Returns `text` in quotes, shortened and printable, for a message.
std::string quoted(const std::string& text);

}  // namespace v3dg
