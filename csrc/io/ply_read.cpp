// Binary rows of fixed size are read and converted by all threads, each its own blocks. Text, and
// rows with lists in them, are cut into rows by one thread and converted by all.

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <unordered_map>
#include <unordered_set>
#include <vector>

#include <omp.h>

#include "base/first_error.h"
#include "base/threads.h"
#include "io/ply.h"

namespace v3dg {

namespace {

constexpr double kLeastSquared = 1e-140,
                 kMostSquared = 1e140;  // numbers whose squares are exact to the last digit
constexpr size_t kBlockBytes =
    size_t(1) << 18;  // what one thread reads and converts at a time: fits its cache
constexpr size_t kChunkBytes = size_t(1)
                               << 22;  // what all threads convert together when one has to cut rows
constexpr double kUnitTolerance =
    1e-6;  // of a squared length; a rounded unit quaternion is off by 3e-7

// Where in a row the number for one slot of a gaussian is found. Slots: mean, quat, scale, opacity,
// then sh in memory's order.
struct Field {
    size_t property;  // among the vertex element's
    size_t offset;    // bytes from the start of the row, lists left out
    PlyType type;
};
enum Slot : size_t { kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kSh = 11 };

std::vector<std::string> slot_names(size_t num_sh) {
    std::vector<std::string> names = {"x",     "y",       "z",       "rot_0",   "rot_1",  "rot_2",
                                      "rot_3", "scale_0", "scale_1", "scale_2", "opacity"};
    for (size_t k = 0; k < num_sh; ++k)
        for (size_t c = 0; c < 3; ++c)
            names.push_back(k == 0 ? "f_dc_" + std::to_string(c)
                                   : "f_rest_" + std::to_string(c * (num_sh - 1) + k - 1));
    return names;
}

size_t num_sh_of(const PlyElement& vertex) {
    size_t num_rest = 0;
    for (const PlyProperty& property : vertex.properties)
        num_rest += property.name.rfind("f_rest_", 0) == 0;
    for (const size_t num_sh : {1, 4, 9, 16})
        if (num_rest == 3 * (num_sh - 1)) return num_sh;
    throw PlyError("expected 0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), got " +
                   std::to_string(num_rest));
}

std::string missing_text(const PlyElement& vertex, const std::vector<std::string>& missing) {
    std::string text = "expected vertex properties ";
    constexpr size_t kMaxNames = 8;
    for (size_t i = 0; i < missing.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + missing[i];
    if (missing.size() > kMaxNames)
        text += " and " + std::to_string(missing.size() - kMaxNames) + " more";
    text += ", got ";
    for (size_t i = 0; i < vertex.properties.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + quoted(vertex.properties[i].name);
    if (vertex.properties.empty()) text += "none";
    if (vertex.properties.size() > kMaxNames)
        text += " and " + std::to_string(vertex.properties.size() - kMaxNames) + " more";
    return text + (missing.size() < 4 ? "" : "; this is not a file of gaussians");
}

std::vector<Field> fields_of(const PlyElement& vertex, size_t num_sh) {
    std::unordered_map<std::string, Field> field_from_name;
    std::unordered_set<std::string> lists;
    size_t offset = 0;
    for (size_t p = 0; p < vertex.properties.size(); ++p) {
        const PlyProperty& property = vertex.properties[p];
        const bool is_new =
            property.is_list
                ? lists.insert(property.name).second && !field_from_name.count(property.name)
                : field_from_name.insert({property.name, {p, offset, property.type}}).second &&
                      !lists.count(property.name);
        if (!is_new)
            throw PlyError("expected each vertex property once, got " + quoted(property.name) +
                           " twice");
        if (!property.is_list) offset += size_of(property.type);
    }
    std::vector<Field> fields;
    std::vector<std::string> missing;
    for (const std::string& name : slot_names(num_sh)) {
        const auto found = field_from_name.find(name);
        if (lists.count(name))
            throw PlyError("expected a number as vertex property " + quoted(name) + ", got a list");
        if (found == field_from_name.end())
            missing.push_back(name);
        else
            fields.push_back(found->second);
    }
    if (!missing.empty()) throw PlyError(missing_text(vertex, missing));
    return fields;
}

template <class T>
T load_as(const char* bytes, bool is_swapped) {
    char copy[sizeof(T)];
    for (size_t i = 0; i < sizeof(T); ++i) copy[i] = bytes[is_swapped ? sizeof(T) - 1 - i : i];
    T value;
    std::memcpy(&value, copy, sizeof(T));
    return value;
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
    }
    return 0;
}

bool is_swapped(PlyEncoding encoding) {
    const uint16_t probe = 1;
    unsigned char first;
    std::memcpy(&first, &probe, 1);
    return (encoding == PlyEncoding::binary_big_endian) == (first == 1);
}

// Multiplies what doubles do not hold the squares of by a power of two; zeros and what is not
// finite stay.
void scale_extreme(double quat[4]) {
    double largest = 0;
    for (size_t j = 0; j < 4; ++j) largest = std::max(largest, std::abs(quat[j]));
    const bool is_usual = largest > kLeastSquared && largest < kMostSquared;
    if (is_usual || largest == 0 || !std::isfinite(largest)) return;
    const int exponent = std::ilogb(largest);
    for (size_t j = 0; j < 4; ++j) quat[j] = std::ldexp(quat[j], -exponent);
}

// Stores gaussian i; load(slot) is the number that the file holds for a slot.
template <class Load>
void store_gaussian(const Load& load, size_t i, size_t num_sh, const PlyGaussians<float>& out) {
    for (size_t j = 0; j < 3; ++j) out.means[3 * i + j] = static_cast<float>(load(kMean + j));
    for (size_t j = 0; j < 3; ++j)
        out.scales[3 * i + j] = static_cast<float>(std::exp(double(load(kScale + j))));
    out.opacities[i] = static_cast<float>(1 / (1 + std::exp(-double(load(kOpacity)))));
    float* sh = out.sh.data + 3 * num_sh * i;
    for (size_t j = 0; j < 3 * num_sh; ++j) sh[j] = static_cast<float>(load(kSh + j));

    double quat[4];
    for (size_t j = 0; j < 4; ++j) quat[j] = load(kQuat + j);
    scale_extreme(quat);
    double norm2 = 0;
    for (const double component : quat) norm2 += component * component;
    const bool keeps_length =
        !(norm2 > 0 && std::isfinite(norm2)) || std::abs(norm2 - 1) < kUnitTolerance;
    const double factor = keeps_length ? 1 : 1 / std::sqrt(norm2);
    for (size_t j = 0; j < 4; ++j) out.quats[4 * i + j] = static_cast<float>(quat[j] * factor);
}

// Rows of binary numbers of fixed size, lists left out.
class RowDecoder {
  public:
    RowDecoder(const PlyFile& ply, const PlyGaussians<float>& out)
        : fields_(fields_of(ply.vertex, ply.num_sh)),
          num_sh_(ply.num_sh),
          is_swapped_(is_swapped(ply.encoding)),
          out_(out) {
        for (const PlyProperty& property : ply.vertex.properties)
            if (!property.is_list) row_bytes_ += size_of(property.type);
        is_native_float_ =
            !is_swapped_ && std::all_of(fields_.begin(), fields_.end(), [](const Field& field) {
                return field.type == PlyType::float32;
            });
    }
    size_t row_bytes() const { return row_bytes_; }

    // Converts `count` rows into gaussians `first` and on.
    void decode(const char* rows, size_t count, size_t first) const {
        const Field* fields = fields_.data();
        for (size_t r = 0; r < count; ++r) {
            const char* row = rows + r * row_bytes_;
            if (is_native_float_) {
                const auto load = [=](size_t slot) {
                    float value;
                    std::memcpy(&value, row + fields[slot].offset, sizeof(value));
                    return value;
                };
                store_gaussian(load, first + r, num_sh_, out_);
            } else {
                const auto load = [=](size_t slot) {
                    return load_scalar(row + fields[slot].offset, fields[slot].type, is_swapped_);
                };
                store_gaussian(load, first + r, num_sh_, out_);
            }
        }
    }

  private:
    std::vector<Field> fields_;
    size_t num_sh_;
    bool is_swapped_;
    bool is_native_float_;
    size_t row_bytes_ = 0;
    PlyGaussians<float> out_;
};

// The bytes of a file one after another.
class ByteReader {
  public:
    ByteReader(const PosixFile& file, size_t offset, size_t file_bytes)
        : file_(file),
          offset_(offset),
          file_bytes_(file_bytes),
          buffer_(std::min(kBlockBytes, file_bytes - std::min(offset, file_bytes))) {}

    size_t offset() const { return offset_; }
    void skip(size_t size, const PlyElement& element, uint64_t row) {
        if (size > file_bytes_ - std::min(offset_, file_bytes_))
            throw PlyError("expected " + std::to_string(element.count) + " rows of element " +
                           quoted(element.name) + ", got the end of the file in row " +
                           std::to_string(row));
        offset_ += size;
    }
    // Valid until the next call. At most kBlockBytes.
    const char* take(size_t size, const PlyElement& element, uint64_t row) {
        const size_t begin = offset_;
        skip(size, element, row);
        if (begin < buffer_begin_ || begin + size > buffer_begin_ + buffer_size_) {
            buffer_begin_ = begin;
            buffer_size_ = file_.read_at(begin, buffer_.data(), buffer_.size());
            if (buffer_size_ < size)
                throw PlyError(
                    "expected the file not to change while it is read, got a shorter one");
        }
        return buffer_.data() + (begin - buffer_begin_);
    }

  private:
    const PosixFile& file_;
    size_t offset_;
    size_t file_bytes_;
    std::vector<char> buffer_;
    size_t buffer_begin_ = 0;
    size_t buffer_size_ = 0;
};

// Walks over one row; what is not in a list is appended to `packed`, if given.
void walk_row(ByteReader& reader, const PlyElement& element, uint64_t row, bool is_swapped,
              char* packed) {
    for (const PlyProperty& property : element.properties) {
        if (property.is_list) {
            const size_t count_bytes = size_of(property.count_type);
            const double count = load_scalar(reader.take(count_bytes, element, row),
                                             property.count_type, is_swapped);
            if (count < 0)
                throw PlyError("expected a length of list " + quoted(property.name) + " in row " +
                               std::to_string(row) + ", got " +
                               std::to_string(static_cast<int64_t>(count)));
            reader.skip(static_cast<size_t>(count) * size_of(property.type), element, row);
        } else if (packed) {
            const size_t size = size_of(property.type);
            std::memcpy(packed, reader.take(size, element, row), size);
            packed += size;
        } else {
            reader.skip(size_of(property.type), element, row);
        }
    }
}

struct Line {
    const char* begin;
    const char* end;
};

bool is_space(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\v' || c == '\f'; }

// The lines of a text that are not blank.
class LineReader {
  public:
    // One byte more than is left, so that the end of the file is met by reading.
    LineReader(const PosixFile& file, size_t offset, size_t file_bytes)
        : file_(file),
          offset_(offset),
          buffer_(std::min(kChunkBytes, file_bytes - std::min(offset, file_bytes) + 1)) {}

    size_t offset() const { return offset_ - (end_ - begin_); }

    // Some of the next lines, at least one and at most `max_lines`; none at the end of the file.
    // Valid until the next call.
    const std::vector<Line>& next(uint64_t max_lines) {
        lines_.clear();
        bool at_end = false;
        while (lines_.empty() && max_lines > 0) {
            cut_lines(max_lines, at_end);
            if (!lines_.empty() || at_end) break;
            if (begin_ == 0 && end_ == buffer_.size() && end_ < kChunkBytes)
                throw PlyError(
                    "expected the file not to change while it is read, got a longer one");
            if (begin_ == 0 && end_ == buffer_.size())
                throw PlyError("expected lines of at most " + std::to_string(kChunkBytes) +
                               " bytes, got a longer one");
            std::memmove(buffer_.data(), buffer_.data() + begin_, end_ - begin_);
            end_ -= begin_;
            begin_ = 0;
            const size_t got = file_.read_at(offset_, buffer_.data() + end_, buffer_.size() - end_);
            at_end = got < buffer_.size() - end_;
            offset_ += got;
            end_ += got;
        }
        return lines_;
    }

  private:
    void cut_lines(uint64_t max_lines, bool at_end) {
        while (begin_ < end_ && lines_.size() < max_lines) {
            const char* text = buffer_.data();
            const void* found = std::memchr(text + begin_, '\n', end_ - begin_);
            if (!found && !at_end) return;
            const Line line = {text + begin_,
                               found ? static_cast<const char*>(found) : text + end_};
            begin_ = std::min<size_t>(line.end - text + 1, end_);
            if (!std::all_of(line.begin, line.end, is_space)) lines_.push_back(line);
        }
    }

    const PosixFile& file_;
    size_t offset_;  // of the first byte that is not in the buffer
    std::vector<char> buffer_;
    size_t begin_ = 0;
    size_t end_ = 0;
    std::vector<Line> lines_;
};

// The numbers of one line, one after another.
class NumberReader {
  public:
    struct EndOfLine {};

    NumberReader(Line line, uint64_t row) : rest_(line), row_(row) {}

    bool at_end() {
        while (rest_.begin < rest_.end && is_space(*rest_.begin)) ++rest_.begin;
        return rest_.begin == rest_.end;
    }
    double next() {
        if (at_end()) throw EndOfLine();
        const char* word = rest_.begin;
        while (rest_.begin < rest_.end && !is_space(*rest_.begin)) ++rest_.begin;
        double value = 0;
        const char* first = word + (*word == '+' && rest_.begin - word > 1 && word[1] != '-');
        const auto [stop, error] = std::from_chars(first, rest_.begin, value);
        if (error != std::errc() || stop != rest_.begin)
            throw PlyError("vertex " + std::to_string(row_) + ": expected a number, got " +
                           quoted(std::string(word, rest_.begin)));
        ++num_read_;
        return value;
    }
    void skip_list(const PlyProperty& property) {
        const double count = next();
        if (!(count >= 0) || count != std::floor(count))
            throw PlyError("vertex " + std::to_string(row_) + ": expected a length of list " +
                           quoted(property.name) + ", got " + std::to_string(count));
        for (double i = 0; i < count; ++i) next();
    }
    void expect_end() {
        const size_t num_wanted = num_read_;
        while (!at_end()) next();
        if (num_read_ != num_wanted)
            throw PlyError("vertex " + std::to_string(row_) + ": expected " +
                           std::to_string(num_wanted) + " numbers, got " +
                           std::to_string(num_read_));
    }
    size_t num_read() const { return num_read_; }

  private:
    Line rest_;
    uint64_t row_;
    size_t num_read_ = 0;
};

// The shortest text of a float is another number when read as a double.
double rounded_to(PlyType type, double value) {
    return type == PlyType::float32 ? static_cast<double>(static_cast<float>(value)) : value;
}

void parse_row(Line line, uint64_t row, const PlyElement& vertex, double* value_from_property) {
    NumberReader numbers(line, row);
    try {
        for (size_t p = 0; p < vertex.properties.size(); ++p) {
            if (vertex.properties[p].is_list)
                numbers.skip_list(vertex.properties[p]);
            else
                value_from_property[p] = rounded_to(vertex.properties[p].type, numbers.next());
        }
    } catch (const NumberReader::EndOfLine&) {
        throw PlyError("vertex " + std::to_string(row) + ": expected " +
                       (vertex.has_lists() ? "at least " : "") +
                       std::to_string(vertex.properties.size()) + " numbers, got " +
                       std::to_string(numbers.num_read()));
    }
    numbers.expect_end();
}

[[noreturn]] void throw_too_few(const PlyElement& element, uint64_t found) {
    throw PlyError("expected " + std::to_string(element.count) + " lines for element " +
                   quoted(element.name) + ", got " + std::to_string(found));
}

size_t skip_text(const PlyFile& ply, size_t offset, const PlyElement& element) {
    LineReader reader(ply.file, offset, ply.file_bytes);
    for (uint64_t row = 0; row < element.count;) {
        const size_t num_lines = reader.next(element.count - row).size();
        if (num_lines == 0) throw_too_few(element, row);
        row += num_lines;
    }
    return reader.offset();
}

// Throws unless `count` rows can be in what is left of the file.
void check_size(const PlyFile& ply, const PlyElement& element, size_t offset) {
    const bool is_text = ply.encoding == PlyEncoding::ascii;
    // A number and what separates it from the next are two characters; the last may end with the
    // file.
    const size_t row_bytes = is_text ? 2 * element.properties.size() : element.min_row_bytes();
    const size_t left =
        ply.file_bytes - std::min(offset, ply.file_bytes);  // it may have grown since
    if (row_bytes != 0 && element.count > (left + (is_text ? 1 : 0)) / row_bytes)
        throw PlyError("expected " + std::to_string(element.count) + " rows of element " +
                       quoted(element.name) + " with " +
                       (is_text || element.has_lists() ? "at least " : "") +
                       std::to_string(row_bytes) + " bytes each, got " + std::to_string(left) +
                       " bytes; the file is truncated");
}

// Returns the offset after the element that begins at `offset`.
size_t skip_element(const PlyFile& ply, const PlyElement& element, size_t offset) {
    check_size(ply, element, offset);
    if (element.properties.empty()) return offset;
    if (ply.encoding == PlyEncoding::ascii) return skip_text(ply, offset, element);
    if (!element.has_lists()) return offset + element.count * element.min_row_bytes();
    ByteReader reader(ply.file, offset, ply.file_bytes);
    for (uint64_t row = 0; row < element.count; ++row)
        walk_row(reader, element, row, is_swapped(ply.encoding), nullptr);
    return reader.offset();
}

PlyPlace read_fixed_rows(const PlyFile& ply, PlyPlace at, const PlyGaussians<float>& out) {
    const RowDecoder decoder(ply, out);
    const size_t row_bytes = decoder.row_bytes();
    const size_t block_rows = std::max<size_t>(1, kBlockBytes / row_bytes);
    const size_t num_rows = out.opacities.size;
    const size_t num_blocks = (num_rows + block_rows - 1) / block_rows;
    const int num_threads = static_cast<int>(std::min<size_t>(most_threads(), num_blocks));
    // Not value-initialised, so a thread that gets no block costs no memory.
    const std::unique_ptr<char[]> buffers(new char[num_threads * block_rows * row_bytes]);
    FirstError error;
#pragma omp parallel for schedule(dynamic, 1) num_threads(num_threads)
    for (size_t block = 0; block < num_blocks; ++block) {
        error.run(block, [&] {
            char* rows = buffers.get() + omp_get_thread_num() * block_rows * row_bytes;
            const size_t first = block * block_rows;
            const size_t count = std::min(block_rows, num_rows - first);
            const size_t size = count * row_bytes;
            if (ply.file.read_at(at.offset + first * row_bytes, rows, size) != size)
                throw PlyError(
                    "expected the file not to change while it is read, got a shorter one");
            decoder.decode(rows, count, first);
        });
    }
    error.rethrow();
    return {at.row + num_rows, at.offset + num_rows * row_bytes};
}

PlyPlace read_rows_with_lists(const PlyFile& ply, PlyPlace at, const PlyGaussians<float>& out) {
    const RowDecoder decoder(ply, out);
    const size_t row_bytes = decoder.row_bytes();
    const size_t num_rows = out.opacities.size;
    const size_t chunk_rows = std::max<size_t>(1, kChunkBytes / row_bytes);
    std::vector<char> packed(std::min<size_t>(chunk_rows, num_rows) * row_bytes);
    ByteReader reader(ply.file, at.offset, ply.file_bytes);
    for (size_t first = 0; first < num_rows; first += chunk_rows) {
        const size_t count = std::min(chunk_rows, num_rows - first);
        for (size_t r = 0; r < count; ++r)
            walk_row(reader, ply.vertex, at.row + first + r, is_swapped(ply.encoding),
                     packed.data() + r * row_bytes);
#pragma omp parallel for schedule(static) num_threads(most_threads())
        for (size_t r = 0; r < count; ++r)
            decoder.decode(packed.data() + r * row_bytes, 1, first + r);
    }
    return {at.row + num_rows, reader.offset()};
}

PlyPlace read_text(const PlyFile& ply, PlyPlace at, const PlyGaussians<float>& out) {
    constexpr size_t kLinesPerTask = 256;
    const std::vector<Field> fields = fields_of(ply.vertex, ply.num_sh);
    const size_t num_properties = ply.vertex.properties.size();
    const size_t num_rows = out.opacities.size;
    std::vector<double> values(most_threads() * num_properties);
    LineReader reader(ply.file, at.offset, ply.file_bytes);
    for (size_t first = 0; first < num_rows;) {
        const std::vector<Line>& lines = reader.next(num_rows - first);
        if (lines.empty()) throw_too_few(ply.vertex, at.row + first);
        FirstError error;
#pragma omp parallel for schedule(dynamic, kLinesPerTask) num_threads(most_threads())
        for (size_t r = 0; r < lines.size(); ++r) {
            error.run(r, [&] {
                double* row = values.data() + omp_get_thread_num() * num_properties;
                parse_row(lines[r], at.row + first + r, ply.vertex, row);
                store_gaussian([&](size_t slot) { return row[fields[slot].property]; }, first + r,
                               ply.num_sh, out);
            });
        }
        error.rethrow();
        first += lines.size();
    }
    return {at.row + num_rows, reader.offset()};
}

}  // namespace

PlyFile open_ply(const char* path) {
    PosixFile file = open_ply_file(path);
    const auto size = static_cast<size_t>(file.status().st_size);
    const PlyHeader header = read_ply_header(file);
    PlyFile ply = {std::move(file), size, header.encoding, {}, header.size, 1};
    const auto is_vertex = [](const PlyElement& element) { return element.name == "vertex"; };
    const auto num_found = std::count_if(header.elements.begin(), header.elements.end(), is_vertex);
    if (num_found != 1)
        throw PlyError("expected one element 'vertex', got " + std::to_string(num_found));
    const auto vertex = std::find_if(header.elements.begin(), header.elements.end(), is_vertex);
    ply.vertex = *vertex;
    ply.num_sh = num_sh_of(ply.vertex);
    fields_of(ply.vertex, ply.num_sh);  // throws when one is missing
    for (auto element = header.elements.begin(); element != vertex; ++element)
        ply.vertex_offset = skip_element(ply, *element, ply.vertex_offset);
    check_size(ply, ply.vertex, ply.vertex_offset);
    return ply;
}

PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known,
                  const PlyGaussians<float>& out) {
    assert(first + out.opacities.size <= ply.num_gaussians());
    if (out.opacities.size == 0) return known;
    const PlyPlace from = known.row <= first ? known : ply.begin();
    PlyElement skipped = ply.vertex;
    skipped.count = first - from.row;
    const PlyPlace at = {first, skip_element(ply, skipped, from.offset)};
    if (ply.encoding == PlyEncoding::ascii) return read_text(ply, at, out);
    return ply.vertex.has_lists() ? read_rows_with_lists(ply, at, out)
                                  : read_fixed_rows(ply, at, out);
}

}  // namespace v3dg
