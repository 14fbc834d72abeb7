#pragma once

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "io/posix_file.h"

namespace v3dg {

// The content of a file is not what it should be. The message says what was expected and found, in
// one line of printable ASCII, without the file's name.
struct PlyError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

enum class PlyEncoding { ascii, binary_little_endian, binary_big_endian };

enum class PlyType { int8, uint8, int16, uint16, int32, uint32, float32, float64 };

inline size_t size_of(PlyType type) {
    constexpr size_t kSizes[] = {1, 1, 2, 2, 4, 4, 4, 8};
    return kSizes[static_cast<size_t>(type)];
}

struct PlyProperty {
    std::string name;
    PlyType type = PlyType::float32;  // of a list: of its items
    bool is_list = false;
    PlyType count_type = PlyType::uint8;  // only of a list; an integer type
};

struct PlyElement {
    std::string name;
    uint64_t count = 0;
    std::vector<PlyProperty> properties;

    bool has_lists() const;
    // Bytes of one row in a binary file; lists count as empty.
    size_t min_row_bytes() const;
};

struct PlyHeader {
    PlyEncoding encoding = PlyEncoding::ascii;
    std::vector<PlyElement> elements;
    size_t size = 0;  // bytes, up to and with the line end of end_header
};

// Throws std::system_error, or PlyError for what is no regular file.
PosixFile open_ply_file(const char* path);

// Reads and checks the header; nothing in it is believed about the size of what follows.
PlyHeader read_ply_header(const PosixFile& file);

// `text` in quotes, cut and made printable for a message.
std::string quoted(const std::string& text);

}  // namespace v3dg
