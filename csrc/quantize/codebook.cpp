// Computes codebooks by Lloyd's algorithm, starting from the density of the values.
// Computes palettes by repeatedly dividing sets of vectors in two.

#include "quantize/codebook.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <numeric>
#include <queue>

namespace v3dg {

namespace {

constexpr size_t kBins = 4096;
constexpr int kRounds = 16;
// The fraction of a table's entries that are evenly distributed over the range, so that
// a rare value also has a close entry.
constexpr double kEven = 0.25;

// Initialises a table. The density of entries is proportional to the cube root of the
// density of values, which is optimal for many entries (Panter and Dite).
void guess_codebook(const std::vector<double>& ordered, Span<double> table) {
    const double low = ordered.front(), width = (ordered.back() - low) / kBins;
    std::vector<double> density(kBins, 0.0);
    for (const double value : ordered)
        density[std::min(static_cast<size_t>((value - low) / width), kBins - 1)] += 1.0;
    for (double& count : density) count = std::cbrt(count);
    const double total = std::accumulate(density.begin(), density.end(), 0.0);
    double before = 0.0;  // fraction of the entries below a bin
    size_t entry = 0;
    for (size_t bin = 0; bin < kBins; ++bin) {
        const double share = (1 - kEven) * density[bin] / total + kEven / kBins;
        for (; entry < table.size; ++entry) {
            const double quantile = (entry + 0.5) / table.size;
            if (quantile > before + share && bin + 1 < kBins) break;
            table[entry] = low + width * (bin + (quantile - before) / share);
        }
        before += share;
    }
}

// A range of rows that one vector represents.
struct Part {
    size_t first, last;
    double error;  // sum of squared distances to the mean
    size_t axis;   // axis that contributes most to the error
    uint32_t number;
    std::vector<double> mean;

    bool operator<(const Part& other) const {
        return error != other.error ? error < other.error : number > other.number;
    }
};

Part part_of(Span<const float> vectors, size_t width, const std::vector<uint32_t>& order,
             size_t first, size_t last, uint32_t number) {
    std::vector<double> mean(width, 0.0), errors(width, 0.0);
    for (size_t i = first; i < last; ++i)
        for (size_t d = 0; d < width; ++d) mean[d] += vectors[order[i] * width + d];
    for (double& value : mean) value /= static_cast<double>(last - first);
    for (size_t i = first; i < last; ++i)
        for (size_t d = 0; d < width; ++d) {
            const double apart = vectors[order[i] * width + d] - mean[d];
            errors[d] += apart * apart;
        }
    const auto widest = std::max_element(errors.begin(), errors.end()) - errors.begin();
    const double error = std::accumulate(errors.begin(), errors.end(), 0.0);
    return {.first = first,
            .last = last,
            .error = error,
            .axis = static_cast<size_t>(widest),
            .number = number,
            .mean = std::move(mean)};
}

}  // namespace

void make_codebook(Span<const double> values, Span<double> table) {
    assert(table.size == kCodebookSize);
    std::vector<double> ordered(values.begin(), values.end());
    std::sort(ordered.begin(), ordered.end());
    std::vector<double> distinct(table.size + 1);
    size_t num_distinct = 0;
    for (size_t i = 0; i < ordered.size() && num_distinct < distinct.size(); ++i)
        if (i == 0 || ordered[i] != ordered[i - 1]) distinct[num_distinct++] = ordered[i];
    if (num_distinct <= table.size) {
        for (size_t k = 0; k < table.size; ++k)
            table[k] = num_distinct ? distinct[std::min(k, num_distinct - 1)] : 0.0;
        return;
    }
    guess_codebook(ordered, table);
    for (int round = 0; round < kRounds; ++round) {
        auto first = ordered.begin();
        for (size_t k = 0; k < table.size; ++k) {
            const bool is_last = k + 1 == table.size;
            const auto last =
                is_last ? ordered.end()
                        : std::lower_bound(first, ordered.end(), (table[k] + table[k + 1]) / 2);
            if (last != first)
                table[k] = std::accumulate(first, last, 0.0) / static_cast<double>(last - first);
            first = last;
        }
        std::sort(table.begin(), table.end());
    }
}

VectorPalette make_palette(Span<const float> vectors, size_t width, size_t size) {
    const size_t count = width ? vectors.size / width : 0;
    VectorPalette palette{std::vector<double>(width, 0.0), std::vector<uint32_t>(count, 0)};
    if (count == 0) return palette;
    std::vector<uint32_t> order(count);
    std::iota(order.begin(), order.end(), 0u);
    std::priority_queue<Part> parts;
    uint32_t number = 0;
    parts.push(part_of(vectors, width, order, 0, count, number));
    while (parts.size() < size && parts.top().error > 0) {
        const Part part = parts.top();
        parts.pop();
        const auto first = order.begin() + part.first, last = order.begin() + part.last;
        auto middle = std::stable_partition(first, last, [&](uint32_t row) {
            return vectors[row * width + part.axis] <= part.mean[part.axis];
        });
        if (middle == first || middle == last)  // rounding hides the differences
                                                // between the vectors
            middle = first + (part.last - part.first) / 2;
        const auto cut = static_cast<size_t>(middle - order.begin());
        parts.push(part_of(vectors, width, order, part.first, cut, ++number));
        parts.push(part_of(vectors, width, order, cut, part.last, ++number));
    }
    std::vector<Part> found;
    for (; !parts.empty(); parts.pop()) found.push_back(parts.top());
    std::sort(found.begin(), found.end(),
              [&](const Part& a, const Part& b) { return order[a.first] < order[b.first]; });
    palette.vectors.clear();
    for (size_t entry = 0; entry < found.size(); ++entry) {
        const Part& part = found[entry];
        palette.vectors.insert(palette.vectors.end(), part.mean.begin(), part.mean.end());
        for (size_t i = part.first; i < part.last; ++i)
            palette.labels[order[i]] = static_cast<uint32_t>(entry);
    }
    return palette;
}

}  // namespace v3dg
