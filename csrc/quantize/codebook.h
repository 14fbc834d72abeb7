#pragma once

// Few values that represent many: codebooks of numbers, and palettes of vectors.

#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kCodebookSize = 256;

// Fills a table of kCodebookSize with ascending numbers near the values, by Lloyd's
// algorithm. If there are at most that many different values, the table consists of
// them, and its last entries repeat the largest.
void make_codebook(Span<const double> values, Span<double> table);

// K vectors of `width` elements that represent N vectors, and the label of each vector.
struct VectorPalette {
    std::vector<double> vectors;   // [K * width], ordered by the first row with each label
    std::vector<uint32_t> labels;  // [N]
};

// Computes a palette of at least one and at most `size` vectors. The set with the
// largest squared error is cut in two, at its mean along its widest axis, until there
// are enough sets or all are exact. This avoids nearest-neighbour searches among tens
// of thousands of vectors: it takes O(N width log K) steps, and is deterministic.
VectorPalette make_palette(Span<const float> vectors, size_t width, size_t size);

}  // namespace v3dg
