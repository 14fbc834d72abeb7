// Reads .ply text. LineReader separates lines, and NumberReader reads the numbers of a
// line.

#include "io/ply_text.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

#include "base/parallel_for.h"
#include "io/ply_fields.h"

namespace v3dg {

namespace {

struct Line {
    const char* begin;
    const char* end;
};

bool is_space(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\v' || c == '\f'; }

// Reads the lines of a text file, except blank lines.
class LineReader {
  public:
    // The buffer has room for one byte more than the rest of the file. This byte makes
    // the end of the file detectable.
    LineReader(const File& file, size_t offset, size_t file_bytes)
        : file_(file),
          offset_(offset),
          buffer_(std::min(kPlyChunkBytes, file_bytes - std::min(offset, file_bytes) + 1)) {}

    size_t offset() const { return offset_ - (end_ - begin_); }

    // Returns some of the next lines: at most `max_lines`, and at least one unless the
    // file has ended. They are valid until the next call.
    const std::vector<Line>& next(uint64_t max_lines) {
        lines_.clear();
        bool at_end = false;
        while (lines_.empty() && max_lines > 0) {
            cut_lines(max_lines, at_end);
            if (!lines_.empty() || at_end) break;
            if (begin_ == 0 && end_ == buffer_.size() && end_ < kPlyChunkBytes)
                throw PlyError("the file became longer while it was read; read it again");
            if (begin_ == 0 && end_ == buffer_.size())
                throw PlyError("expected lines of at most " + std::to_string(kPlyChunkBytes) +
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
            const void* newline = std::memchr(text + begin_, '\n', end_ - begin_);
            if (newline == nullptr && !at_end) return;
            const Line line = {text + begin_, newline != nullptr ? static_cast<const char*>(newline)
                                                                 : text + end_};
            begin_ = std::min<size_t>(line.end - text + 1, end_);
            if (!std::all_of(line.begin, line.end, is_space)) lines_.push_back(line);
        }
    }

    const File& file_;
    size_t offset_;  // offset of the end of the buffer
    std::vector<char> buffer_;
    size_t begin_ = 0;
    size_t end_ = 0;
    std::vector<Line> lines_;
};

// Reads the numbers of one line, one after another.
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
                           in_quotes(std::string(word, rest_.begin)));
        ++num_read_;
        return value;
    }
    void skip_list(const PlyProperty& property) {
        const double count = next();
        if (!(count >= 0) || count != std::floor(count))
            throw PlyError("vertex " + std::to_string(row_) +
                           ": expected a whole number as length of list " +
                           in_quotes(property.name) + ", got " + std::to_string(count));
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

// Rounds a number to its type. A float is written as the shortest text that identifies
// it among floats. Read as a double, this text gives a slightly different number.
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

[[noreturn]] void throw_too_few(const PlyElement& element, uint64_t num_lines) {
    throw PlyError("expected " + std::to_string(element.count) + " lines for element " +
                   in_quotes(element.name) + ", got " + std::to_string(num_lines));
}

}  // namespace

PlyPlace read_text(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out) {
    constexpr size_t kLinesPerTask = 256;
    const std::vector<PlyField>& fields = ply.layout.fields;
    const size_t num_properties = ply.vertex.properties.size();
    const size_t num_rows = out.opacities.size;
    std::vector<double> values(most_threads() * num_properties);
    LineReader reader(ply.file, begin.offset, ply.file_bytes);
    for (size_t first = 0; first < num_rows;) {
        const std::vector<Line>& lines = reader.next(num_rows - first);
        if (lines.empty()) throw_too_few(ply.vertex, begin.row + first);
        parallel_for(lines.size(), kLinesPerTask, [&](size_t r) {
            double* row = values.data() + thread_index() * num_properties;
            parse_row(lines[r], begin.row + first + r, ply.vertex, row);
            store_gaussian([&](size_t slot) { return row[fields[slot].property]; }, first + r,
                           ply.layout, out);
        });
        first += lines.size();
    }
    return {begin.row + num_rows, reader.offset()};
}

size_t skip_text(const PlyFile& ply, const PlyElement& element, size_t offset) {
    LineReader reader(ply.file, offset, ply.file_bytes);
    for (uint64_t row = 0; row < element.count;) {
        const size_t num_lines = reader.next(element.count - row).size();
        if (num_lines == 0) throw_too_few(element, row);
        row += num_lines;
    }
    return reader.offset();
}

}  // namespace v3dg
