#pragma once

// Codebooks represent many numbers by a few, and palettes represent many vectors by a
// few.

#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kCodebookSize = 256;

// Fills a table with kCodebookSize ascending numbers that represent the values, by
// Lloyd's algorithm. If there are at most kCodebookSize different values, the table has
// each of them, and repeats the largest one at the end.
void make_codebook(Span<const double> values, Span<double> table);

// K vectors of some width that represent N vectors.
struct VectorPalette {
    // [K * width] ordered by the first row with each label
    std::vector<double> vectors;
    std::vector<uint32_t> labels;  // [N] index of the vector that represents each row
};

// Computes a palette of 1 to `size` vectors. Repeatedly, the set of vectors with the
// largest squared error is divided in two, at its mean along its widest axis, until
// there are enough sets or all errors are 0. This takes O(N width log K) steps, needs
// no search for nearest neighbours, and is deterministic.
VectorPalette make_palette(Span<const float> vectors, size_t width, size_t size);

}  // namespace v3dg
