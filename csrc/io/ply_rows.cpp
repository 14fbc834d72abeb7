// Reads binary rows. RowDecoder converts rows of fixed size. ByteReader reads rows with
// lists, which are then packed to rows of fixed size.

#include "io/ply_rows.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "base/parallel_for.h"
#include "io/ply_fields.h"

namespace v3dg {

namespace {

// Number of bytes that a thread reads and converts at once. They fit into the cache of
// a core.
constexpr size_t kBlockBytes = size_t(1) << 18;
// Number of rows that a thread converts at once, if a single thread reads the file.
constexpr size_t kRowsPerTask = 256;

template <class T>
T load_as(const char* bytes, bool is_swapped) {
    char copy[sizeof(T)];
    for (size_t i = 0; i < sizeof(T); ++i) copy[i] = bytes[is_swapped ? sizeof(T) - 1 - i : i];
    T value;
    std::memcpy(&value, copy, sizeof(T));
    return value;
}

// Converts an IEEE 754 half float.
double from_half(uint16_t bits) {
    const int exponent = bits >> 10 & 31;
    const int fraction = bits & 1023;
    const double sign = bits >> 15 ? -1 : 1;
    if (exponent == 31 && fraction != 0) return std::numeric_limits<double>::quiet_NaN();
    if (exponent == 31) return sign * std::numeric_limits<double>::infinity();
    if (exponent == 0) return sign * std::ldexp(fraction, -24);
    return sign * std::ldexp(1024 + fraction, exponent - 25);
}

double load_scalar(const char* bytes, PlyType type, bool is_swapped) {
    switch (type) {
        case PlyType::int8: return load_as<int8_t>(bytes, is_swapped);
        case PlyType::uint8: return load_as<uint8_t>(bytes, is_swapped);
        case PlyType::int16: return load_as<int16_t>(bytes, is_swapped);
        case PlyType::uint16: return load_as<uint16_t>(bytes, is_swapped);
        case PlyType::int32: return load_as<int32_t>(bytes, is_swapped);
        case PlyType::uint32: return load_as<uint32_t>(bytes, is_swapped);
        case PlyType::float32: return load_as<float>(bytes, is_swapped);
        case PlyType::float64: return load_as<double>(bytes, is_swapped);
        case PlyType::float16: return from_half(load_as<uint16_t>(bytes, is_swapped));
        case PlyType::int64: return static_cast<double>(load_as<int64_t>(bytes, is_swapped));
        case PlyType::uint64: return static_cast<double>(load_as<uint64_t>(bytes, is_swapped));
    }
    return 0;
}

bool is_swapped(PlyEncoding encoding) {
    const uint16_t probe = 1;
    unsigned char first;
    std::memcpy(&first, &probe, 1);
    return (encoding == PlyEncoding::binary_big_endian) == (first == 1);
}

// Converts rows of binary numbers to gaussians. The rows have no lists, so all have the
// same size.
class RowDecoder {
  public:
    RowDecoder(const PlyFile& ply, const PlyGaussians<float>& out)
        : layout_(ply.layout), is_swapped_(is_swapped(ply.encoding)), out_(out) {
        for (const PlyProperty& property : ply.vertex.properties)
            if (!property.is_list) row_bytes_ += size_of(property.type);
        const auto is_float = [](const PlyField& field) { return field.type == PlyType::float32; };
        is_native_float_ =
            !is_swapped_ && std::all_of(layout_.fields.begin(), layout_.fields.end(), is_float);
    }
    size_t row_bytes() const { return row_bytes_; }

    // Converts `count` rows to the gaussians from `first` on.
    void decode(const char* rows, size_t count, size_t first) const {
        const PlyField* fields = layout_.fields.data();
        for (size_t r = 0; r < count; ++r) {
            const char* row = rows + r * row_bytes_;
            if (is_native_float_) {
                const auto load = [row, fields](size_t slot) {
                    float value;
                    std::memcpy(&value, row + fields[slot].offset, sizeof(value));
                    return value;
                };
                store_gaussian(load, first + r, layout_, out_);
            } else {
                const auto load = [this, row, fields](size_t slot) {
                    return load_scalar(row + fields[slot].offset, fields[slot].type, is_swapped_);
                };
                store_gaussian(load, first + r, layout_, out_);
            }
        }
    }

  private:
    const PlyLayout& layout_;
    bool is_swapped_;
    bool is_native_float_;
    size_t row_bytes_ = 0;
    PlyGaussians<float> out_;
};

// Reads a file in ascending order.
class ByteReader {
  public:
    ByteReader(const File& file, size_t offset, size_t file_bytes)
        : file_(file),
          offset_(offset),
          file_bytes_(file_bytes),
          buffer_(std::min(kBlockBytes, file_bytes - std::min(offset, file_bytes))) {}

