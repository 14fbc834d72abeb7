// Few values for many: tables of numbers, and palettes of vectors.
#pragma once

#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kCodebookSize = 256;

// Fills a table of kCodebookSize with ascending numbers near the values, by Lloyd's algorithm.
// Where there are no more different values, these are the table, and its last entries repeat the
// greatest.
void make_codebook(Span<const double> values, Span<double> table);

// K vectors of `width` that stand for N, and which of them for each.
struct VectorPalette {
    std::vector<double> vectors;  // [K * width], in the order of the first row that each stands for
    std::vector<uint32_t> labels;  // [N]
};

// At most `size` of them, but one at least. The set with the largest squared error is cut in two,
// at its mean along its widest axis, until there are enough sets or all are exact: no search for
// the nearest of tens of thousands is needed, so it takes N width log K steps, and the same input
// gives the same palette.
VectorPalette make_palette(Span<const float> vectors, size_t width, size_t size);

}  // namespace v3dg
