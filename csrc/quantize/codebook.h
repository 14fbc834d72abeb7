#pragma once

// Few values that stand for many: codebooks of numbers, and palettes of vectors.

#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kCodebookSize = 256;

// Fills a table of kCodebookSize with ascending numbers near the values, by Lloyd's algorithm.
// Where there are at most that many different values, they are the table, and its last entries
// repeat the largest.
void make_codebook(Span<const double> values, Span<double> table);

// K vectors of `width` that stand for N vectors, and the one that stands for each.
struct VectorPalette {
    std::vector<double> vectors;   // [K * width], ordered by the first row that each stands for
    std::vector<uint32_t> labels;  // [N]
};

// Makes a palette of at most `size` vectors, but at least one. The set with the largest squared
// error is cut in two, at its mean along its widest axis, until there are enough sets or all are
// exact. So there is no search for the nearest of tens of thousands: it takes N width log K steps,
// and the same input gives the same palette.
VectorPalette make_palette(Span<const float> vectors, size_t width, size_t size);

}  // namespace v3dg