    size_t offset() const { return offset_; }
    void skip(size_t size, const PlyElement& element, uint64_t row) {
        if (size > file_bytes_ - std::min(offset_, file_bytes_))
            throw PlyError("expected " + std::to_string(element.count) + " rows of element " +
                           in_quotes(element.name) + ", got the end of the file in row " +
                           std::to_string(row));
        offset_ += size;
    }
    // Returns the next `size` bytes, at most kBlockBytes. They are valid until the next
    // call.
    const char* take(size_t size, const PlyElement& element, uint64_t row) {
        const size_t begin = offset_;
        skip(size, element, row);
        if (begin < buffer_begin_ || begin + size > buffer_begin_ + buffer_size_) {
            buffer_begin_ = begin;
            buffer_size_ = file_.read_at(begin, buffer_.data(), buffer_.size());
            if (buffer_size_ < size)
                throw PlyError("the file became shorter while it was read; read it again");
        }
        return buffer_.data() + (begin - buffer_begin_);
    }

  private:
    const File& file_;
    size_t offset_;
    size_t file_bytes_;
    std::vector<char> buffer_;
    size_t buffer_begin_ = 0;
    size_t buffer_size_ = 0;
};

// Parses one row. If `packed` is not null, copies the numbers that are not in lists to
// it.
void walk_row(ByteReader& reader, const PlyElement& element, uint64_t row, bool is_swapped,
              char* packed) {
    for (const PlyProperty& property : element.properties) {
        if (property.is_list) {
            const size_t count_bytes = size_of(property.count_type);
            const double count = load_scalar(reader.take(count_bytes, element, row),
                                             property.count_type, is_swapped);
            if (count < 0)
                throw PlyError("expected a whole number as length of list " +
                               in_quotes(property.name) + " in row " + std::to_string(row) +
                               ", got " + std::to_string(static_cast<int64_t>(count)));
            reader.skip(static_cast<size_t>(count) * size_of(property.type), element, row);
        } else if (packed != nullptr) {
            const size_t size = size_of(property.type);
            std::memcpy(packed, reader.take(size, element, row), size);
            packed += size;
        } else {
            reader.skip(size_of(property.type), element, row);
        }
    }
}

}  // namespace

PlyPlace read_fixed_rows(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out) {
    const RowDecoder decoder(ply, out);
    const size_t row_bytes = decoder.row_bytes();
    const size_t block_rows = std::max<size_t>(1, kBlockBytes / row_bytes);
    const size_t num_rows = out.opacities.size;
    const size_t num_blocks = (num_rows + block_rows - 1) / block_rows;
    const int num_threads = static_cast<int>(std::min<size_t>(most_threads(), num_blocks));
    // new char[] does not initialise the memory, so the memory of threads that read no
    // block is never touched.
    const std::unique_ptr<char[]> buffers(new char[num_threads * block_rows * row_bytes]);
    parallel_for_on(num_threads, num_blocks, 1, [&](size_t block) {
        char* rows = buffers.get() + thread_index() * block_rows * row_bytes;
        const size_t first = block * block_rows;
        const size_t count = std::min(block_rows, num_rows - first);
        const size_t size = count * row_bytes;
        if (ply.file.read_at(begin.offset + first * row_bytes, rows, size) != size)
            throw PlyError("the file became shorter while it was read; read it again");
        decoder.decode(rows, count, first);
    });
    return {begin.row + num_rows, begin.offset + num_rows * row_bytes};
}

PlyPlace read_rows_with_lists(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out) {
    const RowDecoder decoder(ply, out);
    const size_t row_bytes = decoder.row_bytes();
    const size_t num_rows = out.opacities.size;
    const size_t chunk_rows = std::max<size_t>(1, kPlyChunkBytes / row_bytes);
    std::vector<char> packed(std::min<size_t>(chunk_rows, num_rows) * row_bytes);
    ByteReader reader(ply.file, begin.offset, ply.file_bytes);
    for (size_t first = 0; first < num_rows; first += chunk_rows) {
        const size_t count = std::min(chunk_rows, num_rows - first);
        for (size_t r = 0; r < count; ++r)
            walk_row(reader, ply.vertex, begin.row + first + r, is_swapped(ply.encoding),
                     packed.data() + r * row_bytes);
        parallel_for(count, kRowsPerTask, [&](size_t r) {
            decoder.decode(packed.data() + r * row_bytes, 1, first + r);
        });
    }
    return {begin.row + num_rows, reader.offset()};
}

size_t skip_rows_with_lists(const PlyFile& ply, const PlyElement& element, size_t offset) {
    ByteReader reader(ply.file, offset, ply.file_bytes);
    for (uint64_t row = 0; row < element.count; ++row)
        walk_row(reader, element, row, is_swapped(ply.encoding), nullptr);
    return reader.offset();
}

}  // namespace v3dg
