// Writes .ply files. All threads convert blocks of rows. The offsets of binary blocks
// are known, so each thread also writes its blocks. Text is converted a few blocks at a
// time, and written in order.

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/parallel_for.h"
#include "io/ply.h"

namespace v3dg {

namespace {

constexpr size_t kBlockRows = 2048;  // half a megabyte at SH degree 3
constexpr size_t kTextBlocks = 16;   // number of blocks in memory at once

// Finite replacements for infinite logarithms and logits. They are beyond the
// logarithms and logits of all other float32 values, which are at least -103.3 and at
// most 16.6. Their exp() and sigmoid are exactly 0 and 1 after rounding, even in
// float32.
constexpr float kLogOfZero = -110;
constexpr float kLogitOfOne = 20;

std::string header_text(size_t num_gaussians, size_t num_sh, PlyEncoding encoding,
                        const std::vector<std::string>& comments) {
    const char* kNames[] = {"ascii", "binary_little_endian", "binary_big_endian"};
    std::string text = std::string("ply\nformat ") + kNames[static_cast<int>(encoding)] + " 1.0\n";
    for (const std::string& comment : comments) text += "comment " + comment + "\n";
    text += "element vertex " + std::to_string(num_gaussians) + "\n";
    const auto add = [&](const std::string& name, size_t count) {
        for (size_t i = 0; i < count; ++i)
            text += "property float " + name + std::to_string(i) + "\n";
    };
    text += "property float x\nproperty float y\nproperty float z\n";
    add("f_dc_", 3);
    add("f_rest_", 3 * (num_sh - 1));
    text += "property float opacity\n";
    add("scale_", 3);
    add("rot_", 4);
    return text + "end_header\n";
}

[[noreturn]] void throw_value(const char* name, size_t i, const char* wanted, float got) {
    throw std::invalid_argument(std::string(name) + "[" + std::to_string(i) + "]: expected " +
                                wanted + ", got " + std::to_string(got));
}

float log_scale(float scale, size_t i) {
    if (scale < 0) throw_value("scales", i, "values >= 0", scale);
    return scale == 0 ? kLogOfZero : static_cast<float>(std::log(static_cast<double>(scale)));
}

float opacity_logit(float opacity, size_t i) {
    if (opacity < 0 || opacity > 1) throw_value("opacities", i, "values in [0, 1]", opacity);
    if (opacity == 0) return kLogOfZero;
    if (opacity == 1) return kLogitOfOne;
    const double p = opacity;
    return static_cast<float>(std::log(p / (1 - p)));
}

// Writes the numbers of gaussian i in the order of the header.
void encode_gaussian(const PlyGaussians<const float>& in, size_t num_sh, size_t i, float* row) {
    const float* sh = in.sh.data + 3 * num_sh * i;
    for (size_t j = 0; j < 3; ++j) *row++ = in.means[3 * i + j];
    for (size_t c = 0; c < 3; ++c) *row++ = sh[c];
    for (size_t c = 0; c < 3; ++c)
        for (size_t k = 1; k < num_sh; ++k) *row++ = sh[3 * k + c];
    *row++ = opacity_logit(in.opacities[i], i);
    for (size_t j = 0; j < 3; ++j) *row++ = log_scale(in.scales[3 * i + j], i);
    for (size_t j = 0; j < 4; ++j) *row++ = in.quats[4 * i + j];
}

// Stores the bytes one by one, so that the result does not depend on the byte order of
// the machine.
void store_bytes(const float* values, size_t count, PlyEncoding encoding, unsigned char* bytes) {
    for (size_t v = 0; v < count; ++v) {
        uint32_t bits;
        std::memcpy(&bits, values + v, sizeof(bits));
        if (encoding == PlyEncoding::binary_big_endian)
            for (size_t b = 0; b < 4; ++b)
                bytes[4 * v + b] = static_cast<unsigned char>(bits >> (24 - 8 * b));
        else
            for (size_t b = 0; b < 4; ++b)
                bytes[4 * v + b] = static_cast<unsigned char>(bits >> (8 * b));
    }
}

void append_text(const float* values, size_t count, std::string& text) {
    // Maximum length of a number. The shortest text that is read as the same float has
    // at most 15 characters.
    constexpr size_t kMaxDigits = 32;
    char word[kMaxDigits];
    for (size_t v = 0; v < count; ++v) {
        text.append(word, std::to_chars(word, word + kMaxDigits, values[v]).ptr);
        text.push_back(v + 1 < count ? ' ' : '\n');
    }
}

struct Writer {
    const File& file;
    const PlyGaussians<const float>& gaussians;
    PlyEncoding encoding;
    size_t num_gaussians;
    size_t num_sh;
    size_t offset;  // offset of the first row

    size_t num_values() const { return 11 + 3 * num_sh; }
    size_t num_blocks() const { return (num_gaussians + kBlockRows - 1) / kBlockRows; }

    template <class Row>
    void for_rows(size_t block, const Row& take_row) const {
        float row[11 + 3 * 16];
        const size_t last = std::min(num_gaussians, (block + 1) * kBlockRows);
        for (size_t i = block * kBlockRows; i < last; ++i) {
            encode_gaussian(gaussians, num_sh, i, row);
            take_row(row);
        }
    }

    void write_binary() const {
        const size_t row_bytes = 4 * num_values();
        const int num_threads = static_cast<int>(std::min<size_t>(most_threads(), num_blocks()));
        const std::unique_ptr<unsigned char[]> buffers(
            new unsigned char[num_threads * kBlockRows * row_bytes]);
        parallel_for_on(num_threads, num_blocks(), 1, [&](size_t block) {
            unsigned char* const begin = buffers.get() + thread_index() * kBlockRows * row_bytes;
            unsigned char* end = begin;
            for_rows(block, [&](const float* row) {
                store_bytes(row, num_values(), encoding, end);
                end += row_bytes;
            });
            file.write_at(offset + block * kBlockRows * row_bytes, reinterpret_cast<char*>(begin),
                          end - begin);
        });
    }

    void write_text() const {
        size_t end = offset;
        std::vector<std::string> texts(kTextBlocks);
        for (size_t first = 0; first < num_blocks(); first += kTextBlocks) {
            const size_t count = std::min(kTextBlocks, num_blocks() - first);
            parallel_for(count, 1, [&](size_t b) {
                texts[b].clear();
                for_rows(first + b,
                         [&](const float* row) { append_text(row, num_values(), texts[b]); });
            });
            for (size_t b = 0; b < count; ++b) {
                file.write_at(end, texts[b].data(), texts[b].size());
                end += texts[b].size();
            }
        }
    }
};

}  // namespace

void write_ply(const char* path, const PlyGaussians<const float>& gaussians, PlyEncoding encoding,
               size_t num_sh, const std::vector<std::string>& comments) {
    const size_t num_gaussians = gaussians.opacities.size;
    File file = File::create(path);
    const std::string header = header_text(num_gaussians, num_sh, encoding, comments);
    file.write_at(0, header.data(), header.size());
    const Writer writer = {.file = file,
                           .gaussians = gaussians,
                           .encoding = encoding,
                           .num_gaussians = num_gaussians,
                           .num_sh = num_sh,
                           .offset = header.size()};
    if (encoding == PlyEncoding::ascii)
        writer.write_text();
    else if (num_gaussians > 0)
        writer.write_binary();
    file.close();
}

}  // namespace v3dg
